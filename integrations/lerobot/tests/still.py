# SPDX-License-Identifier: Apache-2.0
"""A robot of one joint that stays where it is, and what moves it, as a plugin of LeRobot."""

from dataclasses import dataclass

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINT = {"joint.pos": float}


@RobotConfig.register_subclass("still")
@dataclass(kw_only=True)
class StillConfig(RobotConfig):
    pass


class Still(Robot):
    config_class, name = StillConfig, "still"
    observation_features = action_features = property(lambda self: JOINT)
    is_connected = is_calibrated = True
    cameras = property(lambda self: {})

    def connect(self, calibrate: bool = True) -> None:
        pass

    calibrate = configure = disconnect = lambda self: None

    def get_observation(self) -> dict:
        return {"joint.pos": 0.5}

    def send_action(self, action: dict) -> dict:
        return action


@TeleoperatorConfig.register_subclass("still")
@dataclass(kw_only=True)
class StillTeleopConfig(TeleoperatorConfig):
    pass


class StillTeleop(Teleoperator):
    config_class, name = StillTeleopConfig, "still"
    action_features = property(lambda self: JOINT)
    feedback_features = property(lambda self: {})
    is_connected = is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        pass

    calibrate = configure = disconnect = lambda self: None

    def get_action(self) -> dict:
        return {"joint.pos": 0.5}

    def send_feedback(self, feedback: dict) -> None:
        pass
