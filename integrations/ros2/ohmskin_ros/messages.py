# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 from a scan."""

import time
from array import array

import numpy as np
from rclpy.time import Time
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

import ohmskin

FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "force", "force_std")


def header(scan: ohmskin.ForceScan, frame_id: str) -> Header:
    """The time of the scan's middle, and the frame."""
    return Header(stamp=Time(nanoseconds=scan.time_ns).to_msg(), frame_id=frame_id)


def stamp_off_s(scan: ohmskin.ForceScan) -> float:
    """How much later the clock of the day is than that of the scan's stamp [s].

    The stamp is by the clock of the day as it was when the port was opened. A recording that is
    played has the stamps that it was made with.
    """
    came_s = 1e-9 * time.time_ns() - (time.monotonic() - scan.host_time_s)
    return came_s - 1e-9 * scan.time_ns


def point_cloud(scan: ohmskin.ForceScan, head: Header) -> PointCloud2:
    """A point a cell: position [m], normal, force and its deviation [N], all as 32-bit floats."""
    placed = scan.geometry
    newtons = [scan.force_n[..., None], scan.force_n_std[..., None]]
    cells = np.concatenate([placed.position_m, placed.normal, *newtons], axis=-1).astype("<f4")
    rows, columns, count = cells.shape
    return PointCloud2(
        header=head,
        height=rows,
        width=columns,
        fields=[
            PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
            for index, name in enumerate(FIELDS)
        ],
        is_bigendian=False,
        point_step=4 * count,
        row_step=4 * count * columns,
        data=array("B", cells.tobytes()),
        is_dense=bool(np.isfinite(cells).all()),
    )


def image(scan: ohmskin.ForceScan, head: Header) -> Image:
    """The forces [N] as an image of one pixel a cell, 32FC1."""
    forces = scan.force_n.astype("<f4")
    rows, columns = forces.shape
    return Image(
        header=head,
        height=rows,
        width=columns,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * columns,
        data=array("B", forces.tobytes()),
    )
