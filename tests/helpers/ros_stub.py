# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for what examples/ros2_node.py uses of ROS 2, for machines without it.

Messages have the fields of std_msgs, sensor_msgs and builtin_interfaces (ros2/common_interfaces),
and are as strict as Python messages that rosidl generates: no other field, no value of another
type, no NumPy scalar for a number, no NumPy array for a sequence. Not modelled: the rest of ROS.
"""

import time
from array import array
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar, NamedTuple


class Kind(NamedTuple):
    """What a field holds at first, and whether it may hold a value."""

    default: Callable[[], Any]
    fits: Callable[[Any], bool]


def one(kind: type) -> Kind:
    return Kind(kind, lambda value: isinstance(value, kind))


def integer(least: int, end: int) -> Kind:
    return Kind(int, lambda value: isinstance(value, int) and least <= value < end)


def numbers(typecode: str) -> Kind:
    return Kind(
        lambda: array(typecode),
        lambda value: isinstance(value, array) and value.typecode == typecode,
    )


def many(kind: type) -> Kind:
    return Kind(
        list,
        lambda value: isinstance(value, list) and all(isinstance(each, kind) for each in value),
    )


UINT8, UINT32, INT32 = integer(0, 2**8), integer(0, 2**32), integer(-(2**31), 2**31)


class Message:
    FIELDS: ClassVar[dict[str, Kind]] = {}

    def __init__(self, **values: Any) -> None:
        for name, kind in self.FIELDS.items():
            setattr(self, name, values.pop(name, kind.default()))
        assert not values, f"invalid arguments {values}"

    def __setattr__(self, name: str, value: Any) -> None:
        assert self.FIELDS[name].fits(value), f"field {name} must not be {value!r}"
        super().__setattr__(name, value)


def message(name: str, /, **fields: Kind) -> type[Message]:
    return type(name, (Message,), {"FIELDS": fields})


BuiltinTime = message("Time", sec=INT32, nanosec=UINT32)
Header = message("Header", stamp=one(BuiltinTime), frame_id=one(str))
MultiArrayDimension = message("MultiArrayDimension", label=one(str), size=UINT32, stride=UINT32)
MultiArrayLayout = message("MultiArrayLayout", dim=many(MultiArrayDimension), data_offset=UINT32)
Float32MultiArray = message("Float32MultiArray", layout=one(MultiArrayLayout), data=numbers("f"))


class PointField(message("PointField", name=one(str), offset=UINT32, datatype=UINT8, count=UINT32)):
    FLOAT32 = 7


PointCloud2 = message(
    "PointCloud2",
    header=one(Header),
    **dict.fromkeys(("height", "width", "point_step", "row_step"), UINT32),
    **dict.fromkeys(("is_bigendian", "is_dense"), one(bool)),
    fields=many(PointField),
    data=numbers("B"),
)


class Time:
    """rclpy.time.Time"""

    def __init__(self, *, nanoseconds: int) -> None:
        assert isinstance(nanoseconds, int)
        self.nanoseconds = nanoseconds

    def to_msg(self) -> BuiltinTime:
        sec, nanosec = divmod(self.nanoseconds, 10**9)
        return BuiltinTime(sec=sec, nanosec=nanosec)


class Ros:
    """A ROS that is shut down after so many turns. published: (topic, message)."""

    def __init__(self, parameters: dict[str, Any], turns: int) -> None:
        self.parameters = parameters
        self.turns = turns
        self.published: list[tuple[str, Message]] = []
        self.shut_down = False

    def modules(self) -> dict[str, ModuleType]:
        ros = self

        class Node:
            def __init__(self, node_name: str) -> None:
                self.name = node_name

            def declare_parameter(self, name: str, value: Any = None) -> SimpleNamespace:
                return SimpleNamespace(value=ros.parameters.get(name, value))

            def create_publisher(
                self, msg_type: type[Message], topic: str, qos_profile: int
            ) -> SimpleNamespace:
                assert qos_profile > 0

                def publish(message: Message) -> None:
                    assert isinstance(message, msg_type)
                    ros.published.append((topic, message))

                return SimpleNamespace(publish=publish)

            def get_clock(self) -> SimpleNamespace:
                return SimpleNamespace(now=lambda: Time(nanoseconds=time.time_ns()))

            def destroy_node(self) -> None:
                pass

        def spin_once(node: Node, *, timeout_sec: float | None = None) -> None:
            assert isinstance(node, Node)
            ros.turns -= 1

        def try_shutdown() -> None:
            ros.shut_down = True

        rclpy = {
            "init": lambda args=None: None,
            "ok": lambda: ros.turns > 0,
            "spin_once": spin_once,
            "try_shutdown": try_shutdown,
        }
        shutdown = type("ExternalShutdownException", (Exception,), {})
        messages = {"PointCloud2": PointCloud2, "PointField": PointField}
        standard = [Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout]
        return {
            "rclpy": module("rclpy", rclpy),
            "rclpy.executors": module("rclpy.executors", {"ExternalShutdownException": shutdown}),
            "rclpy.node": module("rclpy.node", {"Node": Node}),
            "rclpy.time": module("rclpy.time", {"Time": Time}),
            "sensor_msgs": module("sensor_msgs", {}),
            "sensor_msgs.msg": module("sensor_msgs.msg", messages),
            "std_msgs": module("std_msgs", {}),
            "std_msgs.msg": module("std_msgs.msg", {each.__name__: each for each in standard}),
        }


def module(name: str, contents: dict[str, Any]) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(contents)
    return made
