# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with the line to an emulated board, to see that a host gets over it."""

from dataclasses import dataclass, field
from typing import Annotated, Final, get_args, get_type_hints

import numpy as np

_STALL_AFTER_S: Final = 2.0


def texts_of(faults: type) -> dict[str, str]:
    """The texts beside the types of a class's fields, by field."""
    hints = get_type_hints(faults, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if get_args(hint)}


@dataclass
class Faults:
    """Faults by the names in `FAULTS`; 0 is none. seed: of all that is random here.

    Raises ValueError for a share or a time that cannot be.
    """

    drop: Annotated[float, "share of sent chunks that never arrive"] = 0.0
    bitflip: Annotated[float, "share of bits that arrive inverted"] = 0.0
    garbage: Annotated[float, "share of sent chunks after which random bytes come"] = 0.0
    reset: Annotated[float, "seconds between resets of the board"] = 0.0
    stall: Annotated[float, "seconds of silence, once, 2 s after the board's start"] = 0.0
    vanish: Annotated[float, "seconds until the board is unplugged"] = 0.0
    silent: Annotated[float, "1: the board never says anything"] = 0.0
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
            octets = np.frombuffer(chunk, dtype=np.uint8)
            flips = self._random.random((octets.size, 8)) < self.bitflip
            chunk = (octets ^ np.packbits(flips, axis=1)[:, 0]).tobytes()
        if self.garbage and self._random.random() < self.garbage:
            chunk += self._random.bytes(int(self._random.integers(1, 64)))
        return chunk

    def resets(self, now_s: float) -> bool:
        """Whether a reset is due; True once for each."""
        due = int(now_s / self.reset) if self.reset else 0
        if due <= self._resets_done:
            return False
        self._resets_done = due
        return True

    def vanished(self, now_s: float) -> bool:
        """Whether the board has been unplugged by now."""
        return bool(self.vanish) and now_s >= self.vanish


FAULTS: Final = texts_of(Faults)
