# SPDX-License-Identifier: Apache-2.0
"""Reads resistive tactile skins: from a board's bytes to the resistance of every cell.

import ohmskin

with ohmskin.open("/dev/ttyACM0") as skin:
    for scan in skin:
        print(scan.number, scan.ratio[0, 0])
"""

TYPE_CHECKING = False  # for type checkers: to import typing takes longer than all of this
if TYPE_CHECKING:  # "as" says that a name is public
    from typing import Any

    from ohmskin.emulate.driver import SteppedSkin as SteppedSkin
    from ohmskin.errors import CommandRefused as CommandRefused
    from ohmskin.errors import DeviceLost as DeviceLost
    from ohmskin.errors import DeviceSilent as DeviceSilent
    from ohmskin.errors import OhmskinError as OhmskinError
    from ohmskin.errors import PortError as PortError
    from ohmskin.errors import ProtocolError as ProtocolError
    from ohmskin.errors import ProtocolMismatch as ProtocolMismatch
    from ohmskin.errors import RecordingEnded as RecordingEnded
    from ohmskin.errors import RecordingError as RecordingError
    from ohmskin.errors import TareRefused as TareRefused
    from ohmskin.estimate.base import Estimate as Estimate
    from ohmskin.estimate.base import Estimator as Estimator
    from ohmskin.estimate.knowledge import SkinKnowledge as SkinKnowledge
    from ohmskin.estimate.knowledge import WireOhm as WireOhm
    from ohmskin.estimate.methods import METHODS as METHODS
    from ohmskin.estimate.methods import make_estimator as make_estimator
    from ohmskin.force.calibration import Calibration as Calibration
    from ohmskin.force.calibration import load_calibration as load_calibration
    from ohmskin.force.contacts import Contact as Contact
    from ohmskin.force.reader import CalibratedSkin as CalibratedSkin
    from ohmskin.force.reader import ForceScan as ForceScan
    from ohmskin.force.simulated import SimulatedSkin as SimulatedSkin
    from ohmskin.force.tables import load_forces as load_forces
    from ohmskin.link.clock import BoardClock as BoardClock
    from ohmskin.link.device import Device as Device
    from ohmskin.link.device import Region as Region
    from ohmskin.link.messages import BoardStats as BoardStats
    from ohmskin.link.messages import Hello as Hello
    from ohmskin.link.messages import Scan as Scan
    from ohmskin.link.messages import SelfTestReport as SelfTestReport
    from ohmskin.live import LiveSkin as LiveSkin
    from ohmskin.opening import open as open
    from ohmskin.record.recording import load_recording as load_recording
    from ohmskin.several_boards import Boards as Boards
    from ohmskin.several_boards import BoardScan as BoardScan
    from ohmskin.several_boards import open_all as open_all
    from ohmskin.version import __version__ as __version__

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
if not TYPE_CHECKING:  # a type checker reads no list that is computed: it goes by the imports
    __all__ = [name for names in _MODULES.values() for name in names if name != "__version__"]


def __getattr__(name: str) -> "Any":
    from importlib import import_module

    for module, names in _MODULES.items():
        if name in names:
            # Kept here, so that the name is looked up once.
            globals()[name] = public = getattr(import_module(f"ohmskin.{module}"), name)
            return public
    raise AttributeError(f"module 'ohmskin' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *(name for names in _MODULES.values() for name in names)})
