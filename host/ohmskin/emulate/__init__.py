# SPDX-License-Identifier: Apache-2.0
"""Boards without hardware, behind the interface of a port.

`board` is an emulated board, `simavr` the built firmware in a simulator. `scenes` and `press` are
their skins; `faults` are what is wrong with skin and line.

Takes a scene and its faults, gives a `Link`. The emulated board shares the circuit model with the
estimators, so a round trip through both proves little.

May import: `ohmskin.circuit` and what is below it.
"""
