# SPDX-License-Identifier: Apache-2.0
"""From scans to newtons: force curves, the calibration file, contacts, and the reader.

Curves are used here, and learned in `calibrate`: a program that reads forces loads no regression.
"""
