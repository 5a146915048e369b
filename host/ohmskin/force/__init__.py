# SPDX-License-Identifier: Apache-2.0
"""From scans to newtons: force curves, the calibration file, contacts, and the reader."""
