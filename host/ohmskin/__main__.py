# SPDX-License-Identifier: Apache-2.0
"""``ohmskin`` and ``python -m ohmskin``: the command line.

Until it is imported, which takes half a second, Ctrl-C ends the process as it ends other programs:
without the traceback that a KeyboardInterrupt amid an import shows. Therefore this module begins
with what Python has built in: to import `signal` takes 10 ms, in which Ctrl-C would show one.
"""

import _signal as signal  # type: ignore[import-not-found]

_before = signal.getsignal(signal.SIGINT)
if _before is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command line; the process's exit code says how it went."""
    import sys

    from ohmskin.cli.main import main as run

    try:
        signal.signal(signal.SIGINT, _before)
        run()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        if _before is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # while Python ends, too


if __name__ == "__main__":
    main()
