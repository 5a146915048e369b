#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Fill a PlatformIO core directory with stand-ins that link to Debian's packages.

Run it with the Python that has PlatformIO and SCons: ``seed.py CORE_DIR``.
"""

import argparse
import json
import re
import shutil
import sys
from pathlib import Path

from platformio.dependencies import get_core_dependencies

PLATFORMS = Path(__file__).resolve().parent / "platforms"
BIN = Path("/usr/bin")
ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
NEEDED = [BIN / "avr-gcc", BIN / "avr-objcopy", BIN / "avrdude", BIN / "cppcheck", ARDUINO]

MARKER = ".ohmskin-standin"
SCONS_PY = "from SCons.Script import main\n\nmain()\n"


class Core:
    """A PlatformIO core directory; replaces only what an earlier run made."""

    def __init__(self, path: Path):
        self.path = path

    def platform(self, name: str) -> None:
        source = PLATFORMS / name
        if directory := self._fresh(f"platforms/{name}"):
            shutil.copytree(source, directory, dirs_exist_ok=True)
            manifest = json.loads((source / "platform.json").read_text())
            self._seal(directory, "platform", manifest["version"])

    def tool(self, name: str, version: str, contents: dict[str, Path | str]) -> None:
        """Make a package; a path in `contents` becomes a link to it, a text a file."""
        if directory := self._fresh(f"packages/{name}"):
            for file, content in contents.items():
                (directory / file).parent.mkdir(exist_ok=True)
                if isinstance(content, Path):
                    (directory / file).symlink_to(content)
                else:
                    (directory / file).write_text(content)
            manifest = {"name": name, "version": version, "description": "Debian stand-in"}
            (directory / "package.json").write_text(json.dumps(manifest))
            self._seal(directory, "tool", version)

    def _fresh(self, relative: str) -> Path | None:
        directory = self.path / relative
        if directory.exists() or directory.is_symlink():
            if not (directory / MARKER).exists():
                print(f"kept {directory}: not a stand-in")
                return None
            shutil.rmtree(directory)
        directory.mkdir(parents=True)
        (directory / MARKER).touch()
        (directory / ".piokeep").touch()  # PlatformIO's own clean-up skips it
        return directory

    def _seal(self, directory: Path, kind: str, version: str) -> None:
        # The record PlatformIO writes after a download: without it, the package is not from
        # "platformio" and `platform = platformio/...` does not match it.
        name = directory.name
        spec = {"owner": "platformio", "id": None, "name": name, "requirements": None, "uri": None}
        record = {"type": kind, "name": name, "version": version, "spec": spec}
        (directory / ".piopm").write_text(json.dumps(record))


def core_version(package: str) -> str:
    """Return the version that this PlatformIO asks for: ``~4.41101.0`` becomes 4.41101.0."""
    match = re.search(r"\d+\.\d+\.\d+", get_core_dependencies()[package])
    assert match, f"PlatformIO names no version of {package}"
    return match[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("core_dir", type=Path, help="the PLATFORMIO_CORE_DIR to fill")
    parser.add_argument("--compiler", type=Path, default=BIN, help="the folder that has avr-gcc")
    arguments = parser.parse_args()
    core, compiler = Core(arguments.core_dir.absolute()), arguments.compiler.absolute()

    if missing := [str(path) for path in NEEDED if not path.exists()]:
        sys.exit(f"seed.py: missing {', '.join(missing)}: run 'make setup', or see README.md")

    core.platform("atmelavr")
    core.platform("native")
    core.tool(
        "toolchain-atmelavr",
        "1.50400.0",
        {f"bin/{program.name}": program for program in compiler.glob("avr-*")},
    )
    core.tool("framework-arduino-avr", "5.1.0", {path.name: path for path in ARDUINO.iterdir()})
    core.tool("tool-avrdude", "1.70100.0", {"bin/avrdude": BIN / "avrdude"})
    core.tool("tool-cppcheck", core_version("tool-cppcheck"), {"cppcheck": BIN / "cppcheck"})
    core.tool("tool-scons", core_version("tool-scons"), {"scons.py": SCONS_PY})
    print(f"PlatformIO stand-ins are in {core.path}")


if __name__ == "__main__":
    main()
