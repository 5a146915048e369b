# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node that publishes the forces of a skin, each scan at the time of its middle.

~/forces  std_msgs/Float32MultiArray   normal force of each cell, rows x columns [N]
~/taxels  sensor_msgs/PointCloud2      x along columns, y along rows, z [m], force [N] and its
                                       standard deviation, force_std [N]

Parameters: port, calibration, pitch_m (from cell to cell), frame_id. In a shell with ROS 2, with an
emulated skin and made-up presses:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json --indenter-mm2 80
    python examples/ros2_node.py --ros-args -p calibration:=skin.json \
        -p "port:='emulator://8x8?scene=moving'"
"""

from array import array
from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout

import ohmskin

FIELDS = ("x", "y", "z", "force", "force_std")


class SkinNode(Node):
    def __init__(self) -> None:
        super().__init__("ohmskin")
        self.port = self.declare_parameter("port", "/dev/ttyACM0").value
        self.calibration = self.declare_parameter("calibration", "skin.json").value
        self.pitch_m = self.declare_parameter("pitch_m", 0.01).value
        self.frame_id = self.declare_parameter("frame_id", "skin").value
        self.forces = self.create_publisher(Float32MultiArray, "~/forces", 10)
        self.taxels = self.create_publisher(PointCloud2, "~/taxels", 10)

    def publish(self, scan: ohmskin.ForceScan) -> None:
        stamp = Time(nanoseconds=scan.time_ns)
        self.forces.publish(multi_array(scan.force_n))
        header = Header(stamp=stamp.to_msg(), frame_id=self.frame_id)
        self.taxels.publish(point_cloud(scan, self.pitch_m, header))


def multi_array(force_n: np.ndarray) -> Float32MultiArray:
    rows, columns = force_n.shape
    dim = [
        MultiArrayDimension(label="rows", size=rows, stride=rows * columns),
        MultiArrayDimension(label="columns", size=columns, stride=columns),
    ]
    octets = force_n.astype(np.float32).tobytes()
    return Float32MultiArray(layout=MultiArrayLayout(dim=dim), data=array("f", octets))


def point_cloud(scan: ohmskin.ForceScan, pitch_m: float, header: Header) -> PointCloud2:
    rows, columns = scan.force_n.shape
    points = np.zeros((rows, columns, len(FIELDS)), dtype="<f4")
    points[:, :, 0] = pitch_m * np.arange(columns)
    points[:, :, 1] = pitch_m * np.arange(rows)[:, None]
    points[:, :, 3] = scan.force_n
    points[:, :, 4] = scan.force_n_std
    return PointCloud2(
        header=header,
        height=rows,
        width=columns,
        fields=[
            PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
            for index, name in enumerate(FIELDS)
        ],
        is_bigendian=False,
        point_step=4 * len(FIELDS),
        row_step=4 * len(FIELDS) * columns,
        data=array("B", points.tobytes()),
        is_dense=bool(np.isfinite(points).all()),
    )


def main() -> None:
    rclpy.init()
    node = SkinNode()
    with (
        suppress(KeyboardInterrupt, ExternalShutdownException),
        ohmskin.open(node.port, calibration=node.calibration) as skin,
    ):
        for scan in skin:
            if not rclpy.ok():
                break
            node.publish(scan)
            rclpy.spin_once(node, timeout_sec=0)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
