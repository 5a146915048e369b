# SPDX-License-Identifier: Apache-2.0
"""A stand-in for what examples/lsl_outlet.py uses of pylsl, where that or its library is absent."""

import time
from dataclasses import dataclass
from types import ModuleType
from typing import Final, Self
from xml.etree.ElementTree import Element

CLOCK_OFFSET_S: Final = 1000.0  # a local_clock() that is not time.monotonic()
ENOUGH = 12  # samples, then somebody presses Ctrl-C


class XMLElement(Element):
    def append_child(self, name: str) -> Self:
        child = type(self)(name)
        self.append(child)
        return child

    def append_child_value(self, name: str, value: str) -> Self:
        assert isinstance(value, str)
        self.append_child(name).text = value
        return self


@dataclass
class StreamInfo:
    name: str = "untitled"
    type: str = ""
    channel_count: int = 1
    nominal_srate: float = 0.0
    channel_format: str = "float32"
    source_id: str | None = None

    def __post_init__(self) -> None:
        self._desc = XMLElement("desc")

    def desc(self) -> XMLElement:
        return self._desc

    def get_channel(self, name: str) -> list[str | None]:
        return [value.text for value in self._desc.findall(f"channels/channel/{name}")]


def pylsl_module(samples: list[tuple[list[float], float]], infos: list[StreamInfo]) -> ModuleType:
    """`pylsl` whose outlets append to `samples` (values, timestamp) and `infos`."""

    class StreamOutlet:
        def __init__(self, info: StreamInfo) -> None:
            self.info = info
            infos.append(info)

        def push_sample(self, x: list[float], timestamp: float = 0.0) -> None:
            assert len(x) == self.info.channel_count
            samples.append((x, timestamp))
            if len(samples) == ENOUGH:
                raise KeyboardInterrupt

    made = ModuleType("pylsl")
    vars(made).update(
        StreamInfo=StreamInfo,
        StreamOutlet=StreamOutlet,
        local_clock=lambda: time.monotonic() + CLOCK_OFFSET_S,
    )
    return made
