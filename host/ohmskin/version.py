# SPDX-License-Identifier: Apache-2.0
"""The version of package and firmware: the one place that says it."""

VERSION = "0.1.0"
__version__ = VERSION
