# SPDX-License-Identifier: Apache-2.0
"""``python -m fuzz [SECONDS [TARGET...]]``: fuzz the targets, guided by coverage, each its share.

Each run goes other ways, by a seed that it prints. It ends with the first input that raises, takes
more than a second of the processor, or more than 500 MB. What atheris finds on its way is kept in
build/fuzz. An input that broke something goes into fuzz/corpus/TARGET: every run begins with that,
and `make test` runs it.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"
FOUND = Path("build/fuzz")
MOST_MB = 500
# What is guided: ours, and what reads what strangers say to the page.
GUIDED = ["ohmskin", "h11", "uvicorn.protocols", "wsproto"]
# Not guided by these: what atheris 3.0 puts into code loses some 40 bytes whenever an array is
# compared, and each emulated board compares several: 36 MB in a million inputs of `urls`. For
# atheris, the name of a package leaves out none of its modules.
ARITHMETIC = [f"ohmskin.circuit.{name}" for name in ("configurations", "ports", "skin")]
MOST_S = 1  # of the processor: other programs may keep it busy
HANGS_S = 300  # by the clock, however busy the machine is
# The variable of the environment that says which ways a run goes.
SEED = "FUZZ_SEED"


def fuzz(target: str, seconds: int) -> None:
    """Fuzz in this process, which libFuzzer ends."""
    import atheris

    with atheris.instrument_imports(include=GUIDED, exclude=ARITHMETIC):
        from fuzz.targets import TARGETS, seeds

        given = seeds()[target]  # it imports what the package imports late

    folder = FOUND / target
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(given):
        (folder / f"seed{number}").write_bytes(seed)
    kept = [str(CORPUS / target)] if (CORPUS / target).is_dir() else []
    options = (f"-max_total_time={seconds}", f"-timeout={HANGS_S}", f"-rss_limit_mb={MOST_MB}")
    more = (
        f"-seed={int(os.environ[SEED])}",
        "-max_len=20000",
        "-print_final_stats=1",
        f"-artifact_prefix={FOUND}/broken-{target}-",
    )

    def timed(octets: bytes) -> None:
        begin_s = time.process_time()
        TARGETS[target](octets)
        assert time.process_time() - begin_s < MOST_S, "it takes too long"

    atheris.Setup([sys.argv[0], *options, *more, str(folder), *kept], timed)
    atheris.Fuzz()


def main() -> None:
    """Fuzz each target in a process of its own."""
    match sys.argv[1:]:
        case ["--one", target, seconds]:
            fuzz(target, int(seconds))
            return
        case [seconds, *named]:
            pass
        case _:
            seconds, named = "600", []
    from fuzz.targets import TARGETS

    seed = os.environ.setdefault(SEED, str(int(time.time())))
    print(f"{SEED}={seed} goes the same ways again", flush=True)
    for target in named or TARGETS:
        share = max(int(seconds) // len(named or TARGETS), 1)
        print(f"{target}: {share} s", flush=True)
        call = [sys.executable, "-m", "fuzz", "--one", target, str(share)]
        done = subprocess.run(call, stderr=subprocess.PIPE, text=True, errors="replace")
        if done.returncode:
            said = [
                line for line in done.stderr.splitlines() if line[:1] != "#" and "INFO" not in line
            ]
            sys.exit("\n".join([*said, f"{target}: see {FOUND}/broken-{target}-*"]))
        stats = [line.split()[-1] for line in done.stderr.splitlines() if line.startswith("stat::")]
        print(f"{target}: {stats[0]} inputs, slowest below {MOST_S} s, {stats[-1]} MB", flush=True)


if __name__ == "__main__":
    main()
