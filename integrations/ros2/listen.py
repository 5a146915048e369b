# SPDX-License-Identifier: Apache-2.0
"""Print the forces that the node publishes, until Ctrl-C: python listen.py"""

from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2


def show(cloud: PointCloud2) -> None:
    cells = np.frombuffer(cloud.data, "<f4").reshape(cloud.height, cloud.width, -1)
    force_n, std_n = cells[..., 6], cells[..., 7]  # the order is in the message, cloud.fields
    force_n = np.where(force_n > 2 * std_n, force_n, 0.0)  # all others may be noise, or not known
    row, column = np.unravel_index(force_n.argmax(), force_n.shape)
    print(f"{force_n.sum():.2f} N in all, most of it on cell ({row}, {column})", flush=True)


rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(PointCloud2, "/ohmskin/points", show, qos_profile_sensor_data)
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
