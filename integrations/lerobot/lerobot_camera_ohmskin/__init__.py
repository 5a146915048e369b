# SPDX-License-Identifier: Apache-2.0
"""A skin in LeRobot. LeRobot imports this by its name, which registers both types "ohmskin":

`OhmskinCamera`   the force map as an image
`OhmskinRobot`    another robot, with every scan since the last frame in its state
"""

from lerobot_camera_ohmskin.camera import OhmskinCamera, OhmskinCameraConfig
from lerobot_camera_ohmskin.robot import OhmskinRobot, OhmskinRobotConfig, SkinConfig

__all__ = [
    "OhmskinCamera",
    "OhmskinCameraConfig",
    "OhmskinRobot",
    "OhmskinRobotConfig",
    "SkinConfig",
]
