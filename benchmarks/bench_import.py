# SPDX-License-Identifier: Apache-2.0
"""Measure what importing the package and asking for its help cost, and when a demo says a word.

    make bench-import

The processor time of a process is divided by that of one that imports what every host program needs
anyway: numpy, scipy.linalg and serial. The programs take turns; the median of each counts.

reference_ms    user and system time of `import numpy, scipy.linalg, serial` [ms]
import_ratio    `import ohmskin`: names load their modules when they are first asked for
open_ratio      `import ohmskin`, and a board is opened and asked for a scan: an emulated one
help_ratio      `ohmskin --help`
word_ratio      time until `ohmskin demo` has printed something, over that of `import numpy`
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time

from bars import Part, at_most, run  # beside this file

RUNS = 9  # of each program. Chosen.
REFERENCE = ("-c", "import numpy, scipy.linalg, serial")
OPEN = "import ohmskin\nwith ohmskin.open('emulator://2x2') as skin: skin.latest()"
PROGRAMS = {
    "import_ratio": ("-c", "import ohmskin"),
    "open_ratio": ("-c", OPEN),
    "help_ratio": ("-m", "ohmskin", "--help"),
}
BARS = (at_most("import_ratio", 1.6), at_most("help_ratio", 2.6), at_most("word_ratio", 4))


def cpu_s(arguments: tuple[str, ...]) -> float:
    """User and system time of one run of Python [s]."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    return used.ru_utime + used.ru_stime


def word_s(*arguments: str) -> float:
    """Time until a run of Python prints something, or ends [s]."""
    begin_s = time.monotonic()
    with subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.read(1)
        taken_s = time.monotonic() - begin_s
        process.kill()
    return taken_s


def measure(part: Part) -> dict[str, float]:
    """All figures, as the JSON line has them."""
    runs = part.of(RUNS)
    programs = {"reference": REFERENCE, **PROGRAMS}
    for arguments in programs.values():
        cpu_s(arguments)  # its first run compiles modules
    times = [{name: cpu_s(program) for name, program in programs.items()} for _ in range(runs)]
    median = {name: statistics.median(run[name] for run in times) for name in programs}
    figures = {"reference_ms": round(1e3 * median["reference"], 1)}
    figures |= {name: round(median[name] / median["reference"], 2) for name in PROGRAMS}
    words = [(word_s("-m", "ohmskin", "demo"), word_s("-c", "import numpy")) for _ in range(runs)]
    demo_s, numpy_s = map(statistics.median, zip(*words, strict=True))
    figures["word_ratio"] = round(demo_s / numpy_s, 2)
    return figures


if __name__ == "__main__":
    sys.exit(run(__doc__, measure, BARS))
