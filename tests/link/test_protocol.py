# SPDX-License-Identifier: Apache-2.0
"""The protocol definition and its golden vectors, which other code than the project's has made."""

import ast
import importlib.util
import shutil
import subprocess
import sys
import tokenize
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_helpers import VECTORS
from ohmskin.link import framing, protocol
from ohmskin.link.messages import (
    Ack,
    BoardDecoder,
    ForeignHello,
    Hello,
    Message,
    Scan,
    SelfTestReport,
)
from places import ROOT
from skins import PASSES, placed

each_valid = pytest.mark.parametrize("vector", VECTORS["valid"], ids=lambda v: v["name"])
each_damaged = pytest.mark.parametrize("vector", VECTORS["damaged"], ids=lambda v: v["name"])


def expected_raw(vector: dict[str, Any]) -> framing.RawFrame:
    content = bytes.fromhex(vector["content"])
    return framing.RawFrame(content[0], content[1], content[2:])


def codes_of(vector: dict[str, Any]) -> np.ndarray:
    """The codes of the rows and columns that a scan has read."""
    fields = vector["fields"]
    lines = fields["row_mask"].bit_count(), fields["column_mask"].bit_count()
    return placed(vector["codes"], *lines, fields["mode"])


def python_values(fields: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}


# ------------------------------------------------------------------------------ golden vectors


@each_valid
def test_valid_vector_is_decoded_and_encoded(vector: dict[str, Any]) -> None:
    decoder, raw = framing.Decoder(), expected_raw(vector)
    assert decoder.feed(bytes.fromhex(vector["wire"])) == [raw]
    assert (decoder.stats.frames, decoder.stats.damaged) == (1, 0)
    kind, fields = protocol.FRAMES_BY_ID[raw.type], python_values(vector["fields"])
    assert kind.unpack(raw.payload) == fields
    payload = kind.pack(**fields)
    if "codes" in vector:
        payload += protocol.pack_codes(codes_of(vector), protocol.PER_PASS[fields["mode"]])
    assert framing.encode(kind.id, raw.sequence, payload).hex() == vector["wire"]


@each_damaged
def test_damaged_vector_is_counted_and_the_next_frame_decoded(vector: dict[str, Any]) -> None:
    good = VECTORS["valid"][-1]
    decoder = framing.Decoder()
    assert decoder.feed(bytes.fromhex(vector["wire"])) == []
    assert decoder.stats.damaged == 1
    assert decoder.feed(bytes.fromhex(good["wire"])) == [expected_raw(good)]
    assert decoder.stats.damaged == 1


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("ack", Ack),
        ("hello", ForeignHello),  # of a definition of another day
        ("self_test_report", SelfTestReport),
        ("scan", Scan),
    ],
)
def test_vectors_of_a_board_become_messages(kind: str, expected: type[Message]) -> None:
    vectors = [v for v in VECTORS["valid"] if v["name"].startswith(kind)]
    assert vectors
    for vector in vectors:
        decoder = BoardDecoder()
        (message,) = decoder.feed(bytes.fromhex(vector["wire"]), 12.5)
        assert type(message) is expected
        fields = python_values(vector["fields"])
        if isinstance(message, Scan):
            assert message.number == fields["scan"]
            assert message.time_us == fields["time_us"]
            assert message.host_time_s == 12.5
            assert (message.rows, message.columns) == (fields["rows"], fields["columns"])
            codes = message.ratio * 1024 - 0.5
            rows, columns = (
                [line for line in range(32) if fields[mask] >> line & 1]
                for mask in ("row_mask", "column_mask")
            )
            np.testing.assert_array_equal(codes[np.ix_(rows, columns)], codes_of(vector))
            assert np.isfinite(codes).sum() == len(vector["codes"])
            np.testing.assert_array_equal(message.read, np.isfinite(codes[..., 0]))
            assert message.is_whole == message.read.all()
            np.testing.assert_array_equal(message.codes_read, codes_of(vector))
        elif isinstance(message, ForeignHello):
            assert message.layout_crc == fields["layout_crc"]
        else:
            assert {name: getattr(message, name) for name in fields} == fields


def test_a_hello_of_this_definition_becomes_a_message() -> None:
    vector = next(v for v in VECTORS["valid"] if v["name"] == "hello")
    fields = python_values(vector["fields"]) | {"layout_crc": protocol.LAYOUT_CRC}
    kind = protocol.FRAMES["hello"]
    wire = framing.encode(kind.id, 0, kind.pack(**fields))
    (hello,) = BoardDecoder().feed(wire, 0.0)
    assert isinstance(hello, Hello)
    assert {name: getattr(hello, name) for name in fields} == fields
    assert hello.version == "0.1.0"
    assert hello.rate_hz == pytest.approx(16e6 / 177762)


def test_vectors_are_those_of_the_cobs_package(tmp_path: Path) -> None:
    script = shutil.copy(ROOT / "protocol" / "make_vectors.py", tmp_path)
    subprocess.run([sys.executable, script], check=True, timeout=60)
    made = (tmp_path / "vectors.json").read_bytes()
    assert made == (ROOT / "protocol" / "vectors.json").read_bytes()


# -------------------------------------------------------------------------------------- codes


@settings(max_examples=40)
@given(
    st.integers(1, 16),
    st.integers(1, 16),
    st.sampled_from(list(PASSES)),
    st.sampled_from([10, 12, 14, 16]),
    st.randoms(use_true_random=False),
)
def test_codes_are_packed_like_one_long_integer(
    rows: int, columns: int, mode: str, bits: int, random: Any
) -> None:
    count = rows * columns * sum(map(len, PASSES[mode]))
    in_order = [random.getrandbits(bits) for _ in range(count)]
    number = sum(code << (bits * i) for i, code in enumerate(in_order))
    packed = number.to_bytes((count * bits + 7) // 8, "little")
    codes, per_pass = placed(in_order, rows, columns, mode), len(PASSES[mode][0])
    assert protocol.codes_size(count, bits) == len(packed)
    assert protocol.pack_codes(codes, per_pass, bits) == packed
    unpacked = protocol.unpack_codes(packed, codes.shape, per_pass, bits)
    np.testing.assert_array_equal(unpacked, codes)


@pytest.mark.parametrize("octets", [0, 4, 6, 320])
def test_codes_of_another_size_are_refused(octets: int) -> None:
    with pytest.raises(ValueError, match="1 x 1 x 4 codes of 10 bits"):
        protocol.unpack_codes(bytes(octets), (1, 1, 4))


def test_a_code_beyond_ten_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="1023"):
        protocol.pack_codes(np.full((2, 2, 4), 1024, dtype=np.uint16))


NO_TIME = {"time_us": 0, "rate_mhz": 0}
HELLO = python_values(next(v for v in VECTORS["valid"] if v["name"] == "hello")["fields"])


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("set_unit_id", {}, "unit_id"),
        ("set_unit_id", {"unit_id": 1, "more": 2}, "more"),
        ("set_unit_id", {"unit_id": -1}, "unit_id is -1"),
        ("set_unit_id", {"unit_id": 1 << 32}, "4294967295"),
        ("ack", {"command": 1, "command_sequence": 0, "result": "perhaps"} | NO_TIME, "perhaps"),
        ("hello", {**HELLO, "board": "a board of seventeen"}, "16 letters at most"),
        ("start", {"now": 1}, "now"),
    ],
)
def test_wrong_fields_are_refused(name: str, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        protocol.FRAMES[name].pack(**values)


@pytest.mark.parametrize("frame", protocol.FRAMES.values(), ids=lambda f: f.name)
def test_a_payload_of_another_length_is_refused(frame: protocol.Frame) -> None:
    size = frame.struct.size
    wrong = [size - 1] if frame.tail else [size - 1, size + 1]
    for length in wrong:
        if length >= 0:
            with pytest.raises(ValueError, match=frame.name):
                frame.unpack(bytes(length))


def test_crc_check_value() -> None:
    assert protocol.crc16(b"123456789") == 0x29B1


# --------------------------------------------------------------------------------- definition


# What protocol/generate.py reads and writes.
TREE = (
    *("protocol/generate.py", "protocol/frames.toml", "protocol/vectors.json"),
    *("protocol/frames.h", "protocol/FRAMES.md", "firmware/test/vectors.h"),
    "host/ohmskin/link/protocol.py",
)


class Tree:
    """A copy of these files. Its modules take the place of this checkout's."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path, self._monkeypatch = path, monkeypatch
        monkeypatch.setattr(sys, "path", list(sys.path))  # generate.py adds its own tree
        for name in TREE:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, path / name)

    def module(self, name: str, path: str) -> Any:
        spec = importlib.util.spec_from_file_location(name, self.path / path)
        module = importlib.util.module_from_spec(spec)
        self._monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    def protocol(self) -> Any:
        return self.module("ohmskin.link.protocol", "host/ohmskin/link/protocol.py")

    def layout_crc(self, definition: str) -> int:
        """What the host computes of the text of a frames.toml."""
        (self.path / "protocol" / "frames.toml").write_text(definition, encoding="utf-8")
        return int(self.protocol().LAYOUT_CRC)

    def generate(self, *arguments: str) -> int:
        """What protocol/generate.py exits with."""
        self.protocol()
        return int(self.module("generate", "protocol/generate.py").main(list(arguments)))


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tree:
    return Tree(tmp_path, monkeypatch)


DEFINITION_TEXT = (ROOT / "protocol" / "frames.toml").read_text(encoding="utf-8")

# Texts that occur once in frames.toml, and what they become.
CHANGES_OF_MEANING = {
    "a frame's id": ('name = "save"\nid = 0x86', 'name = "save"\nid = 0x8A'),
    "a frame's name": ('name = "self_test"\n', 'name = "test_self"\n'),
    "a frame's sender": ('id = 0x84\nfrom = "host"', 'id = 0x84\nfrom = "board"'),
    "a field's name": ('name = "settle_asked_us"', 'name = "settle_wanted_us"'),
    "a field's type": ('name = "rx_errors", type = "u16"', 'name = "rx_errors", type = "u32"'),
    "a field's count": (
        'name = "code_min", type = "u16", count = "readings"',
        'name = "code_min", type = "u16"',
    ),
    "a field's enum": ('type = "u16", flags = "finding"', 'type = "u16", flags = "reset_cause"'),
    "an enum's value": ('name = "busy", value = 12', 'name = "busy", value = 15'),
    "an enum's member": ('name = "brown_out", value = 4', 'name = "brownout", value = 4'),
    "a constant": ("value = 3000\n", "value = 3001\n"),
    "the CRC": ("crc_initial = 0xFFFF", "crc_initial = 0x0000"),
}
CHANGES_OF_TEXT = {
    "a frame's doc": ('doc = "ask for `hello`"', 'doc = "another text"'),
    "a field's doc": ('doc = "rows that this board can scan"', 'doc = "another text"'),
    "an enum's doc": (
        'doc = "how exact a conversion is, and so how long it takes"',
        'doc = "another text"',
    ),
    "a member's doc": ('doc = "supply came up"', 'doc = "another text"'),
    "a constant's doc": ('doc = "slowest scan rate"', 'doc = "another text"'),
    "a comment": ("# The whole link between", "# Everything between"),
}


def changed(change: tuple[str, str]) -> str:
    old, new = change
    assert DEFINITION_TEXT.count(old) == 1
    return DEFINITION_TEXT.replace(old, new)


@pytest.mark.parametrize("what", CHANGES_OF_MEANING | CHANGES_OF_TEXT)
def test_layout_crc_changes_with_the_meaning_alone(what: str, tree: Tree) -> None:
    crc = tree.layout_crc(changed((CHANGES_OF_MEANING | CHANGES_OF_TEXT)[what]))
    assert (crc != protocol.LAYOUT_CRC) == (what in CHANGES_OF_MEANING)


def test_layout_crc_changes_with_the_order_of_fields(tree: Tree) -> None:
    lines = DEFINITION_TEXT.splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if 'name = "version_major"' in line)
    lines[at], lines[at + 1] = lines[at + 1], lines[at]
    assert tree.layout_crc("".join(lines)) != protocol.LAYOUT_CRC


def test_generated_files_are_up_to_date(tree: Tree) -> None:
    assert tree.generate("--check") == 0


@pytest.mark.parametrize(
    ("changed_file", "stale"),
    [
        ("protocol/frames.h", ["protocol/frames.h"]),
        ("protocol/FRAMES.md", ["protocol/FRAMES.md"]),
        ("firmware/test/vectors.h", ["firmware/test/vectors.h"]),
        ("protocol/frames.toml", ["protocol/frames.h", "protocol/FRAMES.md"]),
        ("protocol/vectors.json", ["firmware/test/vectors.h"]),
    ],
)
def test_a_stale_generated_file_is_named(
    tree: Tree, changed_file: str, stale: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tree.path / changed_file
    before = path.read_text(encoding="utf-8")
    after = {
        ".toml": lambda: before.replace('name = "busy", value = 12', 'name = "busy", value = 14'),
        ".json": lambda: before.replace('"name": "start"', '"name": "begin"'),
    }.get(path.suffix, lambda: before + "\n")()
    assert after != before
    path.write_text(after, encoding="utf-8")
    contents = [(tree.path / name).read_bytes() for name in TREE]
    assert tree.generate("--check") == 1
    named = capsys.readouterr().err
    for name in ("protocol/frames.h", "protocol/FRAMES.md", "firmware/test/vectors.h"):
        assert (name in named) == (name in stale)
    assert contents == [(tree.path / name).read_bytes() for name in TREE]
    assert tree.generate() == 0
    assert tree.generate("--check") == 0


def test_no_protocol_number_is_repeated_in_the_host() -> None:
    constants = protocol.CONSTANTS
    # Only where written in hexadecimal; a board's ids are too small to tell.
    ids = {f.id for f in protocol.FRAMES.values() if f.sender == "host"}
    bauds = {constants["baud_default"], constants["baud_fast"]}
    distinctive = {
        protocol.DEFINITION["framing"]["crc_polynomial"],
        protocol.LAYOUT_CRC,
        *(constants[name] for name in ("settle_us_max", "rate_mhz_max", "baud_default")),
    }
    repeated = []
    for path in sorted((ROOT / "host" / "ohmskin").rglob("*.py")):
        if path.name == "simavr.py":  # talks to the simulator, whose own limits look alike
            continue
        with path.open("rb") as source:
            for token in tokenize.tokenize(source.readline):
                if token.type != tokenize.NUMBER:
                    continue
                value = ast.literal_eval(token.string)
                if (
                    value in distinctive
                    or (value in ids and token.string.lower().startswith("0x"))
                    or (value in bauds and "baud" in token.line)
                ):
                    repeated.append(f"{path.name}:{token.start[0]}: {token.line.strip()}")
    assert repeated == []
