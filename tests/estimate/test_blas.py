# SPDX-License-Identifier: Apache-2.0
"""A frame is estimated with one BLAS thread, and the program keeps those it had."""

import pytest
from threadpoolctl import threadpool_info

from command_line import python

# Two threads estimate: the first begins, the second begins, the first ends, the second ends. Both
# threads live on meanwhile. All of it twice.
PROGRAM = """
from concurrent.futures import ThreadPoolExecutor
from threading import Event
import numpy as np, scipy.linalg
from threadpoolctl import threadpool_info
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.ohm import OhmEstimator

def blas_threads():
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

class Waits(OhmEstimator):
    def __init__(self):
        super().__init__(SkinKnowledge(2, 2))
        self.has_begun, self.may_end = Event(), Event()

    def _solve(self, ports):
        self.has_begun.set()
        assert self.may_end.wait(10)
        assert blas_threads() == {1}
        return super()._solve(ports)

frame = np.tile([0.9, 0.1, 0.9, 0.1], (2, 2, 1))
assert blas_threads() == {2}
with ThreadPoolExecutor(2) as pool:
    for _ in range(2):
        estimators, results = (Waits(), Waits()), []
        for estimator in estimators:
            results.append(pool.submit(estimator.estimate, frame))
            assert estimator.has_begun.wait(10)
        for estimator, result in zip(estimators, results):
            estimator.may_end.set()
            result.result()
        assert blas_threads() == {2}
"""


@pytest.mark.skipif(
    not any(library["user_api"] == "blas" for library in threadpool_info()),
    reason="this machine's BLAS does not tell its threads",
)
def test_one_thread_during_an_estimate_and_as_many_as_before_afterwards() -> None:
    two = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    done = python("-c", PROGRAM, **two)
    assert done.code == 0, done.err
