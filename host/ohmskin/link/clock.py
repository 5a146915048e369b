# SPDX-License-Identifier: Apache-2.0
"""When scans were taken: by the board's clock, and by the host's, learned from their arrival.

A board takes one reading a slot, cell after cell, column by column; its `hello` says how long a
slot is. The slots after the last reading, up to the start of the next scan, are idle.

Symbols

====== ===================================================================================== ====
symbol meaning                                                                               unit
====== ===================================================================================== ====
u      a time on the board's clock                                                           s
t      when the host knew of it, on its monotonic clock                                      s
q      rate: seconds of the host in a second of the board                                    1
h(u)   host time of u: h(u) = t_0 + q (u - u_0)                                              s
====== ===================================================================================== ====

A USB bridge's latency timer, buffers and a busy machine can only delay what a board sends, so that
t >= h(u). Therefore h is a line below all points (u, t): of all such lines, the one whose distances
to the points have the least sum [Moon1999]. It is found without a search. The lower convex hull of
the points is the chain of lines that a rubber band would make, stretched below them, and h is the
line of that chain at the mean of u [Zhang2002]. Late points change nothing, however many they are
and however late, as long as some points are on time. A line of least squares would move with the
load of the machine.

A delay d_in that all scans have in common is part of h, and scans alone cannot show it. Commands
can, because a board's answer says at which u it has read the command. One that left at s, and was
d_out on its way, came at s + d_out. So

    h(u) - s >= d_in + d_out,    answer's t - s >= d_in + d_out

both without what the bytes take on the line, and the least of all such differences is taken for the
sum. No clock can tell one way from the other, so half of the sum is taken for each, as other
protocols of time do [Mills1991]: times of scans are then off by half of it at most.

The line is fitted to the last `FIT_WINDOW_S`, because a resonator drifts while it warms. A new line
would make times jump, and perhaps go back. Therefore the difference to the old line is added at
first, and fades within a second.

[Moon1999]: Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements". [Zhang2002]: Zhang, Liu, Xia, "Clock synchronization algorithms for network
measurements". Both INFOCOM. [Mills1991]: Mills, "Internet time synchronization: the network time
protocol", IEEE Transactions on Communications 39(10).
"""

import math
from collections import deque
from collections.abc import Collection
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from ohmskin.arrays import Float
from ohmskin.link import protocol
from ohmskin.link.framing import MAX_BLOCK_BYTES, cobs_encode, encode
from ohmskin.link.messages import MAX_RATE_ERROR, RESET_DELAY_S, Hello, Scan

# Board time of the points that a line is fitted to. A ceramic resonator that warms drifts by up to
# 10 ppm a second, which bends the line by 1 ms in this time.
FIT_WINDOW_S: Final = 30.0
# A scan that comes this much before h shows that a clock has stepped. Chosen: no sound line is off
# by as much, and a host that slept for a shorter time can be followed by the slow way.
CLOCK_STEP_S: Final = 0.05
# Of each block of so much board time only the point that came earliest is kept: the others do not
# change the line, and 120 points are fitted in no time. Chosen: a block has scans enough for one
# that came early.
_BLOCK_S: Final = 0.25
# The difference between the old line and a better one fades within this time. Chosen: its largest
# value, `CLOCK_STEP_S`, is then 5 % of the time that passes, so times go on rising.
_SLEW_S: Final = 1.0
# A byte takes ten bits on a line of 8N1, as frames.toml says of `baud_default`: a start bit, eight
# data bits and a stop bit.
BITS_PER_BYTE: Final = 10
# A Pico sends over USB, whatever speed its line is said to have. Its firmware reckons with so much
# time for a byte [s] (`cycles_per_byte` in firmware/pico/pico_numbers.h).
_PICO_BYTE_S: Final = 2e-6
# The newest so many commands show delays. Chosen: one in a hundred is late, and few are as many.
_COMMANDS: Final = 16
# Time for the last conversion and for the pass of the main loop that packs its cell: 0.1 ms fits
# the built firmware in the simulator (tests/link/test_timing.py).
_FIRMWARE_S: Final = 0.1e-3

# The board's clock goes on with 0 after so long, in an answer.
_TIME_SPAN_S: Final = 1e-6 * protocol.FRAMES["ack"].span("time_us")

_Point = tuple[float, float]  # (u, t)


def slot_s(board: Hello) -> float:
    """Time from one reading of a scan to the next [s]."""
    return board.slot_cycles / board.clock_hz


def scan_s(board: Hello, scan: Scan) -> float:
    """Time from this scan's first reading to its end [s]; idle slots come after that."""
    return scan.codes_read.size * (scan.slot_cycles or board.slot_cycles) / board.clock_hz


def byte_s(board: Hello) -> float:
    """Time that a byte takes on the line [s]; 0 on that of an emulated board."""
    known = {"emulated": 0.0, "pico": _PICO_BYTE_S}
    return known.get(board.board, BITS_PER_BYTE / board.baud)


def answer_delay_s(board: Hello) -> float:
    """Time from a command's last byte to that of the answer of a board that does not scan [s]."""
    ack = protocol.FRAMES["ack"]
    size = len(encode(ack.id, 1, bytes(ack.struct.size)))
    return size * byte_s(board) + _FIRMWARE_S * (board.board != "emulated")


def line_delay_s(scan: Scan, board: Hello) -> float:
    """Time from a scan's end to its last byte at the end of a serial line [s], without USB.

    The board sends while it scans. But a COBS block begins with its length, so the board can send
    none of its bytes, up to 254 (5 ms at 500 kbaud), before it knows where the next zero is. So
    what a skin shows moves the arrival of its scans, and whoever knows when scans came can take
    this delay off. The last byte can leave no earlier than any block allows. Therefore the delay is
    the maximum, over all blocks, of

        time from the scan's end until the block is known, negative if that is before the end
        + time that the line takes for this block and all after it

    It leaves out that frames may wait for those before them.
    """
    if board.board == "emulated":
        # An emulated board sends all of a scan at the end of its period.
        is_between = board.whole_every and scan.is_whole and scan.mode == board.whole_mode
        period_cycles = board.whole_scan_cycles if is_between else board.scan_cycles
        return period_cycles / board.clock_hz - scan_s(board, scan)
    header = _header(*scan.masks)
    codes = protocol.pack_codes(scan.codes_read, protocol.PER_PASS[scan.mode], scan.adc_bits)
    # The CRC is not known here. It is taken to have no zeros, which would end a block earlier.
    wire = cobs_encode(header + codes + b"\x01\x01")
    byte_on_line_s = byte_s(board)
    byte_of_scan_s = scan_s(board, scan) / len(codes)
    delay_s, begin, unknown = 0.0, 0, len(header) + len(codes)  # bytes of content not known yet
    while begin < len(wire):
        # A block has as many bytes as it stands for: it has its length, and lacks the zero at its
        # end. A full block stands for one byte less, because no zero comes after it.
        size = wire[begin]
        unknown -= size - (size == MAX_BLOCK_BYTES)
        block_s = (len(wire) + 1 - begin) * byte_on_line_s  # and the delimiter
        if unknown > 0:
            block_s -= unknown * byte_of_scan_s
        if block_s > delay_s:  # not by `max`, which takes three times as long
            delay_s = block_s
        begin += size
    return delay_s + _FIRMWARE_S


@lru_cache(maxsize=64)
def _header(row_mask: int, column_mask: int) -> bytes:
    """The bytes of a scan frame before its codes.

    Any counters will do: zeros among them end blocks that are known before the scan ends.
    """
    kind = protocol.FRAMES["scan"]
    values = {field.name: 1 for field in kind.fields}
    values |= {"row_mask": row_mask, "column_mask": column_mask, "dropped": 0, "rx_errors": 0}
    return bytes([kind.id, 1]) + kind.pack(**values)


class _Line(NamedTuple):
    """h, by its rate q and one point (u, t) [s] of it."""

    rate: float
    u_s: float
    t_s: float

    def at(self, u_s: float) -> float:
        """h(u) [s]."""
        return self.t_s + self.rate * (u_s - self.u_s)


def _line_below(points: Collection[_Point], rate: float) -> _Line:
    """The line below points whose u rise [Zhang2002]. rate: the one to take if there is one point.

    The rate is kept within what a resonator can have. Where that changes it, the line is moved to
    touch the points from below again.
    """
    hull: list[_Point] = []
    for u_s, t_s in points:
        # A point above the line from the one before it to the new one is not part of the hull.
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) >= _slope(hull[-2], (u_s, t_s)):
            hull.pop()
        hull.append((u_s, t_s))
    mean_s = math.fsum(u_s for u_s, _ in points) / len(points)
    for begin, end in pairwise(hull):
        rate = _slope(begin, end)
        if end[0] >= mean_s:
            break
    rate = min(max(rate, 1 - MAX_RATE_ERROR), 1 + MAX_RATE_ERROR)
    u_s, t_s = min(hull, key=lambda point: point[1] - rate * point[0])
    return _Line(rate, u_s, t_s)


def _slope(a: _Point, b: _Point) -> float:
    return (b[1] - a[1]) / (b[0] - a[0])


class BoardClock:
    """Learns the clock of a board from scan after scan.

    It follows a restart of the board at once, and a clock that steps so that scans come early: the
    host was asleep. Otherwise times are smooth: what it learns shifts only later times, over a
    second.
    """

    def __init__(self) -> None:
        self._line: _Line | None = None
        self._points: deque[_Point] = deque()  # of each block, the one that came earliest
        self._block_u_s = 0.0  # where the newest block begins
        self._last_u_s = 0.0  # of the newest point
        self._pause_s = 0.0  # from the point before the newest to it, on the board's clock
        # What the line before the present one gave more at this time u; see the module.
        self._slew_s, self._slew_from_u_s = 0.0, 0.0
        # Of commands among scans: u at which the board had read them, and when they left.
        self._commands: deque[_Point] = deque()
        self._delay_s = math.inf  # the least that answers have shown, or commands before those

    @property
    def delay_s(self) -> float:
        """The constant delays of both directions together [s]; 0: no command has shown them."""
        least_s = self._delay_s
        for u_s, sent_s in self._commands:
            assert self._line is not None
            least_s = min(least_s, self._line.at(u_s) - sent_s)
        return max(least_s, 0.0) if least_s < math.inf else 0.0

    def answered(self, time_us: float, sent_s: float, host_time_s: float) -> None:
        """Learn that the answer to a command that left at `sent_s` was known at `host_time_s`.

        time_us: the board's clock when it had read the command; it may wrap. Both host times are
        without what the bytes take on the line.
        """
        self._delay_s = min(self._delay_s, host_time_s - sent_s)
        u_s = self._last_u_s + math.remainder(1e-6 * time_us - self._last_u_s, _TIME_SPAN_S)
        # Where no scans come, the line was fitted to scans of long ago, perhaps of before a reset.
        # Then it does not tell when the board had read the command.
        if self._line is not None and abs(u_s - self._last_u_s) < _BLOCK_S:
            if len(self._commands) == _COMMANDS:
                self._forget_command()
            self._commands.append((u_s, sent_s))

    def _forget_command(self) -> None:
        """Forget the oldest one, but not what it has shown."""
        self._delay_s = self.delay_s
        self._commands.popleft()

    def add(self, time_us: float, host_time_s: float) -> None:
        """Learn that something at `time_us` of the board's clock was known here at `host_time_s`.

        Calls come in the order of the board's clock. A time that goes back is a restart. So is one
        that comes late after a pause: the clock of a board that was reset soon after it started
        need not go back. (A host that was busy gets its late scans without a pause.)
        """
        u_s, t_s = 1e-6 * time_us, host_time_s
        line = self._line
        late_s = 0.0 if line is None else t_s - line.at(u_s)
        pause_s = u_s - self._last_u_s
        is_long = pause_s > max(_BLOCK_S, 2 * self._pause_s)
        is_reset = is_long and late_s > RESET_DELAY_S + MAX_RATE_ERROR * pause_s
        self._pause_s = pause_s
        if line is None or pause_s <= 0 or late_s < -CLOCK_STEP_S or is_reset:
            self._restart(u_s, t_s)
            return
        self._last_u_s = u_s
        ends_block = u_s - self._block_u_s >= _BLOCK_S
        if ends_block:
            if self._commands and u_s - self._commands[0][0] > FIT_WINDOW_S:
                self._forget_command()
            while self._points and u_s - self._points[0][0] > FIT_WINDOW_S:
                self._points.popleft()
            self._points.append((u_s, t_s))
            self._block_u_s = u_s
        elif late_s < self._points[-1][1] - line.at(self._points[-1][0]):
            self._points[-1] = (u_s, t_s)  # less late than the earliest of this block so far
        if ends_block or late_s < 0:
            self._fit(u_s)

    def host_s(self, time_us: float) -> float:
        """Host time at which the board's clock showed `time_us`, on `time.monotonic()` [s].

        It is exact for times near that of the last `add`. Raises ValueError before the first.
        """
        if self._line is None:
            raise ValueError("no scan has been added: its arrival tells the time")
        u_s = 1e-6 * time_us
        slew_share = 1 - max(u_s - self._slew_from_u_s, 0.0) / _SLEW_S
        return self._line.at(u_s) + self._slew_s * max(slew_share, 0.0)

    def _restart(self, u_s: float, t_s: float) -> None:
        rate = self._line.rate if self._line else 1.0  # a restart does not change the resonator
        self._line = _Line(rate, u_s, t_s)
        self._points = deque([(u_s, t_s)])
        self._commands.clear()
        self._last_u_s = self._block_u_s = u_s
        self._slew_s = 0.0

    def _fit(self, u_s: float) -> None:
        """Fit the line to the points anew, which changes h from the time `u_s` on."""
        assert self._line is not None
        before_s = self.host_s(1e6 * u_s)
        self._line = _line_below(self._points, self._line.rate)
        self._slew_s = min(max(before_s - self._line.at(u_s), -CLOCK_STEP_S), CLOCK_STEP_S)
        self._slew_from_u_s = u_s


class ScanClock:
    """Says of scan after scan of a board when its middle was, by a `BoardClock`.

    epoch_ns: the time since 1970 [ns] at which the clock of `Scan.host_time_s` showed 0. It stays,
    so that no clock of the day that is set anew makes times jump. board: what is learned of the
    board's clock.
    """

    def __init__(self, epoch_ns: int) -> None:
        self._epoch_ns = epoch_ns
        self.board = BoardClock()

    def time_ns(self, scan: Scan, board: Hello) -> int:
        """The middle of this scan, the newest so far, since 1970 [ns].

        Half of `Scan.delay_s` is taken for the way of scans, so it is off by half at most.
        """
        took_us = 1e6 * scan_s(board, scan)
        self.board.add(scan.time_us + took_us, scan.host_time_s - line_delay_s(scan, board))
        middle_s = self.board.host_s(scan.time_us + took_us / 2) - scan.delay_s / 2
        return self._epoch_ns + round(1e9 * middle_s)


def scan_times_s(scans: list[Scan]) -> Float:
    """Times of recorded scans on the host's clock [s], (n,), without the jitter of their arrival.

    All are late by about a scan. Scans before and after a reset are taken separately, because the
    board begins its clock anew.
    """
    host_s = np.array([scan.host_time_s for scan in scans])
    return without_delays_s(1e-6 * np.array([scan.time_us for scan in scans]), host_s)


def without_delays_s(board_s: Float, host_s: Float) -> Float:
    """Times by the host's clock [s], (n,), of what happened at times of a board's clock.

    board_s: times of the board's clock, (n,) [s]. host_s: when the host knew of them, (n,) [s].

    Here, unlike in `BoardClock`, a line can be fitted to what came later as well. At every half
    `FIT_WINDOW_S` of the board's clock there is a knot,
    whose time is by the line that fits the window around it. Between knots, times are interpolated.
    What comes before and after a step back is taken separately, and so is what comes before and
    after a pause with a reset, or of a window, across which no line is fitted. Therefore there are
    no more than two knots for each time, whatever the times are.
    """
    times_s, half_s = np.empty_like(host_s), FIT_WINDOW_S / 2
    steps_s = np.diff(board_s)
    late_s = np.diff(host_s) - steps_s
    is_reset = (steps_s > _BLOCK_S) & (late_s > RESET_DELAY_S + MAX_RATE_ERROR * steps_s)
    breaks = np.flatnonzero((steps_s <= 0) | (steps_s > FIT_WINDOW_S) | is_reset) + 1
    for part in np.split(np.arange(host_s.size), breaks):
        u_s, t_s = board_s[part], host_s[part]
        count = 2 + int((u_s[-1] - u_s[0]) / half_s)
        knots: list[_Point] = []
        for knot_s in np.linspace(u_s[0], u_s[-1], count).tolist():
            first, last = np.searchsorted(u_s, [knot_s - half_s, knot_s + half_s])
            points = list(zip(u_s[first:last].tolist(), t_s[first:last].tolist(), strict=True))
            if points:
                knots.append((knot_s, _line_below(points, 1.0).at(knot_s)))
        times_s[part] = np.interp(u_s, *np.array(knots).T)
    return times_s
