# SPDX-License-Identifier: Apache-2.0
"""A recording that goes on beside the page: every scan, whatever the page shows of them."""

import threading
import time
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path

from ohmskin.errors import OhmskinError
from ohmskin.files import Closing
from ohmskin.link.device import Device
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import Mark, Tare


class BoardRecording(Closing):
    """Records `skin` to `path` in a thread of its own, until it is closed or the board is gone.

    ended: is called, from that thread, when the file is whole. text: then says how it went.

    :raises RecordingError: the file cannot be written.
    """

    def __init__(
        self, skin: Device, path: Path, tare: Tare | None, ended: Callable[[], None]
    ) -> None:
        self.path = path
        self.text = ""
        self._skin = skin
        self._ended = ended
        self._until_s = float("inf")
        self._recorder = Recorder(path, skin.info)
        try:
            if tare is not None:
                self._recorder.add(tare)
            self._scans = iter(skin)
        except BaseException:
            self._recorder.close()
            raise
        self._thread = threading.Thread(target=self._work, name=f"record {path}")
        self._thread.start()

    @property
    def scans(self) -> int:
        """Scans written so far."""
        return self._recorder.scans

    def add(self, message: Tare | Mark) -> None:
        """Keep a tare or a mark.

        :raises RecordingError: the file can no longer be written.
        """
        self._recorder.add(message)

    def _work(self) -> None:
        trouble = ""
        try:
            with self._recorder as recorder:
                in_time = takewhile(lambda scan: scan.host_time_s <= self._until_s, self._scans)
                record(self._skin, recorder, in_time)
        except OhmskinError as exc:
            trouble = f"; {exc}"
        self.text = f"{self.path}: {recorder.scans} scans, missed {recorder.missed}{trouble}"
        self._ended()

    def close(self) -> None:
        """End with the scans that have come until now. Returns when the file is whole."""
        self._until_s = min(self._until_s, time.monotonic())
        self._thread.join()
