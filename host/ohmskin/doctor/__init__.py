# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a skin board, its skin and its line, as data.

`gather` reads a board, `examine` judges what was read. Both know no words: `ohmskin.cli.doctor`
finds them.

May import: `ohmskin.emulate`, `ohmskin.estimate` and what is below these.
"""
