# SPDX-License-Identifier: Apache-2.0
"""`ohmskin verify`: what is wrong with a board is named, and a sound one passes.

The plate that is told and the one at the board are two files. The emulator knows the second alone.
"""

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from command_line import Run, assert_one_line
from ohmskin.circuit.plate import load_plate
from ohmskin.doctor import gather as gathering
from ohmskin.doctor.plate import Tolerance
from ohmskin.emulate.driver import SteppedSkin
from stepped import stepped, stepped_link

# One resistor a line, as docs/hardware.md says; and a chain, two a line.
ONE_A_LINE = dict(enumerate((10e3, 15e3, 22e3, 33e3, 47e3, 68e3, 100e3, 220e3)))
PLATE: dict[tuple[int, int], float] = {
    (row, (3 * row + 1) % 8): ohm for row, ohm in ONE_A_LINE.items()
}
CHAIN = {(n // 2, (n + 1) // 2): (22e3, 47e3, 100e3, 33e3, 68e3)[n % 5] for n in range(15)}
Write = Callable[..., str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """A function that writes a plate of these resistors, and returns the file's name."""

    def table(ohm: dict[tuple[int, int], float], name: str = "plate", size: int = 8) -> str:
        path = tmp_path / f"{name}.csv"
        lines = [[str(ohm.get((row, c), "open")) for c in range(size)] for row in range(size)]
        path.write_text("\n".join(map(",".join, lines)))
        return str(path)

    return table


def verified(run: Run, url: str, plate: str, *more: str) -> tuple[int, dict]:
    done = run("verify", url, plate, "--seconds", "1", "--json", "-", *more)
    assert done.err == ""
    return done.code, json.loads(done.out)


@pytest.mark.usefixtures("benches")
def test_errors_are_in_columns_and_an_open_joint_has_none(run: Run, write: Write) -> None:
    """Its error of 579531 % touched the next number."""
    there = other(PLATE, **{"0,1": None, "1,4": 2.5 * PLATE[1, 4]})
    url = f"emulator://8x8?plate={write(there, 'there')}"
    done = run("verify", url, write(PLATE), "--seconds", "1")
    first, second = done.out.split("row by row:\n")[1].splitlines()[:2]
    assert first.split() == [".", "open", *6 * "."]
    assert float(second.split()[4]) == pytest.approx(150, abs=3)  # it is not open


@pytest.mark.parametrize("noise", [0, 0.3, 0.5])
@pytest.mark.parametrize("ohm", [PLATE, CHAIN])
@pytest.mark.usefixtures("benches")
def test_a_sound_plate_passes(run: Run, write: Write, ohm: dict, noise: float) -> None:
    plate = write(ohm)
    code, told = verified(run, f"emulator://8x8?plate={plate}&noise={noise}", plate)
    assert (code, told["findings"]) == (0, [])
    assert told["measured"]["worst_cell_percent"] < 2
    assert told["measured"]["resistors_not_told"] == 0
    assert told["measured"]["reference_ohm"] == pytest.approx([30000, 30000], rel=0.004)
    assert sorted(told["exam"]["noise_lsb"]) == ["fine", "finest", "usual"]
    for line in told["exam"]["lines"].values():
        assert abs(line["slope"] - 1) < 0.004
        assert line["residual_lsb"] < 1


def other(ohm: dict, **cells: float | None) -> dict:
    """Resistors of which those at "row,column" are others, or none."""
    changed = ohm | {tuple(map(int, at.split(","))): each for at, each in cells.items()}
    return {cell: each for cell, each in changed.items() if each is not None}


def swapped(ohm: dict, axis: int, first: int, second: int) -> dict:
    """The same with two rows, or columns, in each other's place."""
    lines = {first: second, second: first}
    return {
        tuple(lines.get(n, n) if at == axis else n for at, n in enumerate(cell)): each
        for cell, each in ohm.items()
    }


FAULTS = {
    "5 % more": (other(PLATE, **{"4,5": 49.35e3}), "", "wrong_resistor", "cell (4, 5)"),
    "5 % less": (other(PLATE, **{"2,7": 20.9e3}), "", "wrong_resistor", "cell (2, 7)"),
    "open": (other(PLATE, **{"6,3": None}), "", "open_joint", "cell (6, 3)"),
    "bridge": (other(PLATE, **{"7,0": 1e5}), "", "bridge", "cell (7, 0)"),
    "columns": (swapped(PLATE, 1, 2, 5), "", "swapped_lines", "columns 2, 5"),
    "rows": (swapped(PLATE, 0, 0, 7), "", "swapped_lines", "rows 0, 7"),
    "references": (PLATE, "&ref_top=31000", "reference_value", "reference resistors"),
    "noise": (PLATE, "&noise=2", "adc_noise", "converter"),
    "hum": (PLATE, "&hum=50", "hum", "whole skin"),
    "slow": (PLATE, "&tau_us=10", "settling", None),
    "lost": (PLATE, "&drop=0.05", "loss", "line"),
    "damaged": (PLATE, "&bitflip=0.00005", "damaged", "line"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.usefixtures("benches")
def test_every_fault_is_named(run: Run, write: Write, fault: str) -> None:
    there, options, name, where = FAULTS[fault]
    url = f"emulator://8x8?plate={write(there, 'there')}{options}"
    code, told = verified(run, url, write(PLATE))
    found = {each["id"]: each for each in told["findings"]}
    assert code == 1
    assert name in found
    # What flips bits also loses scans; two mains may look like noise.
    assert found.keys() - {name} <= {"damaged": {"loss"}, "hum": {"adc_noise"}}.get(fault, set())
    assert where in (None, found[name]["where"])
    for field in ("measured", "expected", "what_to_do"):
        assert found[name][field]
    if name == "wrong_resistor":
        off = {"5 % more": 5, "5 % less": -5}[fault]
        assert found[name]["values"]["off_percent"] == pytest.approx(off, abs=0.5)
    if name == "reference_value":
        assert found[name]["values"]["ohm"] == pytest.approx([31000, 30000], rel=0.004)


@pytest.mark.parametrize(
    ("fault", "option", "most"),
    [
        ("5 % more", "--cell-percent", 7),
        ("references", "--reference-percent", 4),
        ("slow", "--settling-lsb", 40),
        ("lost", "--loss", 0.2),
    ],
)
@pytest.mark.usefixtures("benches")
def test_tolerances_are_options(
    run: Run, write: Write, fault: str, option: str, most: float
) -> None:
    there, options, *_ = FAULTS[fault]
    url = f"emulator://8x8?plate={write(there, 'there')}{options}"
    code, told = verified(run, url, write(PLATE), option, str(most))
    found = {each["id"] for each in told["findings"]}
    assert FAULTS[fault][2] not in found
    # What is no fault any more is no longer left out of the circuit that predicts the readings.
    assert found <= {"linearity", "wrong_resistor", "reference_value"}
    assert code == bool(found)


@pytest.mark.usefixtures("benches")
def test_resistors_that_hide_each_other_are_counted(run: Run, write: Write) -> None:
    """Large ones among small ones, at every crossing."""
    plate = write({divmod(n, 8): 1e6 if n % 9 == 0 else 10e3 for n in range(64)})
    code, told = verified(run, f"emulator://8x8?plate={plate}", plate)
    assert code == 0
    deviation = np.array(told["exam"]["std_percent"])
    assert (deviation.diagonal() > 3).all()
    assert told["measured"]["resistors_not_told"] == (deviation > 3).sum()


@pytest.mark.usefixtures("benches")
def test_readings_that_are_not_linear_are_named(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    plate = write(PLATE)
    sound = partial(Tolerance, residual_lsb=0.001)
    monkeypatch.setattr("ohmskin.cli.verify.Tolerance", sound)
    code, told = verified(run, f"emulator://8x8?plate={plate}", plate)
    assert (code, [each["id"] for each in told["findings"]]) == (1, ["linearity"])
    assert told["findings"][0]["where"] == "readings A, B, C, D"


def test_an_emulated_plate_reads_as_ohms_law_says() -> None:
    """The codes are those of the table of docs/hardware.md, made by hand."""
    for ohm, low, high in ((1e3, 502, 521), (10e3, 437, 586), (100e3, 191, 832), (1e6, 28, 995)):
        path = Path("/nonexistent")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "ohmskin.circuit.plate.read_bounded", lambda *_, ohm=ohm: str(ohm).encode()
            )
            scan = next(iter(stepped(f"emulator://1x1?plate={path}&noise=0")))
        assert scan.codes[0, 0].tolist() == [high, low, high, low]


@pytest.mark.usefixtures("benches")
def test_the_page_the_file_and_the_picture(run: Run, write: Write, tmp_path: Path) -> None:
    there = write(other(PLATE, **{"4,5": 49.35e3, "7,0": 1e5}), "there")
    picture, file = tmp_path / "plate.png", tmp_path / "plate.json"
    more = ("--seconds", "1", "--picture", str(picture), "--json", str(file))
    done = run("verify", f"emulator://8x8?plate={there}", write(PLATE), *more)
    assert (done.code, done.err) == (1, "")
    lines = done.out.splitlines()
    assert "not sound: 2 findings, first bridge (cell (7, 0))" in lines[0]
    assert len(lines) < 60  # a page
    cells = np.array([line.split() for line in lines[-8:]])
    assert cells.shape == (8, 8)
    assert (cells != ".").sum() == len(PLATE)
    assert float(cells[4, 5]) == pytest.approx(5, abs=0.5)
    assert picture.read_bytes().startswith(b"\x89PNG")
    told = json.loads(file.read_text())
    assert told["exam"]["cell_ohm"][4][5] == pytest.approx(49.35e3, rel=0.005)
    assert told["exam"]["error_percent"][0][0] is None
    assert told["hello"]["board"] == "emulated"


@pytest.mark.usefixtures("benches")
@pytest.mark.parametrize("option", ["--picture", "--json"])
def test_a_file_that_cannot_be_is_refused_before_the_board_is_read(
    run: Run, write: Write, tmp_path: Path, option: str
) -> None:
    for path in ("/no/such/place.png", str(tmp_path)):
        done = run("verify", "emulator://8x8", write(PLATE), "--seconds", "1", option, path)
        assert_one_line(done, f"{path}: cannot be written")


@pytest.mark.usefixtures("benches")
def test_no_half_picture_stays(run: Run, write: Write, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    picture, limits = tmp_path / "plate.png", resource.getrlimit(resource.RLIMIT_FSIZE)
    picture.write_text("of yesterday")
    more = ("--seconds", "1", "--picture", str(picture))
    plate = write(PLATE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # as a disk that is full
    try:
        done = run("verify", f"emulator://8x8?plate={plate}", plate, *more)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert done.code == 2
    assert f"{picture}: cannot be written" in done.err
    assert picture.read_text() == "of yesterday"
    assert {path.name for path in tmp_path.iterdir()} == {"plate.csv", "plate.png"}


@pytest.mark.parametrize("end", [None, KeyboardInterrupt])
@pytest.mark.parametrize("look", [1, 2, 3, 5])
def test_the_board_is_put_back(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch, end: type | None, look: int
) -> None:
    looks: list[tuple[int, str]] = []

    class Watched(SteppedSkin):
        def __iter__(self) -> Iterator[ohmskin.Scan]:
            looks.append((self.info.settle_us, self.info.accuracy))
            if end is not None and len(looks) == look:
                raise end
            return super().__iter__()

    bench = Watched(stepped_link("emulator://8x8"))
    before = bench.configure(rate_hz=31, settle_us=60, accuracy="fine", rows=5)
    monkeypatch.setattr(ohmskin, "open", lambda url, **_: bench)
    plate = write({(0, 0): 22e3, (1, 1): 47e3}, size=2)
    done = run("verify", "emulator://8x8", plate, "--seconds", "0.5")
    assert done.code == (1 if end is None else 130)
    assert bench.info == before
    assert len(looks) == (5 if end is None else look)
    if end is None:
        assert looks[1][0] > 1.2 * looks[0][0]
        assert len({clock for _, clock in looks[2:]}) == 3


@pytest.mark.usefixtures("benches")
def test_a_wrong_use_is_one_line(run: Run, write: Write, tmp_path: Path) -> None:
    url, path = "emulator://8x8", tmp_path / "wrong.csv"
    assert_one_line(run("verify", url, "/no/such.csv"), "/no/such.csv")
    for text, *words in (
        ("", "1 to 32"),
        ("open,open", "no resistor"),
        ("1e4,open\n1e4", "row 1 has 1 fields, row 0 2"),
        ("10k", "row 0, column 0", "'10k'", "without a unit"),
        ("open,0.01", "row 0, column 1"),
        ("nan", "row 0, column 0"),
        ("\n".join(33 * ["1e4"]), "1 to 32"),
    ):
        path.write_text(text)
        assert_one_line(run("verify", url, str(path)), "wrong.csv", *words)
    plate = write({(0, 0): 1e4}, size=2)
    assert_one_line(run("verify", url, plate, "--wires", "1"), "two numbers")
    assert_one_line(run("verify", f"{url}?plate={plate}", plate), "2x2", "8x8")


@pytest.mark.parametrize("vanish", [0.3, 2.5])
def test_a_board_that_goes_away_is_a_finding(
    run: Run, write: Write, tmp_path: Path, vanish: float
) -> None:
    plate, picture = write(PLATE), tmp_path / "plate.png"
    url = f"emulator://8x8?plate={plate}&vanish={vanish}"
    code, told = verified(run, url, plate, "--picture", str(picture))
    assert (code, told["findings"][0]["id"]) == (1, "lost")
    assert picture.exists()


def test_empty_fields_are_open(tmp_path: Path) -> None:
    path = tmp_path / "plate.csv"
    path.write_bytes(b"\xef\xbb\xbf1e4,,OPEN\r\n open , 2e4,\r\n")
    assert load_plate(path).tolist() == [[1e-4, 0, 0], [0, 5e-5, 0]]


@pytest.mark.simavr
@pytest.mark.parametrize("desk", ["", "&desk=1"])
def test_the_firmware_in_the_simulator(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch, desk: str
) -> None:
    monkeypatch.setattr(gathering, "NOISE_S", 0.3)
    plate, there = write(PLATE), write(other(PLATE, **{"4,5": 49.35e3}), "there")
    code, told = verified(run, f"simavr://uno?plate={plate}{desk}", plate)
    assert code == 0, told["findings"]
    code, told = verified(run, f"simavr://uno?plate={there}{desk}", plate)
    assert code == 1
    worse = [each["id"] for each in told["findings"] if each["severity"] != "note"]
    assert worse == ["wrong_resistor"]
