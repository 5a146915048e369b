# SPDX-License-Identifier: Apache-2.0
"""Reads resistive tactile skins: from a board's bytes to the resistance of every cell.

import ohmskin

with ohmskin.open("/dev/ttyACM0") as skin:
    for scan in skin:
        print(scan.number, scan.ratio[0, 0])
"""

from ohmskin.device import Device
from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    DeviceSilent,
    OhmskinError,
    PortError,
    ProtocolMismatch,
    RecordingEnded,
    RecordingError,
)
from ohmskin.estimators import METHODS, Estimate, Estimator, SkinKnowledge, make_estimator
from ohmskin.messages import BoardStats, Hello, Scan, SelfTestReport
from ohmskin.ports import open

__all__ = [
    "METHODS",
    "BoardStats",
    "CommandRefused",
    "Device",
    "DeviceLost",
    "DeviceSilent",
    "Estimate",
    "Estimator",
    "Hello",
    "OhmskinError",
    "PortError",
    "ProtocolMismatch",
    "RecordingEnded",
    "RecordingError",
    "Scan",
    "SelfTestReport",
    "SkinKnowledge",
    "make_estimator",
    "open",
]
__version__ = "0.1.0"
