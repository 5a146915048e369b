# SPDX-License-Identifier: Apache-2.0
"""``ohmskin`` and ``python -m ohmskin``: the command line.

Until it is imported, which takes half a second, Ctrl-C ends the process as it ends other programs:
without the traceback that a KeyboardInterrupt amid an import shows.
"""

import signal

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
