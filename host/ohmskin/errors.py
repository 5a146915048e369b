# SPDX-License-Identifier: Apache-2.0
"""What can go wrong between a program and a board. Every text says what to do."""

from typing import Self


class OhmskinError(Exception):
    """Any of the errors below. Bad arguments are `ValueError` instead.

    `problem`: what happened. `remedy`: what to do about it; empty if `problem` says this as well.
    The text of the error is both.
    """

    def __init__(self, problem: str, remedy: str = "") -> None:
        super().__init__(f"{problem}: {remedy}" if remedy else problem)
        self.problem = problem
        self.remedy = remedy


class PortError(OhmskinError):
    """A port that cannot be opened: unknown, busy, not permitted, a wrong URL."""


class PortUnusable(PortError):
    """The URL is right, but the system does not give its port: not there, busy, not permitted."""


class DeviceLost(OhmskinError):
    """The board has gone, or no longer says anything."""


class DeviceSilent(OhmskinError):
    """The port is open, but no skin board answers at it."""


class ProtocolMismatch(OhmskinError):
    """The board was built from another protocol definition."""


class ProtocolError(OhmskinError):
    """The board says what no board can: its firmware is broken, or it is none of ours."""


class CommandRefused(OhmskinError):
    """The board refused a command, and nothing has changed.

    `command`: its name. `result`: name of the reason in ``frames.toml``.
    """

    def __init__(self, command: str, result: str, reason: str) -> None:
        super().__init__(f"the board refused '{command}': {result}: {reason}")
        self.command = command
        self.result = result
        self._told = command, result, reason

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, str]]:
        return type(self), self._told  # else the one text would be taken for the three


class TareRefused(OhmskinError):
    """Something touches the skin, it is not connected, or no tare is to undo; nothing changed."""


class RecordingError(OhmskinError):
    """A recording that cannot be read, or can no longer be written."""


class RecordingEnded(DeviceLost):
    """The recording at a ``replay://`` port has been played to its end. Iterators end by it."""
