# SPDX-License-Identifier: Apache-2.0
"""The force map of a skin as an image of 8 bits: what policies that see can see."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError
from numpy.typing import NDArray

import ohmskin
from ohmskin.link.serial_port import serial_ports

# A board has so long for its first scan [s]: opening a port resets most boards.
FIRST_SCAN_S = 20.0


@CameraConfig.register_subclass("ohmskin")
@dataclass(kw_only=True)
class OhmskinCameraConfig(CameraConfig):
    """port, calibration: as `ohmskin.open` takes them. force_max_n: the force of the value 255 [N].

    Red is force / force_max_n, green its standard deviation on the same scale, blue is 255 where a
    cell has no force. A cell is a block of 16x16 pixels unless width and height say otherwise.
    """

    port: str
    calibration: str
    force_max_n: float = 20.0

    def __post_init__(self) -> None:
        known = ohmskin.load_calibration(self.calibration)
        self.fps = self.fps or 30
        self.height = self.height or 16 * known.rows
        self.width = self.width or 16 * known.columns


def _now_s(skin: ohmskin.LiveSkin) -> float:
    """Now, by the clock of `Scan.host_time_s` [s]: that of the day may be set at any time."""
    try:
        return skin.there()[0].now_s
    except ohmskin.DeviceLost:
        return time.monotonic()


class OhmskinCamera(Camera):
    """See `OhmskinCameraConfig`. A board that is unplugged and plugged again goes on."""

    def __init__(self, config: OhmskinCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.skin: ohmskin.LiveSkin | None = None
        self._count = 0

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called, and `disconnect` not since."""
        return self.skin is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The serial ports that are probably boards."""
        return [
            {"type": "ohmskin", "id": port.path, "name": port.board}
            for port in serial_ports()
            if port.board
        ]

    def connect(self, warmup: bool = True) -> None:
        """Open the port, and wait for the first scan."""
        if self.skin is not None:
            said = f"{self.config.port} is connected already: call disconnect() first"
            raise DeviceAlreadyConnectedError(said)
        self._count = 0  # a new skin counts from 0
        self.skin = ohmskin.LiveSkin(self.config.port, self.config.calibration)
        try:
            if warmup:
                self.async_read(1e3 * FIRST_SCAN_S)
        except TimeoutError:
            self.disconnect()
            raise

    def _open(self) -> ohmskin.LiveSkin:
        if self.skin is None:
            raise ConnectionError(f"{self.config.port} is not connected")
        return self.skin

    def _image(self, scan: ohmskin.ForceScan) -> NDArray[np.uint8]:
        shares = np.stack([scan.force_n, scan.force_n_std], -1) / self.config.force_max_n
        known = np.clip(255 * np.nan_to_num(shares), 0, 255).round()
        unknown = 255.0 * np.isnan(scan.force_n)[..., None]
        small = np.concatenate([known, unknown], -1).astype(np.uint8)
        rows, columns = scan.force_n.shape
        row = np.arange(self.height) * rows // self.height
        column = np.arange(self.width) * columns // self.width
        return small[row[:, None], column]

    def async_read(self, timeout_ms: float = 200) -> NDArray[np.uint8]:
        """The newest image that was not given yet. Raises TimeoutError if none comes in time."""
        skin = self._open()
        self._count, scans = skin.since(self._count, 1e-3 * timeout_ms)
        if not scans:
            raise TimeoutError(f"{skin.port}: no scan in {timeout_ms:g} ms: {skin.failure or ''}")
        return self._image(scans[-1])

    def read(self) -> NDArray[np.uint8]:
        """The next image."""
        return self.async_read(1e3 * FIRST_SCAN_S)

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        """The newest image, at once. Raises TimeoutError if it is older than that."""
        skin = self._open()
        newest = skin.newest()
        if newest is None or 1e3 * (_now_s(skin) - newest.host_time_s) > max_age_ms:
            raise TimeoutError(f"{self.config.port}: no scan of the last {max_age_ms} ms")
        return self._image(newest)

    def disconnect(self) -> None:
        """Close the port."""
        if self.skin is not None:
            self.skin.close()
            self.skin = None
