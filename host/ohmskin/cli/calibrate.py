# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate``: over a scale, with weights, from recordings, from a table; ``tare``."""

import json
import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from typer import Argument, Option

import ohmskin
from ohmskin.arrays import Float
from ohmskin.calibrate.alignment import align
from ohmskin.calibrate.guide import Press, still_wanted
from ohmskin.calibrate.kneading import Kneading
from ohmskin.calibrate.presses import Calibrator, Presses, find_presses
from ohmskin.calibrate.rules import check_cells_differ, check_enough
from ohmskin.calibrate.scale import printed_s, wrong_numbers
from ohmskin.calibrate.sessions import beside, check_same, joined, session_paths
from ohmskin.calibrate.tables import ForceLog, load_force_log, load_press_table
from ohmskin.calibrate.wires import UNCLEAR_LOG, FoundWires
from ohmskin.cli.board import (
    TERMINAL,
    Leads,
    Port,
    Seconds,
    Wires,
    line_name,
    own_leads_in_words,
    wires_of,
)
from ohmskin.cli.knead import kneaded
from ohmskin.cli.record import TRUTH, ForceBaud, ForceColumn, ForceScale, ForceUnit, progress
from ohmskin.cli.scale import grams_of, scale
from ohmskin.cli.stream import cell_table
from ohmskin.cli.weights import (
    ANYWHERE,
    WEIGHTS,
    KeptAnywhere,
    KeptPresses,
    cells_of,
    guided,
    put_anywhere,
)
from ohmskin.errors import TareRefused
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import LEVEL_METHODS, VOLTAGE
from ohmskin.files import check_place, naming
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.reader import DEFAULT_METHOD, TARE_S
from ohmskin.link.device import Device, mean_ratio, scans_for
from ohmskin.link.messages import Hello
from ohmskin.link.protocol import all_lines
from ohmskin.record.force_sensor import DEFAULT_BAUD, NEWTONS
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Recording, Tare, load_recording

# After a person is asked to let go, so much time passes before rest is measured [s]. Chosen: long
# enough to let go.
COUNT_DOWN_S: Final = 3

# The alignment of a log takes the scale's lag for a part of the offset, so that a slow scale seems
# to show a force before it comes. So the log is taken to be late by so much [s]. Chosen: it is what
# the alignment takes of the lag of a slow one, because it goes by the edges.
ALIGNED_LAG_S: Final = 0.15

Out = Annotated[Path, Argument(help="calibration file to write (.json)")]
Method = Annotated[str, Option(help=" | ".join(LEVEL_METHODS))]
Indenter = Annotated[
    float, Option("--indenter-mm2", help="area that the skin is pressed with, in mm2")
]
AnyIndenter = Annotated[
    float | None, Option("--indenter-mm2", help="area of what presses single cells, in mm2")
]
Force = Annotated[bool, Option("--force", help="even if cells seem to be touched at rest")]
# Makes a calibrator, from what the board says of itself and the readings (R, C, 4) of its untouched
# skin. All else is known from the command line.
_CalibratorOf = Callable[[Hello, Float], Calibrator]
calibrate = typer.Typer(
    no_args_is_help=True, help="Learn forces by a scale, weights or recordings: a calibration file."
)
calibrate.command()(scale)


# -------------------------------------------------------------------------------- the commands


@calibrate.command()
def weights(
    port: Port,
    out: Out,
    grams: Annotated[str, Option(help="the weights you have, in gram, such as 50,100")],
    indenter_mm2: AnyIndenter = None,
    anywhere: Annotated[
        bool, Option("--anywhere", help="put each weight at some places, not on single cells")
    ] = False,
    repeats: Annotated[
        int | None,
        Option(min=1, max=1000, help="times each weight is put on each cell: 1, anywhere 20"),
    ] = None,
    cells: Annotated[str, Option(help="row,column of each, '0,0 0,1'; default: all")] = "",
    redo: Annotated[list[str] | None, Option(help="row,column: drop its presses first")] = None,
    method: Method = DEFAULT_METHOD,
    wires: Wires = "",
    leads: Leads = None,
    force: Force = False,
) -> None:
    """With weights: says which to put on which cell of the skin at PORT, and when it has read it.

    Every press is kept at once, in OUT with .presses.csv and its readings with .presses.npz: after
    Ctrl-C the same command goes on. With --anywhere, where you put a weight is your choice.
    """
    if anywhere == (indenter_mm2 is not None) or (anywhere and (cells or redo)):
        raise ValueError(
            "say --indenter-mm2, or --anywhere without --indenter-mm2, --cells, --redo"
        )
    calibrator_of = _options(out, method, indenter_mm2, wires, leads, force, table=not anywhere)
    forces_n = [mass_g * NEWTONS["g"] for mass_g in grams_of(grams)]
    if anywhere:
        _weigh_anywhere(port, out, np.repeat(forces_n, repeats or 20), calibrator_of)
        return
    kept = KeptPresses(beside(out, ".presses.csv"))
    with ohmskin.open(port) as skin:
        skin.only_unit = skin.info.unit_id  # no other may come while nobody looks
        kept.go_on(skin.info)
        shape = skin.info.rows, skin.info.columns
        only, again = cells_of(cells, shape), cells_of(" ".join(redo or ()), shape)
        on_each_n = forces_n * (repeats or 1)
        wanted = [Press(cell, each_n) for cell in only or np.ndindex(shape) for each_n in on_each_n]
        read = [press for press in kept.presses if press.cell not in again]
        missing = still_wanted(wanted, read)
        with naming("--grams, --repeats, --cells"):  # before anybody makes the presses
            every = [*read, *missing]
            check_enough(len(every), [press.force_n for press in every])
            check_cells_differ({press.cell for press in every}, shape)
        calibrator = calibrator_of(skin.info, _rest_of(skin))
        with naming(kept.path):
            calibrator.presses_in_table(kept.table)  # raises ValueError for another skin's
        if again:
            kept.keep_those([press.cell not in again for press in kept.presses])
        rest_us = 1e6 * calibrator.rest_level
        TERMINAL.print(f"rest: {rest_us.min():.2f} to {rest_us.max():.2f} microsiemens")
        left = guided(skin, calibrator, kept, missing, len(wanted)) if missing else 0
    if left:
        command = "the same command without --redo" if again else "the same command"
        done = f"{len(wanted) - left} of {len(wanted)} presses are in {kept.path}"
        TERMINAL.print(f"{done}: {command} goes on")
        raise typer.Exit(130)  # what a shell says of Ctrl-C
    with naming(kept.path):
        presses = calibrator.presses_in_table(kept.table, kept.ratios)
    _finish(calibrator, presses, kept.path, out)


def _rest_of(skin: Device) -> Float:
    """Readings (R, C, 4) of the untouched skin, after a count-down."""
    for left_s in range(COUNT_DOWN_S, 0, -1):
        TERMINAL.print(f"take everything off the skin: its rest is measured in {left_s} s")
        deque(scans_for(skin, 1.0), maxlen=0)  # so time passes by the board's clock
    return skin.mean_ratio(TARE_S)


def _weigh_anywhere(port: str, out: Path, forces_n: Float, calibrator_of: _CalibratorOf) -> None:
    """Learn from weights at places of the user's choice, each of these forces (n,) [N]."""
    before, path = session_paths(out, "weights")
    recordings = [load_recording(each) for each in before]
    wanted = [Press(ANYWHERE, force_n) for force_n in forces_n.tolist()]
    read = put_anywhere(recordings)
    missing = still_wanted(wanted, read)
    with naming("--grams, --repeats"):  # before anybody puts them on
        every = [*read, *missing]
        check_enough(len(every), [press.force_n for press in every])
    if missing:
        with ohmskin.open(port) as skin:
            skin.only_unit = skin.info.unit_id
            check_same(recordings, skin.info)
            rest_ratio = _rest_of(skin)
            calibrator = calibrator_of(skin.info, rest_ratio)
            with Recorder(path, skin.info, lambda: skin.now_s) as recorder:
                recorder.add(Tare.of(rest_ratio, skin.info, skin.now_s))
                left = guided(skin, calibrator, KeptAnywhere(recorder), missing, len(wanted))
        if left:
            done = f"{len(wanted) - left} of {len(wanted)} weights have been read"
            TERMINAL.print(f"{done}: the same command goes on")
            raise typer.Exit(130)
        recordings.append(load_recording(path))
    _learn_totals(calibrator_of, recordings, out)


@calibrate.command()
def recording(
    recording: Annotated[Path, Argument(help="recording (.mcap) of presses of single cells")],
    out: Out,
    indenter_mm2: AnyIndenter = None,
    total: Annotated[
        bool, Option("--total", help="forces are those on the whole skin, pressed anywhere")
    ] = False,
    forces: Annotated[
        Path | None,
        Option(help="force sensor's log (.csv: time_s, force_n); default: the forces in it"),
    ] = None,
    rest_s: Annotated[
        float, Option("--rest", min=0, help="seconds before the first touch; 0: its tare")
    ] = 0.0,
    method: Method = DEFAULT_METHOD,
    wires: Wires = "",
    leads: Leads = None,
    force: Force = False,
    as_json: Annotated[bool, Option("--json", help="with --total: one JSON object")] = False,
) -> None:
    """From a recording of presses, with the forces in it or a force sensor's log of the same time.

    The two clocks may differ: they are aligned by what both saw. With --total, a scale under the
    skin measured the force on all of it, and presses may be anywhere, of many cells at once.
    """
    if total == (indenter_mm2 is not None):
        raise ValueError("say either --indenter-mm2, of presses of single cells, or --total")
    if as_json and not total:
        raise ValueError("--json is for --total")
    inputs = recording, forces
    calibrator_of = _options(out, method, indenter_mm2, wires, leads, force, *inputs)
    given = load_recording(recording)
    log = None if forces is None else load_force_log(forces, any_zero=total)
    with naming(recording):
        if not given.scans:
            raise ValueError("no scan in it")
        if log is None and not given.forces:
            raise ValueError("no force in it: say --forces LOG.csv")
        given.scans = [scan for scan in given.scans if scan.is_complete]
        board = given.hellos[-1]
        modes = {scan.mode for scan in given.scans} | ({board.mode} if board.is_complete else set())
        if not given.scans:
            raise ValueError("no scans of one mode, near or far: record the presses in mode near")
        if len(modes) > 1:
            raise ValueError("modes near and far are mixed in it: record the presses in one mode")
        rows, columns = map(all_lines, (board.rows, board.columns))
        board = replace(board, mode=modes.pop(), row_mask=rows, column_mask=columns)
        calibrator = calibrator_of(board, _rest_ratio(given, rest_s))
        if total:
            _knead(calibrator, [given], log, out, as_json)
            return
        log = log or _log_in(given.forces)
        history = calibrator.look(given.scans, progress("presses"))
        alignment = align(history.time_s, history.of_skin, log)
        presses = find_presses(history, log, alignment.offset_s)
        if not calibrator.shows_wires:
            calibrator.learn_wires((given.scans[n].ratio for n in presses.scan), presses)
            touched = history.touched
            history = calibrator.measure(given.scans, progress("scans"))
            if calibrator.fault:  # presses of an open line would pass for weak ones elsewhere
                history = replace(history, touched=history.touched & touched)
            presses = find_presses(history, log, alignment.offset_s)
    note = (
        f"offset of the clocks {alignment.offset_s:+.3f} s, correlation "
        f"{alignment.correlation:.2f} over {alignment.overlap_s:.0f} s; zero of the force sensor "
        f"{presses.zero_n:+.3f} N"
    )
    if presses.shared:
        note += f"\n{presses.shared} scans left out: two cells were pressed"
        note += "; if nobody did so, lines may be shorted: ohmskin doctor tells"
    _finish(calibrator, presses, recording, out, note)


@calibrate.command()
def knead(
    port: Port,
    out: Out,
    force_port: Annotated[
        str, Option(help="serial port of the scale under the skin; of a simulated skin: truth")
    ],
    force_baud: ForceBaud = DEFAULT_BAUD,
    force_scale: ForceScale = 1.0,
    force_unit: ForceUnit = "",
    force_column: ForceColumn = "",
    seconds: Seconds = 0.0,
    method: Method = DEFAULT_METHOD,
    wires: Wires = "",
    leads: Leads = None,
    force: Force = False,
    view: Annotated[bool, Option("--view", help="show the map on a page in the browser")] = False,
) -> None:
    """By pressing the skin at PORT anywhere, over a scale: shows where to press until all is known.

    Ctrl-C ends it with what there is. The same command goes on: all recordings beside OUT count.
    """
    calibrator_of = _options(out, method, None, wires, leads, force)
    said = force_port, force_baud, force_scale, force_unit, force_column
    given, known = kneaded(port, out, said, seconds, view=view)
    try:
        _learn_totals(calibrator_of, given, out)
    except ValueError as exc:
        if known or seconds:
            raise
        TERMINAL.print(f"no calibration is made ({exc}): the same command goes on")
        return
    if not known:
        TERMINAL.print("not all cells are known yet: the same command goes on")


def _learn_totals(calibrator_of: _CalibratorOf, recordings: list[Recording], out: Path) -> None:
    """Write the calibration that the forces on the whole skin teach."""
    usable = joined(recordings)
    for given in usable:  # each rest is checked, and the last one is that of the calibration
        try:
            calibrator = calibrator_of(given.hellos[-1], given.tares[0].rest_ratio)
        except TareRefused as exc:
            remedy = "move it away, or say --force if nothing was on the skin"
            raise TareRefused(f"{given.name}: {exc.problem}", remedy) from exc
    _knead(calibrator, usable, None, out, as_json=False)


def _log_in(forces: list[ForceSample], *, any_zero: bool = False) -> ForceLog:
    """The forces in recordings, whose times are by the same clock as those of the scans."""
    if not forces:
        raise ValueError("no force was recorded while the skin was scanned")
    time_s, force_n = np.array([(sample.host_time_s, sample.force_n) for sample in forces]).T
    if not {sample.source for sample in forces} & {WEIGHTS, TRUTH}:
        time_s = printed_s(time_s)
    return ForceLog(time_s, force_n, any_zero=any_zero)


def _knead(
    calibrator: Calibrator, given: list[Recording], log: ForceLog | None, out: Path, as_json: bool
) -> None:
    """Learn from the total force, write the calibration, and say what came of it.

    given: as `Kneading` takes them.
    log: forces whose times are by another clock; None: the forces in the recordings are taken.
    """
    kneading, offset_s, late_s = Kneading(calibrator, given), 0.0, 0.0
    forces = [sample for each in given for sample in each.forces]
    is_apart = log is not None
    lags = is_apart or any(sample.source != WEIGHTS for sample in forces)
    if log is None:
        log = _log_in(forces, any_zero=True)
    wrong = wrong_numbers(log.force_n) & lags
    log = ForceLog(log.time_s[~wrong], log.force_n[~wrong], any_zero=True)
    if is_apart:
        above = replace(log, force_n=np.maximum(log.force_n - np.quantile(log.force_n, 0.02), 0.0))
        offset_s = align(kneading.time_s, kneading.of_skin, above).offset_s
        late_s = ALIGNED_LAG_S
        log = replace(log, time_s=log.time_s + offset_s + late_s, any_zero=True)
    fit = kneading.learn(log, progress("scans"), lags=lags)
    lag_s = fit.scale_.lag_s - late_s
    calibration = _saved(calibrator.calibration_of(fit.model(), fit.largest_n), out)
    stds, left_out = fit.gain_std(), []
    for begin_s, end_s in fit.left_out:
        number, first_s = kneading.recording_at(begin_s)
        left_out.append((given[number].name, begin_s - first_s, end_s - first_s))
    known = int(np.count_nonzero(~calibration.model.pooled))
    if as_json:
        said = {"left_out": [span for _, *span in left_out], "lag_s": lag_s, "offset_s": offset_s}
        said |= {"wrong_numbers": int(wrong.sum())}
        said |= {"presses": fit.presses, "gain_std": stds.reshape(kneading.shape).tolist()}
        names = WireOhm._fields[:6]
        said |= zip(names, calibration.nominal_wire_ohm, strict=False)
        print(json.dumps(said))  # noqa: T201
        return
    lag = f"the scale lags by {1000 * lag_s:.0f} ms"
    fewer = f"{_presses(fit.presses_left_out)} left out"
    TERMINAL.print(f"{_presses(fit.presses)}; {lag}; {fewer}")
    for name, begin_s, end_s in left_out:
        span = f"{name}, {begin_s:.1f} to {end_s:.1f} s"
        TERMINAL.print(f"left out: {span}, force beside the skin?")
    if wrong.any():
        TERMINAL.print(f"numbers of the scale left out, far from those around them: {wrong.sum()}")
    TERMINAL.print(f"{known} of {stds.size} cells have a gain of their own")
    _conclude(calibration, calibrator, out)


def _presses(count: int) -> str:
    return "1 press" if count == 1 else f"{count} presses"


@calibrate.command()
def table(
    port: Port,
    table: Annotated[Path, Argument(help="row,column,force_n,conductance (.csv)")],
    out: Out,
    indenter_mm2: Indenter,
    rest_s: Annotated[
        float, Option("--rest", min=0, help="so long the untouched skin is measured, in s")
    ] = TARE_S,
    method: Method = DEFAULT_METHOD,
    wires: Wires = "",
    leads: Leads = None,
    force: Force = False,
) -> None:
    """From a table of presses (conductance in siemens), and the untouched skin at PORT."""
    calibrator_of = _options(out, method, indenter_mm2, wires, leads, force, table, table=True)
    rows = load_press_table(table)
    with ohmskin.open(port) as skin:
        calibrator = calibrator_of(skin.info, skin.mean_ratio(rest_s))
    with naming(table):
        presses = calibrator.presses_in_table(rows)
    _finish(calibrator, presses, table, out)


def tare(
    port: Port,
    calibration: Annotated[
        Path, Argument(envvar="OHMSKIN_CALIBRATION", help="file (.json) to be changed")
    ],
    seconds: Annotated[float, Option(min=0, help="touch nothing for so long, in s")] = TARE_S,
    undo: Annotated[bool, Option("--undo", help="return to the rest of the calibration")] = False,
    force: Annotated[bool, Option("--force", help="even if cells seem to be touched")] = False,
) -> None:
    """Take what the skin at PORT reads now for no force: nothing may touch it.

    Is refused while something does. The rest that was calibrated is kept, for --undo.
    """
    with ohmskin.open(port, calibration=calibration) as skin:
        if undo:
            skin.undo_tare()
            done = f"rest of {skin.calibration.rest.date}"
        else:
            scan = skin.latest()
            largest_n, std_n = max(zip(scan.force_n.flat, scan.force_n_std.flat, strict=True))
            skin.tare(seconds, force=force)
            done = f"tared, largest force before it {largest_n:.3f} +- {std_n:.3f} N"
        skin.calibration.save(calibration)
    TERMINAL.print(f"{calibration}: {done}")


# ---------------------------------------------------------------------- what they have in common


def _options(
    out: Path,
    method: str,
    indenter_mm2: float | None,
    wires: str,
    leads: float | None,
    force: bool,
    *inputs: Path | None,
    table: bool = False,
) -> _CalibratorOf:
    """Check the options that all commands have, before anybody presses cells for an hour.

    force: the rest counts even if cells seem touched.
    table: whether presses are in a table.
    Returns a function that makes the calibrator.
    """
    told = wires_of(wires, leads)
    if method not in LEVEL_METHODS:
        raise ValueError(f"no method '{method}': there are {', '.join(LEVEL_METHODS)}")
    if table and method == VOLTAGE:
        raise ValueError(f"a table has conductances, which '{VOLTAGE}' knows nothing of")
    if indenter_mm2 is not None and not (math.isfinite(indenter_mm2) and indenter_mm2 > 0):
        raise ValueError(f"--indenter-mm2 is {indenter_mm2:g}, it must be above 0")
    check_place(out, *inputs, ending=".json")
    area_m2 = None if indenter_mm2 is None else 1e-6 * indenter_mm2
    return lambda board, rest: Calibrator(board, rest, method, area_m2, told, force)


def _rest_ratio(given: Recording, rest_s: float) -> Float:
    """Mean readings (R, C, 4) of the first `rest_s` seconds; 0: those of the recorded tare."""
    if rest_s:
        first_s = given.scans[0].host_time_s
        untouched = [scan for scan in given.scans if scan.host_time_s - first_s <= rest_s]
        if len(untouched) == len(given.scans):
            raise ValueError(f"nothing touched the skin for {rest_s:g} s? all of it is not longer")
        return mean_ratio(untouched)
    tares = [tare for tare in given.tares if tare.is_of(given.scans[-1])]
    if not tares:
        what = f"no tare in mode {given.scans[-1].mode} in it" if given.tares else "no tare in it"
        raise ValueError(f"{what}: say --rest 2 if nothing touched the skin for 2 s at first")
    return tares[0].rest_ratio


def _finish(
    calibrator: Calibrator, presses: Presses, source: Path, out: Path, note: str = ""
) -> None:
    """Write the calibration that is learned from presses, and say how good it is.

    source: where the presses are from.
    note: is printed first.
    """
    with naming(source):
        calibration, message = calibrator.calibration(presses)
    calibration = _saved(calibration, out)
    model = calibration.model
    if note:
        TERMINAL.print(note)
    if not model.pooled.all():
        errors = np.char.mod("%.2f", model.held_out_rmse), np.char.mod(" (%d)", presses.counts)
        texts = np.where(model.pooled, "-", np.char.add(*errors))
        title = "held-out error [N], of so many presses"
        if sum(2 + np.char.str_len(texts).max(axis=0)) > TERMINAL.width:
            hundredths = np.char.mod("%.0f", 100 * model.held_out_rmse)
            texts = np.where(model.pooled, "-", hundredths)
            title = "held-out error [0.01 N]"
        TERMINAL.print(cell_table(texts.tolist(), title))
    if model.pooled.any():
        error_n = model.held_out_rmse[model.pooled].max()  # NaN where one cell alone was pressed
        message += f"; its held-out error is {error_n:.2f} N" if error_n > 0 else ""
    if message:
        TERMINAL.print(message)
    _conclude(calibration, calibrator, out)


def _saved(calibration: Calibration, out: Path) -> Calibration:
    """Write the calibration, with the geometry of the one it replaces, if that is as large."""
    if out.is_file():
        with suppress(ValueError):  # what cannot be read is replaced
            before = load_calibration(out)
            if (before.rows, before.columns) == (calibration.rows, calibration.columns):
                calibration = replace(calibration, geometry=before.geometry)
    calibration.save(out)
    return calibration


def _conclude(calibration: Calibration, calibrator: Calibrator, out: Path) -> None:
    """Say what was written. The largest force shows it if a sensor's newtons are none."""
    if calibrator.fault:
        TERMINAL.print(calibrator.fault)
    TERMINAL.print(_wires_in_words(calibration, calibrator))
    if own_leads := own_leads_in_words(calibration):
        remedy = "forces count them. If a crimp is loose there, mend it and calibrate anew"
        TERMINAL.print(f"{own_leads}: {remedy}")
    if calibrator.found is not None and (odd := calibrator.found.odd_stripe) is not None:
        name = line_name(odd.line, calibration.rows)
        stripe = f"{name} has {odd.ohm:+.0f} ohm a segment against the others of its layer"
        TERMINAL.print(f"{stripe}: is its stripe worn, stretched, or of another yarn?")
    if (kept := calibration.geometry) is not None:
        TERMINAL.print(f"cells stay where {out} had them: {kept.kind}, in '{kept.frame_id}'")
    of = f"{out}: calibration of unit {calibration.unit_id}"
    TERMINAL.print(f"{of}, by presses up to {calibration.largest_force_n:.3g} N")


def _wires_in_words(calibration: Calibration, calibrator: Calibrator) -> str:
    """What the calibration keeps of the wires, and what has shown them."""
    wires, asked = calibration.nominal_wire_ohm, calibrator.nominal_wire_ohm
    # Far ends show the wires without presses.
    found = calibrator.found or FoundWires(wires, asked, 0, ())
    lead_ohm = found.told.lead
    leads = "" if lead_ohm is None else f"; leads of {lead_ohm:g} ohm, as told"
    if wires.both is None:
        by = "" if calibration.mode == "far" else " --press --wires 100,200"
        return (
            f"wires are not known, and a table without readings does not show them{leads}: forces' "
            f"standard deviations are wide. 'ohmskin doctor PORT{by} --into FILE' measures them, "
            "and a recording shows them"
        )
    line = f"wires: {wires.top:.0f} and {wires.bottom:.0f} ohm a segment"
    if wires.top_log_std is None or wires.bottom_log_std is None:
        return f"{line}, as told{leads}"
    percent = [f"{100 * std:.0f} %" for std in (wires.top_log_std, wires.bottom_log_std)]
    source = f"{found.presses} presses" if found.presses else "far ends"
    line += f" by {source}, {' and '.join(dict.fromkeys(percent))}"
    if found.told.both is not None:
        words = "they disagree" if found.disagrees else "they agree"
        line += f"; told: {found.told.top:g}, {found.told.bottom:g}: {words}"
    ohm, std_ohm = wires.lead or 0.0, wires.lead_std_ohm or 0.0
    if found.lead_disagrees:
        leads = f"; leads of {ohm:.0f} ohm; told: {lead_ohm:g}: they disagree"
    elif not calibrator.found:
        leads = ""  # far ends have their own, near the one that was told
    elif lead_ohm is None and std_ohm < UNCLEAR_LOG * ohm:
        leads = f"; leads of {ohm:.0f} ohm, {100 * std_ohm / ohm:.0f} %"
    line += leads
    if found.unclear:
        ends = {"top": f"columns 0 and {calibration.columns - 1}"}
        ends["bottom"] = f"rows 0 and {calibration.rows - 1}"
        line += f"\npresses tell little of the wires of the {' and '.join(found.unclear)} layer: "
        told = (("--wires", found.told.both), ("--leads", lead_ohm))
        remedies = [f"press {', '.join(ends[layer] for layer in found.unclear)} harder"]
        remedies += [f"tell {option}" for option, value in told if value is None]
        line += ", or ".join(remedies)
    return line
