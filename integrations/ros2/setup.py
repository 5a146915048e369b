# SPDX-License-Identifier: Apache-2.0
"""An ament_python package: colcon builds it, and so does pip."""

from setuptools import setup

ROS = "rclpy[fastrtps]", "sensor-msgs", "std-srvs", "diagnostic-msgs"
PYPI = [f"ros-kilted-{name}" for name in ROS]

setup(
    name="ohmskin_ros",
    version="0.1.0",
    packages=["ohmskin_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/ohmskin_ros"]),
        ("share/ohmskin_ros", ["package.xml"]),
        ("share/ohmskin_ros/launch", ["launch/skin.launch.py"]),
    ],
    install_requires=["setuptools", "numpy>=1.26", "ohmskin>=0.1"],
    extras_require={
        "pypi": PYPI,  # ROS itself has these
        "test": [*PYPI, "pytest>=8", "colcon-ros>=0.5"],
    },
    zip_safe=True,
    license="Apache-2.0",
    description="Forces of a resistive tactile skin as point clouds, images and diagnostics",
    entry_points={"console_scripts": ["skin = ohmskin_ros.node:main"]},
)
