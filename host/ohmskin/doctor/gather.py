# SPDX-License-Identifier: Apache-2.0
"""Measures a board for `examine`: which scans are taken, by which settings, for how long.

A look is a number of scans by one configuration. The first look is by that of the board. The others
differ from it in one thing, settle time or ADC clock. What readings change then is due to that.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum, auto
from typing import Any, Final

from ohmskin.arrays import Float
from ohmskin.doctor.examine import Evidence
from ohmskin.doctor.signal import FAR_S, LEAST_SCANS, NOISE_S, REST_S, SETTLED_S, Look, second_look
from ohmskin.doctor.wires import CornerScans
from ohmskin.errors import CommandRefused, DeviceLost, RecordingEnded
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.link.device import Device, scans_for
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import ENUMS
from ohmskin.link.serial_port import latency_timer

# [s] A person has this long to read what to press, and to press twice. Chosen: with time to spare.
WAIT_S: Final = 30.0
# [looks] While corners are pressed, each settle time gets this many looks. Chosen: their scatter
# shows how much the hand drifts.
TURNS: Final = 5
# [s] While corners are pressed, a look takes this long. Chosen: in longer ones, a hand drifts more.
TURN_S: Final = 0.3
# [1] A look at slow scans takes up to this many times as long. Chosen: all looks within 10 s.
LONGEST_TIMES: Final = 2.0


class Step(Enum):
    """What `gather` does next. It is reported with a detail: the comment beside each says which."""

    SELF_TEST = auto()  # None
    SKIN = auto()  # seconds for which the untouched skin is scanned
    PLATE = auto()  # seconds for which the plate is scanned
    LONGER_SETTLING = auto()  # None
    ADC_CLOCK = auto()  # name of the clock
    PRESSES = auto()  # a CornerScans: what is pressed, and where to press next
    PRESSED_SETTLING = auto()  # None: the corners must stay pressed


Report = Callable[[Step, Any], None]


def gather(
    device: Device,
    report: Report = lambda step, detail: None,
    told: WireOhm = NO_WIRES,
    *,
    own_lead_ohm: Float | None = None,
    press: bool = False,
    seconds: float = REST_S,
    clocks: bool = False,
) -> Evidence:
    """What `examine` goes by, as far as the board lets. Leaves the board as it was.

    report: is told each step before it is done, and each scan while somebody presses.
    told: what is told of wires and leads.
    own_lead_ohm: what single leads have above that (`SkinKnowledge`).
    press: whether somebody is asked to press corners.
    seconds: how long the first look takes.
    clocks: whether to scan by each ADC clock, too. Only plates have this done.

    :raises ValueError: somebody would be asked to press a skin of one row or column; or a recording
        has no complete scans.
    """
    board, path = device.info, device.name.partition("?")[0]
    if not board.is_complete:
        with suppress(CommandRefused), put_back(device):  # a recording stays as it is
            device.configure(rows=board.rows, columns=board.columns, rate_hz=0, mode="near")
            return gather(
                device,
                report,
                told,
                own_lead_ohm=own_lead_ohm,
                press=press,
                seconds=seconds,
                clocks=clocks,
            )
    device.only_unit = board.unit_id  # findings are of one board
    evidence = Evidence(board)
    # Wires without resistance cannot have changed: there is nothing to compare with.
    is_nominal = told.both is not None and all(told.both)
    evidence.told = told if is_nominal else told._replace(top=None, bottom=None)
    evidence.latency = None if "://" in path else latency_timer(path)
    presses = CornerScans(board, own_lead_ohm) if press else None
    try:
        report(Step.SELF_TEST, None)
        with suppress(CommandRefused):  # a recording has none
            evidence.report = device.self_test()
        report(Step.PLATE if clocks else Step.SKIN, seconds)
        _scan(device, evidence.scans, seconds)
        # Read once more: a board that was reset meanwhile says why. A recording may end with a
        # region, so the newest hello of the whole skin counts.
        boards = [device.info, *(scan.board or board for scan in reversed(evidence.scans))]
        complete = [each for each in boards if each.is_complete]
        if not complete:
            raise ValueError("nothing in it is of the whole skin, in mode near or far: record that")
        evidence.board = complete[0]
        settling = second_look(evidence.board)
        usual = {"rate_hz": board.rate_asked_mhz / 1000, "settle_us": board.settle_asked_us}
        with suppress(CommandRefused), put_back(device):
            if settling is not None:
                report(Step.LONGER_SETTLING, None)
                far = evidence.board.mode == "far"
                evidence.settled = _look(device, FAR_S if far else SETTLED_S, settling)
                # By the settle time, or by a touch. Far ends may float, and change as well.
                if not far and evidence.moved_meanwhile(evidence.settled).any():
                    evidence.again = _look(device, NOISE_S, usual)
            for clock in ENUMS["accuracy"].values if clocks else ():
                report(Step.ADC_CLOCK, clock)
                # As fast as it can: a slow clock does not reach the rate of the board.
                evidence.clocks.append(_look(device, NOISE_S, {"accuracy": clock, "rate_hz": 0}))
        if presses is not None:
            for scan in scans_for(device, WAIT_S):
                evidence.presses = presses  # here, because a recording that has ended has none
                presses.take(scan)
                if presses.done:
                    break
                report(Step.PRESSES, presses)
            if presses.done and settling is not None:
                report(Step.PRESSED_SETTLING, None)
                with suppress(CommandRefused), put_back(device):
                    for turn in TURNS * (usual, settling):
                        evidence.pressed.append(_look(device, TURN_S, turn))
    except RecordingEnded:
        pass  # all of the recording was read
    except DeviceLost as exc:
        evidence.board, evidence.lost = device.info, str(exc)
    evidence.stats = device.stats
    return evidence


def gather_plate(
    device: Device, shape: tuple[int, ...], report: Report, seconds: float
) -> Evidence:
    """What `examine` goes by, of a plate of so many rows and columns. Leaves the board as it was.

    It is read in mode near: a line of a plate has one potential, so far ends show nothing more.
    """
    rate_hz = device.info.rate_asked_mhz / 1000 if device.info.is_complete else 0.0
    with put_back(device):
        device.configure(rows=shape[0], columns=shape[1], rate_hz=rate_hz, mode="near")
        return gather(device, report, seconds=seconds, clocks=True)


@contextmanager
def put_back(device: Device) -> Iterator[None]:
    """Let the board stand still, and configure it as before, however the body ends.

    A board that is lost cannot be put back. This raises nothing: who reads it next gets an error.
    """
    before = device.info
    device.stop()
    try:
        yield
    finally:
        with suppress(DeviceLost):
            device.stop()
            device.configure_as(before)


def _look(device: Device, seconds: float, settings: dict[str, Any]) -> Look | None:
    """Scans of a board with these settings; None if they are too few."""
    device.stop()
    board, scans = device.configure(**settings), list[Scan]()
    _scan(device, scans, seconds)
    return Look.of(board, scans)


def _scan(device: Device, scans: list[Scan], seconds: float) -> None:
    """Append scans for so long, one by one: they stay if the board goes away meanwhile.

    A board that scans slowly gets more time, since a few scans do not show noise.
    """
    least_s = (LEAST_SCANS - 1) / device.info.rate_hz
    for scan in scans_for(device, min(max(seconds, least_s), LONGEST_TIMES * seconds)):
        scans.append(scan)
