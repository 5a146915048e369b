# SPDX-License-Identifier: Apache-2.0
"""What a board said, kept in files: recordings (.mcap), readings (.npz), tables (.csv).

Takes scans, gives them back later: `recorder` writes, `recording` reads, `replay` plays.

May import: `ohmskin.estimate` and what is below it.
"""
