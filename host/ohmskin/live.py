# SPDX-License-Identifier: Apache-2.0
"""A live skin: a thread reads it, opens it again when it was unplugged, and programs ask at will.

A program that iterates over a `CalibratedSkin` at a pace of its own, such as a robot's control loop
of 30 Hz beside 90 scans a second, falls behind; one that asks `latest` twice waits. Here it asks
for the newest scan, which is there, or for all scans since it last asked.
"""

import threading
from collections import deque
from collections.abc import AsyncIterator, Iterator
from itertools import islice
from typing import Final

from ohmskin import opening
from ohmskin.errors import OhmskinError, RecordingEnded
from ohmskin.files import Closing
from ohmskin.force.reader import TARE_S, CalibratedSkin, ForceScan
from ohmskin.link.device import LOG, QUEUE_SCANS, SILENCE_TIMEOUT_S, in_threads

# A port that is not there is tried again after this time [s]. Chosen: somebody who plugs a board in
# does not wait for long, and a system looks for its ports without effort.
AGAIN_S: Final = 1.0
# A scan that has waited for longer [s] is passed over. Chosen: a machine that estimates more slowly
# than the board scans then shows what is now, and a pause of a busy machine costs no scan.
LATE_S: Final = 0.25


class LiveSkin(Closing):
    """A calibrated skin that is always read. All may be called from any thread.

    port, calibration, force: as `ohmskin.open` takes them. A board that is not there, or goes away,
    is opened again and again; the latest tare and the learned wires stay.

    >>> with LiveSkin("/dev/ttyACM0", "skin.json") as skin:
    ...     count, scans = skin.since(0, timeout_s=5.0)  # all until now
    ...     count, scans = skin.since(count)  # those that came since
    ...     newest = skin.newest()  # None: none has come yet

    :raises ValueError: the calibration cannot be read.
    """

    def __init__(
        self, port: str, calibration: opening.CalibrationLike, *, force: bool = False
    ) -> None:
        self.port = port
        self.failure: Exception | None = None
        """Why there are no scans now; None while they come, and before the port was first tried."""
        self.skipped = 0
        """How many scans were passed over, because this machine is too slow for all of them."""
        self.opened = 0
        """How often the port was opened."""
        self._calibration, self._force = opening.loaded(calibration), force
        self._skin: CalibratedSkin | None = None
        self._kept: deque[ForceScan] = deque(maxlen=QUEUE_SCANS)
        self._count = 0
        self._changed = threading.Condition()
        self._closing, self._ended = threading.Event(), False
        # A port that never answers does not hold up the end of the program.
        self._thread = threading.Thread(target=self._work, name=f"live {port}", daemon=True)
        self._thread.start()

    def newest(self) -> ForceScan | None:
        """The newest scan, at once; None if there is none yet."""
        with self._changed:
            return self._kept[-1] if self._kept else None

    def since(self, count: int, timeout_s: float = 0.0) -> tuple[int, list[ForceScan]]:
        """Every scan after the first `count` of them, each once; and the count to ask with next.

        The newest `QUEUE_SCANS` are kept. timeout_s: waits so long [s] where there is none yet.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._count > count or self._ended, timeout_s)
            begin = max(len(self._kept) - max(self._count - count, 0), 0)
            return self._count, list(islice(self._kept, begin, None))

    def __iter__(self) -> Iterator[ForceScan]:
        """Every scan from now on, through all that is unplugged, until `close`."""
        count = self._count
        while not self._ended:
            count, scans = self.since(count, SILENCE_TIMEOUT_S)
            yield from scans

    def __aiter__(self) -> AsyncIterator[ForceScan]:
        """The same for ``async for``."""
        return in_threads(self)

    @property
    def skin(self) -> CalibratedSkin:
        """The open skin. Raises what stands in the way where it is not open."""
        skin = self._skin
        if skin is None:
            raise self.failure or OhmskinError(f"{self.port} is being opened")
        return skin

    def tare(self, seconds: float = TARE_S, *, force: bool = False) -> None:
        """`CalibratedSkin.tare`. Raises what that raises, and what `skin` raises."""
        self.skin.tare(seconds, force=force)

    def _work(self) -> None:
        """The thread's work: read the port, and open it again whenever it goes away."""
        while not self._closing.is_set():
            try:
                self._read()
            except RecordingEnded:
                break
            except (OhmskinError, ValueError, OSError) as exc:
                if self.failure is None and not self._closing.is_set():
                    LOG.warning("%s", exc)
                self.failure = exc
            self._closing.wait(AGAIN_S)
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _read(self) -> None:
        with opening.open(self.port, calibration=self._calibration, force=self._force) as skin:
            self._skin, reader = skin, skin.new_reader()
            self.opened += 1
            try:
                for scan in skin.device:
                    if self._closing.is_set():
                        return
                    if skin.device.now_s - scan.host_time_s > LATE_S:
                        self.skipped += 1
                        continue
                    read, self.failure = reader.read(scan), None
                    with self._changed:
                        self._kept.append(read)
                        self._count += 1
                        self._changed.notify_all()
            finally:
                self._skin, self._calibration = None, skin.calibration
        raise RecordingEnded(f"{self.port} has been played to its end")

    def close(self) -> None:
        """End reading. May be called again."""
        self._closing.set()
        if (skin := self._skin) is not None:
            skin.close()
        self._thread.join(SILENCE_TIMEOUT_S)
