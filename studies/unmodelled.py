# SPDX-License-Identifier: Apache-2.0
"""Conditions that no method's equations have, or of which nobody has told it: more sweeps.

A skin is as in `conditions`, unless its sweep says otherwise; leads are told nowhere here. The
sweep of far ends is read in mode far, without wires told, by the two methods that take it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READINGS_PER_CELL
from ohmskin.circuit.skin import Skin, readings
from ohmskin.emulate.faults import SkinFaults
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.link.protocol import ADC_BITS, MODES
from studies.conditions import Case, Frame, Random, Shape, Sweep, converted, touched_frames
from studies.trials import NOMINAL_WIRE_OHM, palm, skin_at_rest

_FAR_METHODS: Final = ("joint", "touch")
_METHODS: Final = ("ohm", "matrix", *_FAR_METHODS)
_TOLD: Final = WireOhm(*NOMINAL_WIRE_OHM)
# A far end that is not connected, as its converter reads it [V/Vdd]. Chosen.
_OPEN_RATIO: Final = 0.3


def _case(
    told: WireOhm, rest_ratio: Float, frames: list[tuple[Float, Skin]], mode: str = "near"
) -> Case:
    rows, columns, _ = rest_ratio.shape
    known = SkinKnowledge(
        rows,
        columns,
        adc_bits=ADC_BITS,
        rest_ratio=converted(rest_ratio),
        nominal_wire_ohm=told,
        reading_names=MODES[mode],
    )
    return Case(known, tuple(Frame(converted(ratio), skin.cell_siemens) for ratio, skin in frames))


def _read(told: WireOhm, rest: Skin, skins: list[Skin]) -> Case:
    """A case of near ends whose readings have no other fault than the skin's."""
    return _case(told, readings(rest), [(readings(skin), skin) for skin in skins])


def _leads(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: the lead of every line [ohm], of which nobody has told."""
    rest = replace(skin_at_rest(*shape, random), lead_ohm=np.array(float(x)))
    return _read(_TOLD, rest, touched_frames(rest, frames, random))


def _leaks(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: what neighbouring lines leak into each other, at each crossing [ohm]."""
    rest, damp = skin_at_rest(*shape, random), SkinFaults(damp=float(x))
    damp = replace(damp, ref_top=rest.ref_top_ohm, ref_bottom=rest.ref_bottom_ohm)

    def read(skin: Skin) -> Float:
        return damp.readings(skin)[..., :READINGS_PER_CELL]

    skins = touched_frames(rest, frames, random)
    return _case(_TOLD, read(rest), [(read(skin), skin) for skin in skins])


def _palms(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: what the cells in the middle of a palm conduct [S]."""
    rest = skin_at_rest(*shape, random)
    return _read(_TOLD, rest, palm(rest, frames, random, float(x)))


def _untold(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: a segment of both layers [ohm], of which nobody has told."""
    rest = skin_at_rest(*shape, random, wire_ohm=(float(x), float(x)))
    return _read(WireOhm(), rest, touched_frames(rest, frames, random))


def _far(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: which far ends are lost."""
    rest = skin_at_rest(*shape, random)
    sound = SkinFaults(ref_top=rest.ref_top_ohm, ref_bottom=rest.ref_bottom_ohm)

    def read(skin: Skin) -> Float:
        return lost(sound.readings(skin, "far"), str(x))

    skins = touched_frames(rest, frames, random)
    return _case(WireOhm(), read(rest), [(read(skin), skin) for skin in skins], "far")


def lost(ratio: Float, fault: str, instead: float = _OPEN_RATIO, line: int = 0) -> Float:
    """These readings of mode far, (..., R, C, 4), without some of their far ends.

    fault: "none"; or "rows", "columns" or "one row", and then "off": their far ends read `instead`,
    as where they are open; or "near": they read what the near ends do, as where a plug is off.
    line: which row, if it is one.
    """
    ratio, names = ratio.copy(), list(MODES["far"])
    if fault == "none":
        return ratio
    lines, how = fault.rsplit(maxsplit=1)
    near, far = ("b", "f") if lines == "columns" else ("a", "e")
    rows = slice(line, line + 1) if lines == "one row" else slice(None)
    of_near = ratio[..., rows, :, names.index(near)]
    ratio[..., rows, :, names.index(far)] = of_near if how == "near" else instead
    return ratio


UNMODELLED: Final = {
    sweep.name: sweep
    for sweep in (
        Sweep(
            "leads",
            "leads not told",
            "lead of every line [Ω]",
            (30.0, 100.0, 300.0, 1e3, 3e3, 1e4),
            _leads,
            logarithmic=True,
            methods=_METHODS,
        ),
        Sweep(
            "untold",
            "wires not told",
            "wire segment [Ω]",
            (20.0, 50.0, 150.0, 500.0, 1e3, 2e3, 5e3),
            _untold,
            logarithmic=True,
            methods=_METHODS,
        ),
        Sweep(
            "leaks",
            "neighbours that leak",
            "leak at each crossing [Ω]",
            (1e5, 3e5, 1e6, 3e6, 1e7, 1e8),
            _leaks,
            logarithmic=True,
            methods=_METHODS,
        ),
        Sweep(
            "palms",
            "palms",
            "cells in a palm's middle [S]",
            (1e-5, 3e-5, 1e-4, 2.5e-4, 1e-3),
            _palms,
            logarithmic=True,
            methods=_METHODS,
        ),
        Sweep(
            "far",
            "far ends lost",
            "fault",
            ("none", "rows off", "columns off", "rows near", "columns near", "one row off"),
            _far,
            methods=_FAR_METHODS,
        ),
    )
}
