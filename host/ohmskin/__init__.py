# SPDX-License-Identifier: Apache-2.0
"""Reads resistive tactile skins: from a board's bytes to the resistance of every cell.

import ohmskin

with ohmskin.open("/dev/ttyACM0") as skin:
    for scan in skin:
        print(scan.number, scan.ratio[0, 0])
"""

TYPE_CHECKING = False  # for type checkers: to import typing takes longer than all of this
if TYPE_CHECKING:
    from typing import Any

    from ohmskin.emulate.driver import SteppedSkin
    from ohmskin.errors import (
        CommandRefused,
        DeviceLost,
        DeviceSilent,
        OhmskinError,
        PortError,
        ProtocolError,
        ProtocolMismatch,
        RecordingEnded,
        RecordingError,
        TareRefused,
    )
    from ohmskin.estimate.base import Estimate, Estimator
    from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
    from ohmskin.estimate.methods import METHODS, make_estimator
    from ohmskin.force.calibration import Calibration, load_calibration
    from ohmskin.force.contacts import Contact
    from ohmskin.force.reader import CalibratedSkin, ForceScan
    from ohmskin.force.simulated import SimulatedSkin
    from ohmskin.force.tables import load_forces
    from ohmskin.link.clock import BoardClock
    from ohmskin.link.device import Device, Region
    from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport
    from ohmskin.live import LiveSkin
    from ohmskin.opening import open
    from ohmskin.record.recording import load_recording
    from ohmskin.several_boards import Boards, BoardScan, open_all
    from ohmskin.version import __version__ as __version__

__all__ = [
    "METHODS",
    "BoardClock",
    "BoardScan",
    "BoardStats",
    "Boards",
    "CalibratedSkin",
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
    "LiveSkin",
    "OhmskinError",
    "PortError",
    "ProtocolError",
    "ProtocolMismatch",
    "RecordingEnded",
    "RecordingError",
    "Region",
    "Scan",
    "SelfTestReport",
    "SimulatedSkin",
    "SkinKnowledge",
    "SteppedSkin",
    "TareRefused",
    "WireOhm",
    "load_calibration",
    "load_forces",
    "load_recording",
    "make_estimator",
    "open",
    "open_all",
]

# Public names by the module that has them. A module is imported when one of its names is first
# asked for: a program that only reads a board need not wait for scipy. And while nothing is
# imported, Ctrl-C finds no import of the package to show a traceback of.
_MODULES = {
    "emulate.driver": ("SteppedSkin",),
    "errors": (
        *("CommandRefused", "DeviceLost", "DeviceSilent", "OhmskinError", "PortError"),
        *("ProtocolError", "ProtocolMismatch", "RecordingEnded", "RecordingError", "TareRefused"),
    ),
    "estimate.base": ("Estimate", "Estimator"),
    "estimate.knowledge": ("SkinKnowledge", "WireOhm"),
    "estimate.methods": ("METHODS", "make_estimator"),
    "force.calibration": ("Calibration", "load_calibration"),
    "force.contacts": ("Contact",),
    "force.reader": ("CalibratedSkin", "ForceScan"),
    "force.simulated": ("SimulatedSkin",),
    "force.tables": ("load_forces",),
    "link.clock": ("BoardClock",),
    "link.device": ("Device", "Region"),
    "link.messages": ("BoardStats", "Hello", "Scan", "SelfTestReport"),
    "live": ("LiveSkin",),
    "opening": ("open",),
    "record.recording": ("load_recording",),
    "several_boards": ("BoardScan", "Boards", "open_all"),
    "version": ("__version__",),
}


def __getattr__(name: str) -> "Any":
    from importlib import import_module

    for module, names in _MODULES.items():
        if name in names:
            # Kept here, so that the name is looked up once.
            globals()[name] = public = getattr(import_module(f"ohmskin.{module}"), name)
            return public
    raise AttributeError(f"module 'ohmskin' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
