# SPDX-License-Identifier: Apache-2.0
"""From conductances to newtons: force curves, the calibration file, contacts, and the reader.

Takes scans, gives forces and contacts with their standard deviations.

May import: `ohmskin.record`, `ohmskin.estimate` and what is below them.
"""
