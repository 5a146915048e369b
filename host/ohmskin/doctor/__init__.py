# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a skin board, its skin and its line, as data.

Takes scans of the untouched skin, scans of presses, and what the board says of itself (`Evidence`).
Gives a `Diagnosis`: findings with lines, cells and figures, and no words. Knows no port and no
clock; `ohmskin.cli.doctor` reads the board and finds the words.

May import: `ohmskin.estimate` and what is below it.
"""
