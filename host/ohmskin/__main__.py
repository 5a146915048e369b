# SPDX-License-Identifier: Apache-2.0
"""``ohmskin`` and ``python -m ohmskin``: the command line.

Importing the command line takes half a second. Until then, Ctrl-C ends the process as it ends other
programs: without the traceback that a KeyboardInterrupt shows during an import. So this module
begins with `_signal`, which is built into Python: to import `signal` takes 10 ms, in which Ctrl-C
would still show a traceback.
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
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # the same while Python ends


if __name__ == "__main__":
    main()
