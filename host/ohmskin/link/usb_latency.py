# SPDX-License-Identifier: Apache-2.0
"""The latency timer of a USB serial bridge on Linux: how long it holds back a few bytes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

USB_SERIAL: Final = Path("/sys/bus/usb-serial/devices")


def latency_timer_file(port: str, devices: Path = USB_SERIAL) -> Path:
    """Where the timer of a port is set, whether it has one or not; links are followed."""
    return devices / Path(os.path.realpath(port)).name / "latency_timer"


def latency_ms(port: str, devices: Path = USB_SERIAL) -> int | None:
    """The timer of a port [ms]; None where there is none to be read, as on other systems."""
    try:
        return int(latency_timer_file(port, devices).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
