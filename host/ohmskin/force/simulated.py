# SPDX-License-Identifier: Apache-2.0
"""A skin that a simulation presses: what ohmskin would make of these forces.

    forces -> rises (the calibration, backwards) -> circuit -> codes -> `SkinReader` -> forces

So a policy that is trained in MuJoCo meets ghosts, noise, deviations and contacts as the calibrated
skin has them. It is a simulation: no textile's creep, hysteresis or drift is in it.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.arrays import Float
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import EmulatorLink, SteppedLink, SteppedSkin
from ohmskin.emulate.faults import SkinFaults
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, LEAD_OHM, TOP_WIRE_OHM, Scene
from ohmskin.emulate.urls import DEFAULT_NOISE_LSB
from ohmskin.errors import DeviceLost
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import METHODS
from ohmskin.force.calibration import Calibration, CalibrationLike, loaded
from ohmskin.force.reader import CalibratedSkin, ForceScan, SkinReader
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import ADC_BITS
from ohmskin.link.session import Session

# The skin is tared at first by the mean of so many scans. Chosen: as `ohmskin tare` takes them.
_TARE_SCANS: Final = 90
# Times are less than so many seconds: in ns, they fit into 64 bits.
_LONGEST_S: Final = 9e9


class SimulatedSkin:
    """The skin of a calibration, pressed by whatever forces a program says.

    calibration: a `Calibration` or the path of its file. Its curves, rest and wires are those of
        the skin; where it does not know the wires, they are those of emulated skins.
    noise_lsb: standard deviation of the converter's noise, before rounding [LSB].
    seed: of the noise, and of the wires, which scatter by 10 % about what the calibration says.

    >>> skin = SimulatedSkin("skin.json")
    >>> skin.step(force_n, time_s=0.01).force_n.shape
    (8, 8)

    :raises ValueError: the calibration cannot be read, or is of voltages, which say nothing of
        the cells.
    """

    def __init__(
        self, calibration: CalibrationLike, *, noise_lsb: float = DEFAULT_NOISE_LSB, seed: int = 0
    ) -> None:
        calibration = loaded(calibration)
        if calibration.method not in METHODS:
            raise ValueError("a calibration by 'voltage' has no conductances: take another method")
        rows, columns, wires = calibration.rows, calibration.columns, calibration.nominal_wire_ohm
        if wires.curve_top is not None and calibration.mode != "far":
            # Its cells are those of the curves, and so are the wires up to them.
            wires = WireOhm(*wires[6:], *wires[3:6])
        told = (wires.top, TOP_WIRE_OHM), (wires.bottom, BOTTOM_WIRE_OHM), (wires.lead, LEAD_OHM)
        top, bottom, lead = (usual if known is None else known for known, usual in told)
        own = 0.0 if calibration.own_lead_ohm is None else calibration.own_lead_ohm
        drawn = Scene("rest", rows, columns, seed=seed).rest
        self._rest = replace(
            drawn,
            cell_siemens=calibration.untouched.level,
            top_wire_ohm=drawn.top_wire_ohm * top / TOP_WIRE_OHM,
            bottom_wire_ohm=drawn.bottom_wire_ohm * bottom / BOTTOM_WIRE_OHM,
            lead_ohm=np.maximum(lead + own + np.zeros(rows + columns), 0.0),
        )
        self._model, self._number = calibration.model, 0
        self._settings = BoardSettings(rows, columns, calibration.mode, None, calibration.unit_id)
        self._noise_lsb, self._seed = noise_lsb, seed
        self._force_n: ArrayLike = np.zeros((rows, columns))
        self._board = self._pressed(lambda _: self._model.rise(self._force_n))
        board = SteppedSkin(SteppedLink(self._board)).info
        self._reader = SkinReader(board, replace(calibration, nominal_wire_ohm=wires))
        codes = [self._board.codes_at(0.0) for _ in range(_TARE_SCANS)]
        self._reader.tare(ratio_from_codes(np.mean(codes, axis=0), ADC_BITS), force=True)

    @property
    def calibration(self) -> Calibration:
        """The calibration with the rest of this skin as its tare."""
        calibration = self._reader.calibration
        assert calibration is not None
        return calibration

    def _pressed(self, rise: Callable[[float], Float]) -> EmulatedBoard:
        """A board whose skin conducts so much more (R, C) [S] at its time [s]."""

        def ratio(time_s: float, mode: str) -> Float:
            siemens = self._rest.cell_siemens + rise(time_s)
            return SkinFaults().readings(replace(self._rest, cell_siemens=siemens), mode)

        return EmulatedBoard(ratio, self._settings, noise_lsb=self._noise_lsb, seed=self._seed)

    def step(self, force_n: ArrayLike, time_s: float) -> ForceScan:
        """What a scan at this time shows while these forces (R, C) [N] press: no clock passes.

        time_s: the time of the simulation, which goes on from step to step; `ForceScan.time_ns` is
        the same. Raises ValueError for forces of another shape, below 0 or not finite, and for such
        a time.
        """
        if not abs(time_s) < _LONGEST_S:
            raise ValueError(f"time_s is {time_s:g}, it must be a time within {_LONGEST_S:g} s")
        self._force_n = force_n
        codes, mode = self._board.codes_at(time_s), self._settings.mode
        time_us, time_ns = round(1e6 * time_s), round(1e9 * time_s)
        self._number += 1
        scan = Scan(codes, self._number, time_us, time_s, 0, mode=mode, time_ns=time_ns)
        return self._reader.read(scan)

    def opened(self, force_n: Callable[[float], ArrayLike]) -> CalibratedSkin:
        """The same skin on an emulated board in real time, as `ohmskin.open` gives one.

        force_n: gives the forces (R, C) [N] at a time since this call [s]; another thread asks it.
        Where it raises an error, or gives no such forces, the scans end by DeviceLost.
        """

        def rise(time_s: float) -> Float:
            try:
                return self._model.rise(force_n(time_s))
            except Exception as exc:
                raise DeviceLost(f"simulated skin: force_n({time_s:.3f}) raised {exc!r}") from exc

        link = EmulatorLink(self._pressed(rise), "simulated skin")
        return CalibratedSkin(Session(link), self.calibration)
