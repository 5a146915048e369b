# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C leaves no lock taken."""

import signal
import threading
import time

from ohmskin.ctrl_c import Condition


def is_left_taken(changed: threading.Condition) -> bool:
    """Whether Ctrl-C leaves this condition's lock taken if it comes as the lock is given away."""
    is_taken, ends = threading.Event(), []

    def give_away() -> None:
        with changed:
            is_taken.set()
            time.sleep(0.02)  # until the main thread waits for the lock
        signal.raise_signal(signal.SIGINT)

    def take() -> None:
        ends.append(changed.acquire(timeout=0.1))

    other = threading.Thread(target=give_away)
    other.start()
    is_taken.wait()
    try:
        with changed:
            while True:
                time.sleep(0.001)
    except KeyboardInterrupt:
        pass
    other.join()
    after = threading.Thread(target=take)
    after.start()
    after.join()
    return not ends[0]


def test_ctrl_c_leaves_no_lock_taken() -> None:
    """A command that read a board never ended: its reader waited for a lock of the main thread."""
    assert not any(is_left_taken(Condition()) for _ in range(20))
