# SPDX-License-Identifier: Apache-2.0
"""The command line: ``ohmskin --help``. Words are made here, and nothing is computed.

May import: everything below it.
"""
