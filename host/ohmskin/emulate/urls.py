# SPDX-License-Identifier: Apache-2.0
"""From a URL to a board without hardware: ``emulator://8x8?scene=ghost`` and ``simavr://uno``.

docs/commands.md lists the options. Those of the board, and of what touches its skin, are named
here; those of faults are defined in `faults`.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from ohmskin.circuit.plate import load_plate
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.board import LINES_MAX, BoardSettings, EmulatedBoard
from ohmskin.emulate.driver import EmulatorLink, SteppedLink, SteppedSkin
from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS, LineFaults, SkinFaults, faults_of
from ohmskin.emulate.scale import DEFAULTS, SCALE_OPTIONS, EmulatedScale
from ohmskin.emulate.scenes import LEAD_OHM, Scene
from ohmskin.emulate.simavr import SimavrLink
from ohmskin.errors import PortError
from ohmskin.link.protocol import LAYOUT_CRC
from ohmskin.link.session import Session
from ohmskin.link.url import PortUrl

# Noise of an emulated converter, unless told [LSB]. Chosen: a sound board's converter has as much.
DEFAULT_NOISE_LSB: Final = 0.3
# The options of both kinds of boards that say what the skin is and what touches it.
_OF_SCENE: Final = ("scene", "begin", "plate", "lead")
# The options of an emulated board that are no faults.
_OF_BOARD: Final = (*_OF_SCENE, "seed", "rate", "noise", "unit", "mode", "foreign", "speed")


def open_emulator(text: str) -> Session:
    """Connect to the board of an ``emulator://`` URL.

    :raises PortError: the URL is wrong.
    """
    board, scene, faults = emulated(text)
    if is_stepped(text):
        skin: Session = SteppedSkin(SteppedLink(board, text, faults))
    else:
        skin = Session(EmulatorLink(board, text, faults))
    return _in_scene(skin, scene, lambda board_s: board.boot_s + board_s)


def open_simavr(text: str) -> Session:
    """Connect to the board of a ``simavr://`` URL, whose other options are the simulator's.

    :raises PortError: the URL is wrong, or the simulator or the firmware is not built.
    """
    url = PortUrl.of(text)
    # The speed is read first: if it is wrong, no simulator has to be ended.
    settings, baud = dict(url.options), url.baud
    with url.blamed():
        scene = _scene(url, f"{settings.pop('rows', 8)}x{settings.pop('columns', 8)}")
        if scene.name == "slip":
            raise ValueError("a slip is too fast for simavr: take emulator://8x8?scene=slip")
        for name in (*_OF_SCENE, "baud"):
            settings.pop(name, None)
        link = SimavrLink(url.place, scene, text, settings)
        skin = Session(link, baud)
        # A board with a boot loader is reset when its port is opened. So it has just begun to count
        # time, and has said hello at once.
        boot_s = link.now_s if link.resets_board else 0.0
        return _in_scene(skin, scene, lambda board_s: link.scene_s(boot_s + board_s))


def _in_scene(skin: Session, scene: Scene, scene_s: Callable[[float], float]) -> Session:
    """The skin, which now knows the true forces of its scene.

    scene_s: the scene's time [s] at a time of the board's clock [s].
    """
    skin.true_force_n = lambda scan: scene.force_n(scene_s(1e-6 * scan.time_us))
    if scene.name == "weights":
        skin.put = scene.put
    return skin


def emulated(text: str) -> tuple[EmulatedBoard, Scene, LineFaults]:
    """The emulated board of an ``emulator://`` URL, what it reads, and the faults of its line.

    :raises PortError: the URL is wrong.
    """
    url = PortUrl.of(text)
    if url.scheme != "emulator":
        raise PortError(f"{text} is not emulated: write emulator://8x8")
    url.check_options(*_OF_BOARD, *SKIN_FAULTS, *LINE_FAULTS, *SCALE_OPTIONS)
    with url.blamed():
        if url.options.get("speed", "1") not in ("0", "1"):
            raise ValueError("speed must be 1, or 0: as fast as scans are taken")
        seed = _seed(url)
        faults = faults_of(SkinFaults, url.options)
        scene = _scene(url, url.place, faults)
        settings = BoardSettings(
            *(scene.rows, scene.columns),
            mode=url.options.get("mode", "near"),
            rate_hz=url.number_if_given("rate"),
            unit_id=url.number("unit", 0),
        )
        board = EmulatedBoard(
            scene.ratio,
            settings,
            noise_lsb=url.number("noise", DEFAULT_NOISE_LSB),
            seed=seed,
            sampled=faults.sampled,
            says={"layout_crc": LAYOUT_CRC ^ url.number("foreign", 0)},
        )
        board.on_start = scene.wait
        return board, scene, faults_of(LineFaults, url.options, seed=seed)


def _seed(url: PortUrl) -> int:
    """Of all that is random."""
    seed = url.number("seed", 0)
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, not {seed}")
    return seed


def scale_under(scene: Scene, text: str) -> EmulatedScale:
    """The scale under the skin of a scene, by the options of its ``emulator://`` URL.

    :raises PortError: the URL is wrong.
    """
    url = PortUrl.of(text)
    with url.blamed():
        rate_hz, lag_s, noise_g = (url.number(name, usual) for name, usual in DEFAULTS.items())
        seed = _seed(url)
        return EmulatedScale(
            lambda time_s: float(scene.force_n(time_s).sum()), rate_hz, lag_s, noise_g, seed
        )


def is_stepped(text: str) -> bool:
    """Whether an emulated board has time only while somebody waits for it: ``speed=0``."""
    url = PortUrl.of(text)
    return url.scheme == "emulator" and url.options.get("speed") == "0"


def _scene(url: PortUrl, size: str, faults: SkinFaults | None = None) -> Scene:
    """The scene that a URL asks for, on a skin of a size as "8x8". Raises ValueError as `Scene`."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", size)
    rows, columns = map(int, match.groups()) if match else (0, 0)
    if not (1 <= rows <= LINES_MAX and 1 <= columns <= LINES_MAX):
        raise ValueError(f"a size is as 8x8, from 1x1 to {LINES_MAX}x{LINES_MAX}, not '{size}'")
    name, begin_s = url.options.get("scene", "rest"), url.number_if_given("begin")
    seed = _seed(url)
    scene = Scene(name, rows, columns, seed=seed, faults=faults, begin_s=begin_s)
    if "plate" in url.options:
        plate = load_plate(url.options["plate"])
        if plate.shape != (rows, columns):
            cells = "x".join(map(str, plate.shape))
            raise ValueError(f"the plate has {cells} cells, the skin {rows}x{columns}")
        no_wires = np.zeros_like(plate)
        scene.rest = Skin(plate, no_wires, no_wires)
    scene.rest = replace(scene.rest, lead_ohm=np.array(url.number("lead", LEAD_OHM)))
    return scene
