# SPDX-License-Identifier: Apache-2.0
"""A calibrated skin on a body of a MuJoCo model: contacts in, what ohmskin shows out.

MuJoCo has contacts at points, and its `touch_grid` gives one nonzero cell under a sphere. A textile
and what is under it spread a force. So a `Pad` spreads each contact over the taxels near it:

    F_e = sum over contacts of  f w_e / sum w ,     w_e = exp(-|p_e - c|^2 / (2 s^2))

====== ===================================================================== ====
symbol meaning                                                               unit
====== ===================================================================== ====
F_e    force normal to taxel e                                               N
f      force of a contact along the taxels' normal there; a pull counts as 0 N
c      where the contact is                                                  m
p_e    where the taxel is, by the calibration's geometry, in the site's frame m
s      how far the pad spreads a force: one standard deviation               m
====== ===================================================================== ====
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

import ohmskin
from ohmskin.force.calibration import CalibrationLike, loaded
from ohmskin.force.geometry import required

Float = NDArray[np.float64]
__all__ = ["Pad"]

# A force is spread by at least so much [m]. Chosen: no skin has its taxels nearer.
LEAST_SPREAD_M = 1e-4


class Pad:
    """The skin of a calibration at a site of a model, on all geoms of the site's body.

    model: MuJoCo's. site: the name of the site whose frame is that of the skin's geometry.
    calibration: itself or the path of its file, with a geometry (``ohmskin skin FILE --pitch-mm
    10,10``). spread_m: s [m]; None: the distance from a taxel to the next. seed: of the skin's
    wires and noise.

    :raises ValueError: the model has no such site, or the calibration no geometry.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str,
        calibration: CalibrationLike,
        *,
        spread_m: float | None = None,
        seed: int = 0,
    ) -> None:
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if self._site < 0:
            raise ValueError(f"the model has no site '{site}'")
        calibration = loaded(calibration)
        geometry = required(calibration.geometry)
        self._model = model
        self._geoms = np.flatnonzero(model.geom_bodyid == model.site_bodyid[self._site])
        self._position_m, self._normal = geometry.position_m, geometry.normal
        # The distance to the nearest other taxel is that of neighbours, on any surface. Where there
        # is one taxel alone, it gets all of every force.
        taxels = self._position_m.reshape(-1, 3)
        apart_m = np.linalg.norm(taxels[1:] - taxels[0], axis=1).min(initial=np.inf)
        self.spread_m = float(apart_m) if spread_m is None else spread_m
        if not self.spread_m >= LEAST_SPREAD_M:
            raise ValueError(
                f"spread_m is {self.spread_m:g}, it must be {LEAST_SPREAD_M:g} or more"
            )
        self.skin = ohmskin.SimulatedSkin(calibration, seed=seed)

    def force_n(self, data: mujoco.MjData) -> Float:
        """F, (R, C) [N], of the contacts in `data`: what truly presses the taxels."""
        force_n = np.zeros(self._normal.shape[:2])
        turned = data.site_xmat[self._site].reshape(3, 3)
        wrench = np.zeros(6)
        for number, contact in enumerate(data.contact[: data.ncon]):
            on_skin = np.isin([contact.geom1, contact.geom2], self._geoms)
            if on_skin.sum() != 1:  # of other bodies, or within this one
                continue
            mujoco.mj_contactForce(self._model, data, number, wrench)
            # By the contact's frame, whose x goes from geom1 to geom2, as the force on geom2 does.
            in_world = contact.frame.reshape(3, 3).T @ wrench[:3]
            on_pad = turned.T @ (in_world if on_skin[1] else -in_world)
            at_m = turned.T @ (contact.pos - data.site_xpos[self._site])
            away_m2 = ((self._position_m - at_m) ** 2).sum(-1)
            # The nearest taxel's distance is taken off, so that no sum is 0 far from all of them.
            share = np.exp(-(away_m2 - away_m2.min()) / (2 * self.spread_m**2))
            force_n += np.maximum(-self._normal @ on_pad, 0.0) * share / share.sum()
        return force_n

    def read(self, data: mujoco.MjData) -> ohmskin.ForceScan:
        """What the skin shows of the contacts in `data`, at its time."""
        return self.skin.step(self.force_n(data), data.time)
