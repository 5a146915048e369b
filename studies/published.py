# SPDX-License-Identifier: Apache-2.0
"""What the paper printed of its speed and accuracy.

[Su2024]: B. Y. Su, Y. Wu, C. Wen, C. Liu, "Optimizing Multi-Touch Textile and Tactile Skin Sensing
Through Circuit Parameter Estimation": section V.A (errors), "Scalability" in section V (times),
section V.B (errors of force).
Its methods by our names: "naive" is `ohm`, "least squares" `lsq`, "regularized" `regularized`.

The paper gives a time for its 2x2 skin, whose errors are in newton, and errors in megohm for
simulated 3x3 skins, whose time it calls "unable to achieve real-time performance". So no method of
the paper has both a time and an error of resistance for the same skin.
"""

from __future__ import annotations

from typing import Final

# [ms] a frame, 2x2, on an AMD 7940HS: 40 for step 3, and 50 more for step 4.
TIME_2X2_MS: Final = {"lsq": 40.0, "regularized": 90.0}

# RMSE over the nine cells [megohm], one frame per condition, from the source of the two figures.
# `reference_trial("cell_sweep_3x3")` and "wire_sweep_3x3" have the skins.
CONDITIONS_MEGOHM: Final = {
    "cell_sweep": (0.01, 0.07, 0.09, 0.5, 0.7),
    "wire_sweep": (0.0001, 0.0005, 0.001, 0.021, 0.041),
}
RMSE_MEGOHM: Final = {
    "cell_sweep": {
        "ohm": (0.7235, 0.7128, 0.7102, 0.7157, 0.7879),
        "lsq": (0.8072, 0.4240, 0.2127, 0.0182, 0.0355),
        "regularized": (0.8030, 0.1489, 0.0696, 0.0138, 0.0145),
    },
    "wire_sweep": {
        "ohm": (0.7100, 0.7096, 0.7091, 0.6898, 0.6708),
        "lsq": (0.2210, 0.1912, 0.1614, 0.0980, 0.1894),
        "regularized": (0.0829, 0.0680, 0.0519, 0.1140, 0.1998),
    },
}
# RMSE of force [N] on a real 2x2 skin, from the source of the figures of section V.B: "calibration"
# is single touch, "estimation" several. Cells are (1, 1), (1, 2), (2, 1), (2, 2). "solved" is
# the paper's method: it does not say which of its steps, nor which forces were pressed.
FORCE_RMSE_N: Final = {
    "flat": {
        ("naive", "calibration"): (1.648, 1.721, 1.979, 1.204),
        ("solved", "calibration"): (2.307, 1.845, 2.040, 1.312),
        ("naive", "estimation"): (3.519, 2.345, 2.594, 2.175),
        ("solved", "estimation"): (2.278, 2.191, 1.936, 1.908),
    },
    "curved": {
        ("naive", "calibration"): (2.366, 2.595, 3.122, 2.118),
        ("solved", "calibration"): (2.728, 2.475, 3.120, 2.127),
        ("naive", "estimation"): (2.919, 2.228, 4.540, 2.662),
        ("solved", "estimation"): (2.208, 1.686, 3.509, 2.380),
    },
}
