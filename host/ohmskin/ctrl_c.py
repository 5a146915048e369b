# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C: what it ends, and when. No other module of the package handles it.

==================================  ==============================================  ============
what runs                           what Ctrl-C does                                exit code
==================================  ==============================================  ============
``stream``, ``view``, ``emulate``   ends the body of `ends_by_ctrl_c` at once       0
``record``, ``calibrate knead``     ends `until_ctrl_c` between two scans           0
``calibrate weights``               the same                                        130
anything else                       raises KeyboardInterrupt up to `cli.main.run`   130
==================================  ==============================================  ============

In ``stream``, ``estimate`` and ``export``, `ends_in_time` ends the process if Ctrl-C has not done
so in time. Only ``export`` writes a file meanwhile: its partial file may be left then.

Commands of the first two rows go on until somebody ends them, so Ctrl-C is no error there. Commands
of the second and third row write what they read, and Ctrl-C must not come in the middle of a write.
Shells use the exit code 130 for a program that Ctrl-C has ended.
"""

import os
import signal
import sys
import threading
from _thread import interrupt_main
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final, TypeVar

_T = TypeVar("_T")
# `ends_in_time` ends the process so long after Ctrl-C [s]. Chosen: a person waits for a second.
PATIENCE_S: Final = 0.7
# A Ctrl-C that Python has dropped comes again after so long [s]. Chosen: the callback that dropped
# it is over by then.
_AGAIN_S: Final = 0.01


class Condition(threading.Condition):
    """A condition whose lock Ctrl-C never leaves taken.

    ``with`` asks the lock itself here, whose methods are C's: Ctrl-C comes before or after them.
    Those of `threading.Condition` are Python's. Ctrl-C could come at the end of one, when the lock
    was taken and the body had not begun, and then other threads waited for the lock forever.
    """

    __enter__ = property(lambda self: self._lock.__enter__)
    __exit__ = property(lambda self: self._lock.__exit__)


@contextmanager
def ctrl_c_kept() -> Iterator[None]:
    """Raise what Ctrl-C raises, at the end of the body if not before.

    Without this, CasADi or an import may swallow it.
    """
    before, raised = signal.getsignal(signal.SIGINT), list[BaseException]()
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield  # nothing is raised here
        return

    def handle(number: int, frame: FrameType | None) -> None:
        try:
            before(number, frame)
        except BaseException as exc:
            raised.append(exc)
            raise  # this ends Ipopt

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if raised:
            raise raised[0]


def raise_again(dropped: "sys.UnraisableHookArgs") -> None:
    """For `sys.unraisablehook`: a Ctrl-C that Python drops comes once more, and is not printed.

    Python drops what a destructor, or a callback of a weak reference, raises. Each import has such
    a callback.
    """
    if dropped.exc_type is KeyboardInterrupt:
        threading.Timer(_AGAIN_S, interrupt_main).start()
    else:
        sys.__unraisablehook__(dropped)


@contextmanager
def ends_by_ctrl_c() -> Iterator[None]:
    """Ctrl-C ends the body at once, wherever it is, and the program goes on after it."""
    with suppress(KeyboardInterrupt), ctrl_c_kept():
        yield


@contextmanager
def ends_in_time(leave: Callable[[], object]) -> Iterator[None]:
    """End the process, after `leave`, if Ctrl-C has not ended the body within `PATIENCE_S`.

    Without this, nothing would be raised until a call of CasADi returns, which may take half a
    minute. As the process may end anywhere in the body, the body must write nothing, or by
    `ohmskin.files.whole_file`: it never leaves half a file under the file's own name, and later
    removes a partial file that was left.
    """
    has_ended, (reads, writes) = threading.Event(), os.pipe()

    def watch() -> None:
        if os.read(reads, 1) and not has_ended.wait(PATIENCE_S):
            leave()
            os._exit(130)

    os.set_blocking(writes, False)
    before = signal.set_wakeup_fd(writes)
    watcher = threading.Thread(target=watch, name="ctrl-c", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        has_ended.set()
        signal.set_wakeup_fd(before)
        os.close(writes)  # ends the watcher
        watcher.join()
        os.close(reads)


def until_ctrl_c(scans: Iterable[_T]) -> Iterator[_T]:
    """Pass scans on until Ctrl-C or SIGTERM comes: they end between two, and never during a write.

    The signal interrupts the wait for the next scan, and nothing else.
    """
    is_stopped = waits = False

    def handle(*_: object) -> None:
        nonlocal is_stopped
        is_stopped = True
        if waits:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with suppress(KeyboardInterrupt):
            source = iter(scans)
            while True:
                waits = True
                scan = None if is_stopped else next(source, None)
                waits = False
                if scan is None:
                    return
                yield scan
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def forget_ctrl_c() -> None:
    """Let a program that has handled Ctrl-C end with its own exit code.

    Python remembers a Ctrl-C that came while a text was executed, as for a dataclass. In the end it
    then ends the process as a signal does, even if the Ctrl-C was handled, unless one more text is
    executed after it. So one is executed here.
    """
    namedtuple("Executed", "")
