# SPDX-License-Identifier: Apache-2.0
"""ros2 launch ohmskin_ros skin.launch.py port:=/dev/ttyACM0 calibration:=skin.json"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

ARGUMENTS = {"port": "/dev/ttyACM0", "calibration": "skin.json", "frame_id": "", "every": "true"}
TYPES = {"every": bool}  # all others are text, also where it looks like a number


def generate_launch_description() -> LaunchDescription:
    """The node, with its name and its parameters as arguments."""
    told = {
        name: ParameterValue(LaunchConfiguration(name), value_type=TYPES.get(name, str))
        for name in ARGUMENTS
    }
    name = LaunchConfiguration("name")
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=usual)
                for name, usual in ARGUMENTS.items()
            ),
            DeclareLaunchArgument("name", default_value="ohmskin"),
            Node(package="ohmskin_ros", executable="skin", name=name, parameters=[told]),
        ]
    )
