# SPDX-License-Identifier: Apache-2.0
"""Another robot, with every scan since the last frame in its state.

A frame of 30 Hz has three scans of 90 Hz, sometimes more. So a frame has places for `SCANS` of
them, the oldest first, and says how many are valid. The others are zeros, and their numbers -1:
one NaN would make the statistics of the whole feature NaN.
"""

import logging
from dataclasses import dataclass, field
from typing import Any

import draccus
import numpy as np
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from numpy.typing import NDArray

import ohmskin
from lerobot_camera_ohmskin.camera import FIRST_SCAN_S

# Places for scans in a frame. A fixed window of 5 lost 137 of 2,029 scans at 30 Hz; 16 are a pause
# of 180 ms, and what is left after a longer one is in the next frames.
SCANS = 16

_LOG = logging.getLogger(__name__)


@dataclass
class SkinConfig:
    """port, calibration: as `ohmskin.open` takes them."""

    port: str
    calibration: str


@RobotConfig.register_subclass("ohmskin")
@dataclass(kw_only=True)
class OhmskinRobotConfig(RobotConfig):
    """robot: the options of the robot itself, with its type. skins: by their names in the state.

    The options are no `RobotConfig`: LeRobot's command line lists the options of all robots, and
    those of a robot in a robot would have no end.
    """

    robot: dict[str, Any]
    skins: dict[str, SkinConfig] = field(default_factory=dict)


class Window:
    """The scans of one skin since it was last asked, as a frame has them.

    lost: how many came while nobody asked for so long that they were not kept, some 11 s.
    """

    def __init__(self, name: str, config: SkinConfig) -> None:
        known = ohmskin.load_calibration(config.calibration)
        self._config, self._skin, self._count = config, None, 0
        self._shape = (SCANS, known.rows, known.columns)
        cells = [f"{name}.force.{t}.{r}.{c}" for t, r, c in np.ndindex(self._shape)]
        self.names = [*cells, *(f"{name}.number.{t}" for t in range(SCANS)), f"{name}.valid"]
        self.lost = 0

    def connect(self) -> None:
        """Open the port, wait for a scan, and begin after it."""
        self._skin = ohmskin.LiveSkin(self._config.port, self._config.calibration)
        self._count, scans = self._skin.since(0, FIRST_SCAN_S)
        if not scans:
            failure = self._skin.failure
            self.disconnect()
            raise ConnectionError(f"{self._config.port} gives no scans: {failure}")

    def take(self) -> NDArray[np.float32]:
        """Forces [N] (`SCANS`, R, C), flat; numbers (`SCANS`,); how many are valid."""
        count, scans = self._skin.since(self._count)
        kept = scans[:SCANS]  # those that find no place come in the next frame
        self.lost += count - self._count - len(scans)
        self._count = count - len(scans) + len(kept)
        force_n, numbers = np.zeros(self._shape, np.float32), np.full(SCANS, -1, np.float32)
        for place, scan in enumerate(kept):
            force_n[place] = np.nan_to_num(scan.force_n)
            numbers[place] = scan.number
        return np.concatenate([force_n.ravel(), numbers, [len(kept)]]).astype(np.float32)

    def disconnect(self) -> None:
        """Close the port."""
        if self._skin is not None:
            self._skin.close()
            skipped = f"{self._skin.skipped} scans skipped by a busy machine"
            _LOG.info("%s: %s, %d lost in pauses", self._config.port, skipped, self.lost)
            self._skin = None


class OhmskinRobot(Robot):
    """See the module. All but the observation is the robot's own."""

    config_class = OhmskinRobotConfig
    name = "ohmskin"

    def __init__(self, config: OhmskinRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot = make_robot_from_config(draccus.decode(RobotConfig, config.robot))
        self.windows = [Window(name, skin) for name, skin in config.skins.items()]

    def __getattr__(self, name: str) -> Any:
        if name == "robot":  # __init__ has not come so far
            raise AttributeError(name)
        return getattr(self.robot, name)  # such as `cameras`, which programs of LeRobot ask for

    @property
    def observation_features(self) -> dict[str, Any]:
        """Those of the robot, and a float for each number of each window."""
        more = {name: float for window in self.windows for name in window.names}
        return {**self.robot.observation_features, **more}

    @property
    def action_features(self) -> dict[str, Any]:
        """Those of the robot."""
        return self.robot.action_features

    @property
    def is_connected(self) -> bool:
        """Whether the robot is."""
        return self.robot.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the robot is."""
        return self.robot.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        """Connect the robot, then the skins."""
        self.robot.connect(calibrate)
        for window in self.windows:
            window.connect()

    def calibrate(self) -> None:
        """Calibrate the robot; skins have their files."""
        self.robot.calibrate()

    def configure(self) -> None:
        """Configure the robot."""
        self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        """The robot's, and the scans since the last one."""
        observation = self.robot.get_observation()
        for window in self.windows:
            observation |= zip(window.names, window.take().tolist(), strict=True)
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send it to the robot."""
        return self.robot.send_action(action)

    def disconnect(self) -> None:
        """Disconnect the skins, then the robot."""
        for window in self.windows:
            window.disconnect()
        self.robot.disconnect()
