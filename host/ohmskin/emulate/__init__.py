# SPDX-License-Identifier: Apache-2.0
"""Boards without hardware, each a `Link`: `board` is emulated, `simavr` runs the built firmware.

`scenes` are their skins; `faults` are what is wrong with skin and line. The emulated board shares
the circuit model with the estimators, so a round trip through both proves little.
"""
