# SPDX-License-Identifier: Apache-2.0
"""Types of the fixtures in conftest.py that give ports, and how Arduino's boards are known."""

from collections.abc import Callable

from ohmskin.emulate.driver import PtyServer

Serve = Callable[..., PtyServer]
Attach = Callable[..., None]
# Vendor and product of USB bridges, as in boards.txt of Arduino's AVR core; a Pico's own.
USB_IDS = {
    "uno": (0x2341, 0x0043),
    "megaatmega2560": (0x2341, 0x0042),
    "pico": (0x1209, 0x0001),
    "": (None, None),
}
