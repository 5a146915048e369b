# SPDX-License-Identifier: Apache-2.0
"""A frame is estimated with one BLAS thread, and the program keeps those it had."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info

import ohmskin

# Two threads estimate: the first ends while the second is still at work. Twice.
PROGRAM = """
import threading
import numpy as np, scipy.linalg
from threadpoolctl import threadpool_info
from ohmskin.estimate.base import SkinKnowledge
from ohmskin.estimate.ohm import OhmEstimator

def blas_threads():
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

class Waits(OhmEstimator):
    def _solve(self, ports):
        both_inside.wait()
        seen.append(blas_threads())
        both_inside.wait()
        if threading.current_thread() is second:
            first.join()
            seen.append(blas_threads())
        return super()._solve(ports)

def work():
    Waits(SkinKnowledge(2, 2)).estimate(np.tile([0.9, 0.1, 0.9, 0.1], (2, 2, 1)))

assert blas_threads() == {2}
for _ in range(2):
    seen, both_inside = [], threading.Barrier(2)
    first, second = threading.Thread(target=work), threading.Thread(target=work)
    first.start(), second.start(), second.join()
    assert seen == [{1}, {1}, {1}], seen
    assert blas_threads() == {2}
"""


@pytest.mark.skipif(
    not any(library["user_api"] == "blas" for library in threadpool_info()),
    reason="this machine's BLAS does not tell its threads",
)
def test_one_thread_during_an_estimate_and_as_many_as_before_afterwards() -> None:
    path = str(Path(ohmskin.__file__).parents[1])
    two = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **two, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
