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
