# SPDX-License-Identifier: Apache-2.0
"""What a board said, kept in files: recordings (.mcap), readings (.npz), tables (.csv).

`recorder` writes, `recording` reads, `replay` plays. The forces of a sensor at a second port
(`force_sensor`) are recorded beside the scans.
"""
