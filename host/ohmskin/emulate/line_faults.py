# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a line, for an emulated one: to see that a host gets over it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

FAULTS: Final = {
    "drop": "share of sent chunks that never arrive",
    "bitflip": "share of bits that arrive inverted",
    "garbage": "share of sent chunks after which random bytes come",
    "reset": "seconds between resets of the board",
    "stall": "seconds for which the board says nothing, once, 2 s after its start",
    "vanish": "seconds until the board is unplugged",
    "silent": "1: the board never says anything",
}
_STALL_AFTER_S: Final = 2.0


@dataclass
class Faults:
    """Faults by the names in `FAULTS`; zero is none. seed: of all that is random here."""

    drop: float = 0.0
    bitflip: float = 0.0
    garbage: float = 0.0
    reset: float = 0.0
    stall: float = 0.0
    vanish: float = 0.0
    silent: float = 0.0
    seed: int = 0
    _resets_done: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        for name in ("drop", "bitflip", "garbage"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is a share, from 0 to 1, not {getattr(self, name)}")
        for name in ("reset", "stall", "vanish", "silent"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be 0 or more, not {getattr(self, name)}")
        self._random = np.random.default_rng(self.seed)

    def apply(self, chunk: bytes, now_s: float) -> bytes:
        """What arrives of a chunk sent at `now_s`."""
        if not chunk:
            return chunk
        if self.silent or (self.stall and 0 <= now_s - _STALL_AFTER_S < self.stall):
            return b""
        if self.drop and self._random.random() < self.drop:
            chunk = b""
        if self.bitflip:
            chunk = self._flipped(chunk)
        if self.garbage and self._random.random() < self.garbage:
            chunk += self._random.bytes(int(self._random.integers(1, 64)))
        return chunk

    def _flipped(self, chunk: bytes) -> bytes:
        octets = np.frombuffer(chunk, dtype=np.uint8)
        flips = self._random.random((octets.size, 8)) < self.bitflip
        return (octets ^ np.packbits(flips, axis=1)[:, 0]).tobytes()

    def resets(self, now_s: float) -> bool:
        """True once for every reset that is due."""
        due = int(now_s / self.reset) if self.reset else 0
        if due <= self._resets_done:
            return False
        self._resets_done = due
        return True

    def vanished(self, now_s: float) -> bool:
        """Whether the board has been unplugged by now."""
        return bool(self.vanish) and now_s >= self.vanish
