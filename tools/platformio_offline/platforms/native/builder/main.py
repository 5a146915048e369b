# SPDX-License-Identifier: Apache-2.0
"""Builds a program for this machine with the compiler found on the PATH."""

from SCons.Script import Default, DefaultEnvironment

Default(DefaultEnvironment().BuildProgram())
