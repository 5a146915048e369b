# SPDX-License-Identifier: Apache-2.0
"""Matrices as small as a skin's, solved fast: LAPACK directly, and one BLAS thread.

What scipy.linalg checks before it calls LAPACK takes as long again, and more threads are slower.
Symmetric matrices and factors are lower triangles, in Fortran's order; what is above is anything.
"""

import threading
from contextlib import ContextDecorator
from typing import Any

import numpy as np
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

from ohmskin.arrays import Float


def gram(rows: Float, onto: Float | None = None) -> Float:
    """rows rows^T, added onto a matrix that is overwritten, if there is one."""
    turned = rows.T  # C's order is Fortran's of the transpose: nothing is copied
    beta = 0.0 if onto is None else 1.0
    return np.asarray(blas.dsyrk(1.0, turned, beta, onto, trans=1, lower=1, overwrite_c=1))


def cholesky(system: Float) -> Float:
    """L of a positive definite matrix L L^T.

    One that rounding has made indefinite gets the least share of its largest diagonal element, from
    1e-14, that mends it. A C-ordered matrix must be symmetric: it is its own transpose, in
    Fortran's order.
    Raises LinAlgError if a millionth does not.
    """
    lower = system if system.flags.f_contiguous else system.T
    factor, failed = lapack.dpotrf(lower, lower=1, clean=0)
    share = 1e-14
    while failed and share < 1e-5:
        mended = lower.copy(order="F")
        np.einsum("ii->i", mended)[:] += share * np.diagonal(lower).max()
        factor, failed = lapack.dpotrf(mended, lower=1, clean=0)
        share *= 100
    _check(failed)
    return np.asarray(factor)


def solve(factor: Float, right: Float) -> Float:
    """x of L L^T x = right, for one or several columns."""
    solution, failed = lapack.dpotrs(factor, right, lower=1)
    _check(failed)
    return np.asarray(solution)


def solve_positive(system: Float, right: Float) -> Float:
    """x of system x = right, for a system that nothing else is solved with: faster than both above.

    One that rounding has made indefinite is mended as in `cholesky`, with the same error.
    """
    if not len(system):  # LAPACK takes no empty one
        return np.zeros_like(right)
    _, solution, failed = lapack.dposv(system, right, lower=1)
    return solve(cholesky(system), right) if failed else np.asarray(solution)


def inverse(factor: Float) -> Float:
    """(L L^T)^-1, both triangles."""
    lower, failed = lapack.dpotri(factor, lower=1)
    _check(failed)
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def inverse_trace(factor: Float) -> float:
    """The trace of (L L^T)^-1."""
    lower, failed = lapack.dpotri(factor, lower=1)
    _check(failed)
    return float(lower.trace())


def solve_lower(factor: Float, right: Float, *, transposed: bool = False) -> Float:
    """x of L x = right, or of L^T x = right."""
    solution, failed = lapack.dtrtrs(factor, right, lower=1, trans=int(transposed))
    _check(failed)
    return np.asarray(solution)


def _check(failed: int) -> None:
    """Raise LinAlgError for LAPACK's code of failure: what it returns with it is no solution."""
    if failed:
        raise np.linalg.LinAlgError("matrix is not positive definite")


class _OneBlasThread(ContextDecorator):
    """A context manager, or decorator, that any number of threads may be in at once.

    The limit is the process's: the first thread that comes in sets it, and the last one that leaves
    restores what was there before.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._libraries: list[Any] | None = None
        self._before: list[tuple[Any, int]] = []

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                if self._libraries is None:
                    # Looking through all loaded libraries takes milliseconds: so only once.
                    libraries = ThreadpoolController().lib_controllers
                    self._libraries = [one for one in libraries if one.user_api == "blas"]
                numbers = ((library, library.num_threads) for library in self._libraries)
                self._before = [(library, number) for library, number in numbers if number != 1]
                _set_threads([(library, 1) for library, _ in self._before])
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                _set_threads(self._before)


def _set_threads(numbers: list[tuple[Any, int]]) -> None:
    for library, number in numbers:
        library.set_num_threads(number)
        # Since 3.8 threadpoolctl lets one thread alone set limits, until that gives the right back.
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread()


one_blas_thread = _OneBlasThread()
