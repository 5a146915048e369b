# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C: what it ends, and when. Nothing else in the package handles it.

==================================  ==============================================  ============
what runs                           what Ctrl-C does                                exit code
==================================  ==============================================  ============
``stream``, ``view``, ``emulate``   ends the body of `ends_by_ctrl_c` at once       0
``record``, ``calibrate knead``     ends `until_ctrl_c` between two scans           0
``calibrate weights``               the same                                        130
anything else                       raises KeyboardInterrupt up to `cli.main.run`   130
==================================  ==============================================  ============

In ``stream`` and ``estimate``, which write no file meanwhile, `ends_in_time` ends the process if
that takes too long.

Commands of the first two rows need not end by themselves: Ctrl-C is no error. Those of the second
and third write what they read, and Ctrl-C must not come amid a write. 130 is what
shells say of a program that Ctrl-C has ended.
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
# So long after Ctrl-C, `ends_in_time` ends the process [s]. Chosen: a person waits a second.
PATIENCE_S: Final = 0.7
# A Ctrl-C that was dropped comes again after so long [s]. Chosen: the callback is over by then.
_AGAIN_S: Final = 0.01


@contextmanager
def ctrl_c_kept() -> Iterator[None]:
    """Raise, at the latest at the end, what Ctrl-C raises: CasADi and imports may swallow it."""
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

    It drops what a destructor or a callback of a weak reference raises: each import has one.
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

    Python raises nothing before a call of CasADi returns, which may take half a minute. So the body
    must write nothing.
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
    """Pass scans on until Ctrl-C or SIGTERM comes: they end between two, never amid a write.

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

    Python remembers a Ctrl-C that fell into a text that is executed, such as a dataclass's: it ends
    the process as a signal does, handled or not, unless one more such text comes after it.
    """
    namedtuple("Executed", "")
