# SPDX-License-Identifier: Apache-2.0
"""What a run of the command line leaves, and programs of another process, for several tests."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import ohmskin
from places import ROOT

# For another process: the package that is tested here, and what is beside it in this checkout.
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join([str(Path(ohmskin.__file__).parents[1]), str(ROOT)]),
    "PYTHONUNBUFFERED": "1",
    "COLUMNS": "200",
}


class Done(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Done]
Command = Callable[..., "subprocess.Popen[str]"]


def finish(process: "subprocess.Popen[str]", limit_s: float = 60.0) -> Done:
    out, err = process.communicate(timeout=limit_s)
    return Done(process.returncode, out, err)


def python(*arguments: str | Path, **variables: str) -> Done:
    """What a Python of its own, with these variables of its environment, does with `arguments`."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        command, env=ENVIRONMENT | variables, capture_output=True, text=True, timeout=60
    )
    return Done(done.returncode, done.stdout, done.stderr)


# A command line that prints, last of all, the most memory that it had [kB]. Not `ru_maxrss`: that
# of a new process begins with what the one that starts it has.
PRINTS_PEAK = """
import atexit, pathlib, re
status = pathlib.Path("/proc/self/status")
atexit.register(lambda: print(re.search(r"VmHWM:\\s+(\\d+)", status.read_text())[1]))
from ohmskin.cli.main import main
main()
"""
_BOUNDED = f"""
import resource
resource.setrlimit(resource.RLIMIT_AS, (4_000_000_000, 4_000_000_000))
{PRINTS_PEAK}"""
# What a run takes that reads next to nothing [MB]: 75 measured, and some for other versions.
EMPTY_MB = 90.0


def bounded(*arguments: str | Path) -> tuple[Done, float]:
    """What ``ohmskin ARGUMENTS`` does within 4 GB of addresses, and the most memory it had [MB]."""
    done = python("-c", _BOUNDED, *arguments, OPENBLAS_NUM_THREADS="1")
    *lines, peak_kb = done.out.splitlines(keepends=True)
    return done._replace(out="".join(lines)), int(peak_kb) / 1000


def well(done: Done) -> Done:
    """What has ended well, and complained of nothing."""
    assert (done.code, done.err) == (0, ""), done
    return done


def assert_one_line(done: Done, *words: str) -> None:
    assert done.code == 2
    assert done.out == ""
    assert done.err.startswith("ohmskin: ")
    assert done.err.count("\n") == 1
    assert done.err.endswith("\n")
    for word in words:
        assert word in done.err
