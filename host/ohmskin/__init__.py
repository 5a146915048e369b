# SPDX-License-Identifier: Apache-2.0
"""Reads resistive tactile skins: from a board's bytes to the resistance of every cell.

import ohmskin

with ohmskin.open("/dev/ttyACM0") as skin:
    for scan in skin:
        print(scan.number, scan.ratio[0, 0])
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    DeviceSilent,
    OhmskinError,
    PortError,
    ProtocolMismatch,
    RecordingEnded,
    RecordingError,
    TareRefused,
)

if TYPE_CHECKING:
    from ohmskin.boards import Boards, BoardScan, open_all
    from ohmskin.estimate.base import Estimate, Estimator, SkinKnowledge, WireOhm
    from ohmskin.estimate.methods import METHODS, make_estimator
    from ohmskin.force.calibrated_device import CalibratedDevice
    from ohmskin.force.calibration import Calibration, load_calibration
    from ohmskin.force.contacts import Contact
    from ohmskin.force.force_reader import ForceScan
    from ohmskin.link.clock import BoardClock
    from ohmskin.link.device import Device
    from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport
    from ohmskin.opening import open

__all__ = [
    "METHODS",
    "BoardClock",
    "BoardScan",
    "BoardStats",
    "Boards",
    "CalibratedDevice",
    "Calibration",
    "CommandRefused",
    "Contact",
    "Device",
    "DeviceLost",
    "DeviceSilent",
    "Estimate",
    "Estimator",
    "ForceScan",
    "Hello",
    "OhmskinError",
    "PortError",
    "ProtocolMismatch",
    "RecordingEnded",
    "RecordingError",
    "Scan",
    "SelfTestReport",
    "SkinKnowledge",
    "TareRefused",
    "WireOhm",
    "load_calibration",
    "make_estimator",
    "open",
    "open_all",
]
__version__ = "0.1.0"

# Where a name is from. Its module is imported when the name is first asked for.
_MODULES = {
    "boards": ("Boards", "BoardScan", "open_all"),
    "estimate.base": ("Estimate", "Estimator", "SkinKnowledge", "WireOhm"),
    "estimate.methods": ("METHODS", "make_estimator"),
    "force.calibrated_device": ("CalibratedDevice",),
    "force.calibration": ("Calibration", "load_calibration"),
    "force.contacts": ("Contact",),
    "force.force_reader": ("ForceScan",),
    "link.clock": ("BoardClock",),
    "link.device": ("Device",),
    "link.messages": ("BoardStats", "Hello", "Scan", "SelfTestReport"),
    "opening": ("open",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            globals()[name] = found = getattr(import_module(f"ohmskin.{module}"), name)
            return found
    raise AttributeError(f"module 'ohmskin' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
