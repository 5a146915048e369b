# SPDX-License-Identifier: Apache-2.0
"""From bytes to scans: everything between a board and a program that reads it.

bytes -> frames (`framing`) -> messages (`messages`) -> scans and answers (`session`, `device`)
"""
