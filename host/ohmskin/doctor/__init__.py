# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a skin board, its skin and its line, as data.

Knows no port, no clock and no words: `ohmskin.cli.doctor` reads the board and finds the words.

May import: `ohmskin.estimate` and what is below it.
"""
