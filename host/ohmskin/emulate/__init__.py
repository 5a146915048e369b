# SPDX-License-Identifier: Apache-2.0
"""Boards without hardware: simulated skins, lines and boards behind the interface of a port.

Takes a scene and its faults, gives a `Link`. The emulated board shares the circuit model with the
estimators: a round trip through both proves little.

May import: `ohmskin.circuit` and what is below it.
"""
