# SPDX-License-Identifier: Apache-2.0
"""What gives scans, as programs see it: a board, or a recording that is played."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ohmskin.arrays import Float
from ohmskin.errors import DeviceLost
from ohmskin.files import Closing
from ohmskin.link import protocol
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport
from ohmskin.link.session import COMMAND_TRIES, configuration
from ohmskin.link.source import Source

# A device that should scan and is silent for so long counts as lost [s].
SILENCE_TIMEOUT_S = 5.0


class Device(Closing):
    """A source of scans: a board, or a recording that is played. Made by `ohmskin.open`.

    There are two ways to read, for two needs. Iterating gives every scan, in order, and tells which
    are missing. `latest` gives the newest scan and skips the rest. Both may be used at once, from
    several threads. ``with`` closes a device, and so does `close`.
    """

    def __init__(self, source: Source, *, start: bool = True) -> None:
        self._source = source
        self._wanted: dict[str, protocol.Value] | None = None  # fields of the last `configure`
        if start:
            try:
                self.start()
            except BaseException:
                self.close()
                raise

    # ------------------------------------------------------------------------------- reading

    @property
    def info(self) -> Hello:
        """What the board has last said of itself."""
        return self._source.hello

    @property
    def stats(self) -> BoardStats:
        """Counts since the connection was made, as a copy."""
        return self._source.stats

    @property
    def name(self) -> str:
        """The port's name."""
        return self._source.name

    def __iter__(self) -> Iterator[Scan]:
        """Every scan from now on; ``missed`` of each counts what was lost before it.

        An iterator that falls behind by more than `source.QUEUE_SCANS` loses the oldest scans,
        which are counted too. It ends with the recording at a ``replay://`` port.

        :raises DeviceLost: the board went away, or said nothing for `SILENCE_TIMEOUT_S`.
        """
        self.start()
        return self._source.scans(self._silence_s)

    def latest(self, timeout_s: float | None = None) -> Scan:
        """The newest scan. Each is given once: waits for the next if this one was given already.

        timeout_s: how long to wait [s], by default `SILENCE_TIMEOUT_S`, or longer for slow scans.

        :raises DeviceLost: the board went away, or no scan came in time.
        """
        self.start()
        return self._source.latest(self._silence_s() if timeout_s is None else timeout_s)

    def mean_ratio(self, seconds: float) -> Float:
        """Mean readings of the coming scans, shape (R, C, 4): of so many seconds, at least one.

        :raises DeviceLost: the board went away, or there are no more scans.
        """
        ratios: list[Float] = []
        first_us = 0
        for scan in self:
            if ratios and scan.ratio.shape != ratios[0].shape:
                ratios.clear()  # somebody has configured the board
            first_us = first_us if ratios else scan.time_us
            ratios.append(scan.ratio)
            if scan.time_us - first_us >= 1e6 * seconds:
                break
        if not ratios:
            raise DeviceLost(f"{self.name} gives no more scans")
        return np.asarray(np.mean(ratios, axis=0))

    def _silence_s(self) -> float:
        return SILENCE_TIMEOUT_S + 2 / self.info.rate_hz

    # ------------------------------------------------------------------------------ commands

    def start(self) -> None:
        """Start scanning. Does nothing when the device scans already."""
        source = self._source
        with source.commands:
            if source.want_scans:
                return
            for _ in range(COMMAND_TRIES):
                self._restore()
                self._source.forget_newest()
                source.command("start")
                # The hello of a reset that came in between was read before this ack.
                if self._is_as_wanted():
                    break
                source.command("stop")
            source.want_scans = True

    def stop(self) -> None:
        """Stop scanning, after a whole scan."""
        with self._source.commands:
            self._source.want_scans = False
            self._source.command("stop")

    def configure(
        self,
        *,
        rows: int | None = None,
        columns: int | None = None,
        rate_hz: float | None = None,
        settle_us: int | None = None,
        adc_prescaler: str | None = None,
    ) -> Hello:
        """Change how the board scans; what is not given stays. Returns what the board now keeps.

        rate_hz: scans per second; 0: as fast as the converter runs. settle_us: least time from a
        multiplexer change to the sample; 0: as long as the rate allows. adc_prescaler: a name of
        the enum `adc_prescaler`.

        :raises ValueError: a value that no board could be sent.
        :raises CommandRefused: a value out of range, or too much for the rate; nothing changes.
            A recording refuses this and all commands below.
        """
        given = {
            "rows": rows,
            "columns": columns,
            "rate_mhz": None if rate_hz is None else protocol.rate_mhz(rate_hz),
            "settle_us": settle_us,
            "adc_prescaler": adc_prescaler,
        }
        with self._paused():
            wanted = configuration(self.info)
            wanted.update({name: value for name, value in given.items() if value is not None})
            self._source.command("configure", **wanted)
            self._wanted = wanted
            self._source.refresh()
            self._restore()
            return self.info

    def set_unit_id(self, unit_id: int) -> None:
        """Name this skin; `save` makes the name last."""
        with self._source.commands:
            self._source.command("set_unit_id", unit_id=unit_id)
            self._source.refresh()

    def save(self) -> None:
        """Keep configuration and unit id in the board's EEPROM.

        :raises CommandRefused: the EEPROM is worn out.
        """
        self._source.command("save")

    def load_defaults(self) -> Hello:
        """Return to the built-in configuration; the EEPROM keeps what it holds until `save`."""
        with self._paused():
            self._source.command("load_defaults")
            self._wanted = None
            return self._source.refresh()

    def self_test(self) -> SelfTestReport:
        """Read both sense nodes with each drive at all multiplexer inputs, and judge them."""
        source = self._source
        with self._paused():
            source.report = None
            source.command("self_test")
            if source.report is None:
                raise DeviceLost(f"{self.name}: the report of the self-test was lost: try again")
            return source.report

    @contextmanager
    def _paused(self) -> Iterator[None]:
        """Hold the scan for commands that are refused meanwhile, and go on whatever they did."""
        source = self._source
        with source.commands:
            was_scanning = source.want_scans
            if was_scanning:
                self.stop()
            try:
                yield
            finally:
                if was_scanning and self._source.failure is None:
                    self.start()

    def _is_as_wanted(self) -> bool:
        return self._wanted is None or configuration(self.info) == self._wanted

    def _restore(self) -> None:
        """A board that was reset while it stood still has forgotten how to scan."""
        for _ in range(COMMAND_TRIES):
            if self._is_as_wanted() or self._wanted is None:
                return
            self._source.command("configure", **self._wanted)
            self._source.refresh()

    # ------------------------------------------------------------------------------- closing

    def close(self) -> None:
        """Stop the board and give the port back. May be called again."""
        self._source.close()
