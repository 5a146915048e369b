# SPDX-License-Identifier: Apache-2.0
"""What an untouched skin tells of its wires: little, so every figure carries its deviation.

Symbols

====== ============ ==================================================================
symbol shape        meaning
====== ============ ==================================================================
z      (RC,)        port resistance now, less that of the model [ohm]
x      (2+R+C,)     what the wires have more than nominal, as a share: all top wires, all
                    bottom ones, those of each row, those of each column
A      (RC, 2+R+C)  slopes of z by x [ohm]
B      (RC, RC)     slopes of z by the cells' log resistances [ohm]
s      ()           deviation of a cell's log resistance from the model's, to be found
====== ============ ==================================================================

The model is the nominal wires and, where there are readings of an earlier rest, the cells that
these show; else equal cells. With z = A x + B (common + each) + noise, x is the generalised least
squares answer under wide priors; s is chosen so that the residual has the size it should. Cells of
1 MOhm hide wires of 100 ohm behind their own scatter: without earlier readings only gross changes
show, and with them a factor of two does so on large skins alone. Touches show more: `doctor_press`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import current_from_ratio, current_std, port_sensitivity
from ohmskin.doctor.findings import NOT_KNOWN, Finding
from ohmskin.doctor.signal import mean_std_lsb
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello

LAYER_STD: Final = 30.0  # prior deviations of shares: wide
LINE_STD: Final = 0.05  # lines of a layer change alike
ODD_LINE_STD: Final = 30.0  # but for the one that is asked about
COMMON_STD: Final = 1.0
LEAST_STD: Final = 0.001  # of a cell: nothing is more alike than this
CHANGED: Final = 0.25  # share of a layer's nominal wires that matters
LINE_CHANGED: Final = 0.75
CLEAR_STDS: Final = 5.0
TO_DO: Final = (
    "is the skin stretched or bent, a stripe worn or a crimp loose? If it is to stay so, calibrate "
    "anew"
)
UNKNOWN: Final = f"{NOT_KNOWN}: an untouched skin hides its wires, --press asks for touches"
KNOWN: Final = 0.15  # deviation of a share from which a layer counts as known


@dataclass(frozen=True, eq=False)
class Wires:
    """Wires over nominal: of the layers (2,), each row (R,) and column (C,), with deviations."""

    layer: Float
    layer_std: Float
    line: Float
    line_std: Float


def measure_wires(
    mean_codes: Float,
    noise_lsb: float,
    scans: int,
    board: Hello,
    wire_ohm: tuple[float, float],
    rest_ratio: Float | None,
) -> Wires:
    """Wires against `wire_ohm` of a segment (top, bottom), from mean codes (R, C, 4)."""
    rows, columns = mean_codes.shape[:2]
    refs = (board.ref_top_ohm, board.ref_bottom_ohm)
    knowledge = SkinKnowledge(rows, columns, *refs, adc_bits=board.adc_bits)
    top, bottom = (np.full((rows, columns), ohm) for ohm in wire_ohm)
    now_ohm = port_ohm(ratio_from_codes(mean_codes, board.adc_bits), refs)
    estimator = make_estimator("matrix", knowledge)
    if rest_ratio is None:
        level = estimator.estimate(ratio_from_codes(mean_codes, board.adc_bits)).cell_siemens
        cell = np.full((rows, columns), float(np.exp(np.mean(np.log(level)))))
        model = port_sensitivity(cell, top, bottom)
        z = now_ohm - model.port_ohm
    else:
        cell = estimator.estimate(rest_ratio).cell_siemens
        model = port_sensitivity(cell, top, bottom)
        z = now_ohm - port_ohm(rest_ratio, refs)
    by_wire = model.by_wires().reshape(-1, 2, rows, columns)
    slopes = np.concatenate(
        [by_wire.sum(axis=(2, 3)), by_wire[:, 0].sum(axis=2), by_wire[:, 1].sum(axis=1)], axis=1
    )
    # An earlier rest is a mean of such codes as well.
    reading_lsb = mean_std_lsb(noise_lsb, scans) * (1 if rest_ratio is None else 2**0.5)
    std_siemens = current_std(reading_lsb / 2**board.adc_bits, *refs)
    noise_ohm = std_siemens * (now_ohm + sum(refs)) ** 2
    return _fit(z, slopes, model.by_cell, noise_ohm, (rows, columns))


def port_ohm(ratio: Float, refs: tuple[float, float]) -> Float:
    """Port resistances (RC,) [ohm], means of all four readings (R, C, 4)."""
    current = current_from_ratio(ratio, *refs)
    return np.asarray((1 / np.maximum(current, 1e-9) - sum(refs)).ravel())


def _fit(
    z: Float, slopes: Float, by_cell: Float, noise_ohm: Float, shape: tuple[int, int]
) -> Wires:
    lines = sum(shape)
    prior = np.concatenate([[LAYER_STD] * 2, [LINE_STD] * lines])
    common = by_cell.sum(axis=1)
    known = COMMON_STD**2 * np.outer(common, common) + np.diag(noise_ohm**2)
    scatter = by_cell @ by_cell.T
    wide = known + (slopes * prior) @ (slopes * prior).T
    for cell_std in np.geomspace(LEAST_STD, 1.0, 40):
        # The smallest scatter that, with all else, explains the readings.
        covariance = wide + float(cell_std) ** 2 * scatter
        if z @ np.linalg.solve(covariance, z) < len(z):
            break
    alike = _posterior(z, slopes, covariance, prior)
    layer = [_sum_of(alike, [each]) for each in (0, 1)]
    line = []
    for number in range(lines):
        # Each line in turn may be unlike the others of its layer.
        at = 2 + number
        odd = prior.copy()
        odd[at] = ODD_LINE_STD
        more = np.outer(slopes[:, at], slopes[:, at]) * (ODD_LINE_STD**2 - LINE_STD**2)
        answer = _posterior(z, slopes, covariance + more, odd)
        line.append(_sum_of(answer, [0 if number < shape[0] else 1, at]))
    (layer_share, layer_std), (line_share, line_std) = (
        np.array(pairs).T for pairs in (layer, line)
    )
    return Wires(1 + layer_share, layer_std, 1 + line_share, line_std)


def _posterior(z: Float, slopes: Float, covariance: Float, prior: Float) -> tuple[Float, Float]:
    """Mean (n,) and covariance (n, n) of x."""
    spread = slopes * prior**2
    gain = np.linalg.solve(covariance, spread)
    return gain.T @ z, np.diag(prior**2) - spread.T @ gain


def _sum_of(posterior: tuple[Float, Float], which: list[int]) -> tuple[float, float]:
    """Sum of some of x, and its deviation."""
    mean, spread = posterior
    variance = float(spread[np.ix_(which, which)].sum())
    return float(mean[which].sum()), max(variance, 0.0) ** 0.5


def wire_findings(wires: Wires, wire_ohm: tuple[float, float], rows: int) -> list[Finding]:
    """Layers, or else single lines, whose wires are clearly not as they were."""
    findings = []
    for layer, (what, axis) in enumerate((("rows", "top"), ("columns", "bottom"))):
        share, std = float(wires.layer[layer]), float(wires.layer_std[layer])
        lines = slice(0, rows) if layer == 0 else slice(rows, None)
        own, own_std = wires.line[lines], wires.line_std[lines]
        if abs(share - 1) > max(CHANGED, CLEAR_STDS * std):
            findings.append(_finding(f"all {what} ({axis} layer)", share, std, wire_ohm[layer]))
            continue
        for line in np.flatnonzero(
            np.abs(own - 1) > np.maximum(LINE_CHANGED, CLEAR_STDS * own_std)
        ):
            where = f"{what[:-1]} {line}"
            findings.append(
                _finding(where, float(own[line]), float(own_std[line]), wire_ohm[layer])
            )
    return findings


def _finding(where: str, share: float, std: float, nominal_ohm: float) -> Finding:
    return Finding(
        "wires",
        "warning",
        where,
        f"{share * nominal_ohm:.0f} +- {std * nominal_ohm:.0f} ohm a segment, {share:.2f} times "
        "nominal",
        f"{nominal_ohm:.0f} ohm a segment",
        TO_DO,
    )


def wires_in_words(wires: Wires, wire_ohm: tuple[float, float]) -> str:
    """What is known of the layers, for the page."""
    words = [
        f"{layer} {share * ohm:.0f} +- {std * ohm:.0f} ohm a segment"
        for share, std, ohm, layer in zip(
            wires.layer, wires.layer_std, wire_ohm, ("top", "bottom"), strict=True
        )
        if std < KNOWN
    ]
    return "; ".join(words) or UNKNOWN


def lines_in_words(wires: Wires, rows: int) -> list[str]:
    """Each line over nominal, with its deviation."""
    return [
        f"{f'row {at}' if at < rows else f'column {at - rows}'}: {share:.2f} +- {std:.2f}"
        for at, (share, std) in enumerate(zip(wires.line, wires.line_std, strict=True))
    ]
