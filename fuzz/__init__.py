# SPDX-License-Identifier: Apache-2.0
"""Fuzzing of all that comes from outside: ``make fuzz``. SECURITY.md says what it must hold."""
