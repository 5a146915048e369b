# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for what examples/ros2_node.py uses of ROS 2, for machines without it.

Messages have the fields of std_msgs, sensor_msgs and builtin_interfaces (ros2/common_interfaces),
and are as strict as Python messages that rosidl generates: no other field, no value of another
type, no NumPy scalar for a number, no NumPy array for a sequence. Not modelled: the rest of ROS.
"""

import time
from array import array
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, ClassVar

_INTEGERS = {"uint8": (0, 2**8), "uint32": (0, 2**32), "int32": (-(2**31), 2**31)}
_ARRAYS = {"float32[]": "f", "uint8[]": "B"}


class Message:
    FIELDS: ClassVar[dict[str, Any]] = {}

    def __init__(self, **values: Any) -> None:
        assert set(values) <= set(self.FIELDS), f"invalid arguments {set(values)}"
        for name, kind in self.FIELDS.items():
            setattr(self, name, values.get(name, default(kind)))

    def __setattr__(self, name: str, value: Any) -> None:
        kind = self.FIELDS[name]
        assert fits(kind, value), f"field {name} must be {kind}, not {value!r}"
        if isinstance(kind, str) and kind in _ARRAYS:
            value = array(_ARRAYS[kind], value)
        super().__setattr__(name, value)


def default(kind: Any) -> Any:
    if isinstance(kind, list):
        return []
    if isinstance(kind, type):
        return kind()
    return {"string": "", "bool": False}.get(kind, [] if kind in _ARRAYS else 0)


def fits(kind: Any, value: Any) -> bool:
    if isinstance(kind, list):
        return is_sequence(value) and all(isinstance(each, kind[0]) for each in value)
    if isinstance(kind, type):
        return isinstance(value, kind)
    if kind in _ARRAYS:
        if isinstance(value, array):
            return value.typecode == _ARRAYS[kind]
        element = float if kind == "float32[]" else int
        return is_sequence(value) and all(isinstance(each, element) for each in value)
    if kind in _INTEGERS:
        least, end = _INTEGERS[kind]
        return isinstance(value, int) and least <= value < end
    return isinstance(value, {"string": str, "bool": bool}[kind])


def is_sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def message(name: str, /, **fields: Any) -> type[Message]:
    return type(name, (Message,), {"FIELDS": fields})


BuiltinTime = message("Time", sec="int32", nanosec="uint32")
Header = message("Header", stamp=BuiltinTime, frame_id="string")
MultiArrayDimension = message("MultiArrayDimension", label="string", size="uint32", stride="uint32")
MultiArrayLayout = message("MultiArrayLayout", dim=[MultiArrayDimension], data_offset="uint32")
Float32MultiArray = message("Float32MultiArray", layout=MultiArrayLayout, data="float32[]")


class PointField(
    message("PointField", name="string", offset="uint32", datatype="uint8", count="uint32")
):
    INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64 = range(1, 9)


PointCloud2 = message(
    "PointCloud2",
    header=Header,
    **dict.fromkeys(("height", "width", "point_step", "row_step"), "uint32"),
    **dict.fromkeys(("is_bigendian", "is_dense"), "bool"),
    fields=[PointField],
    data="uint8[]",
)


class Time:
    """rclpy.time.Time"""

    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = round(seconds * 1e9) + nanoseconds

    def to_msg(self) -> BuiltinTime:
        sec, nanosec = divmod(self.nanoseconds, 10**9)
        return BuiltinTime(sec=sec, nanosec=nanosec)


class Parameter:
    def __init__(self, value: Any) -> None:
        self.value = value


class Ros:
    """A ROS that is shut down after so many turns. published: (topic, message)."""

    def __init__(self, parameters: dict[str, Any], turns: int) -> None:
        self.parameters = parameters
        self.turns = turns
        self.published: list[tuple[str, Message]] = []
        self.shut_down = False

    def modules(self) -> dict[str, ModuleType]:
        ros = self

        class Publisher:
            def __init__(self, kind: type[Message], topic: str) -> None:
                self.kind, self.topic = kind, topic

            def publish(self, message: Message) -> None:
                assert isinstance(message, self.kind)
                ros.published.append((self.topic, message))

        class Clock:
            def now(self) -> Time:
                return Time(nanoseconds=time.time_ns())

        class Node:
            def __init__(self, node_name: str) -> None:
                self.name = node_name

            def declare_parameter(self, name: str, value: Any = None) -> Parameter:
                return Parameter(ros.parameters.get(name, value))

            def create_publisher(
                self, msg_type: type[Message], topic: str, qos_profile: int
            ) -> Publisher:
                assert issubclass(msg_type, Message)
                assert qos_profile > 0
                return Publisher(msg_type, topic)

            def get_clock(self) -> Clock:
                return Clock()

            def destroy_node(self) -> None:
                pass

        def spin_once(node: Node, *, timeout_sec: float | None = None) -> None:
            assert isinstance(node, Node)
            ros.turns -= 1

        def try_shutdown() -> None:
            ros.shut_down = True

        functions: dict[str, Callable[..., Any]] = {
            "init": lambda args=None: None,
            "ok": lambda: ros.turns > 0,
            "spin_once": spin_once,
            "try_shutdown": try_shutdown,
        }
        shutdown = type("ExternalShutdownException", (Exception,), {})
        messages = {"PointCloud2": PointCloud2, "PointField": PointField}
        standard = [Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout]
        return {
            "rclpy": module("rclpy", functions),
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
