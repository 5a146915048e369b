# SPDX-License-Identifier: Apache-2.0
"""Matrices as small as a skin's, solved fast: LAPACK directly, and one BLAS thread.

The checks of scipy.linalg take as long as LAPACK itself, and more threads are slower than one. Of
symmetric matrices and of factors, only the lower triangle counts, in Fortran's order; above it,
there may be anything.
"""

import threading
from contextlib import ContextDecorator
from typing import Any, Final

import numpy as np
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

from ohmskin.arrays import Float

# Rows of a block of `solve_lower`. Chosen: 32 to 96 are about as fast.
_BLOCK: Final = 64


def gram(rows: Float, onto: Float | None = None) -> Float:
    """rows rows^T. It is added to the matrix `onto`, if there is one, which is overwritten."""
    # C's order is Fortran's of the transpose: nothing is copied.
    turned = not rows.flags.f_contiguous
    beta = 0.0 if onto is None else 1.0
    given = rows.T if turned else rows
    return np.asarray(blas.dsyrk(1.0, given, beta, onto, trans=turned, lower=1, overwrite_c=1))


def cholesky(system: Float) -> Float:
    """L of a positive definite matrix L L^T. A matrix in C's order must be symmetric.

    Rounding may have made the matrix indefinite. Then a share of its largest diagonal element is
    added to its diagonal: 1e-14, or 100 times as much again and again, until this mends it. Raises
    LinAlgError if a millionth does not.
    """
    # In C's order, a matrix is its own transpose in Fortran's order: nothing is copied.
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


def gram_factor(rows: Float, onto: Float) -> Float:
    """L of L L^T = rows rows^T + onto, as of `cholesky`. `onto` is kept."""
    system = gram(rows, onto.copy(order="F"))
    factor, failed = lapack.dpotrf(system, lower=1, clean=0, overwrite_a=1)
    return cholesky(gram(rows, onto.copy(order="F"))) if failed else np.asarray(factor)


def solve(factor: Float, right: Float) -> Float:
    """x of L L^T x = right, for one or several columns."""
    solution, failed = lapack.dpotrs(factor, right, lower=1)
    _check(failed)
    return np.asarray(solution)


def solve_positive(system: Float, right: Float) -> Float:
    """x of system x = right. It is faster than `cholesky` and `solve`, where L is not needed again.

    A system that rounding has made indefinite is mended as in `cholesky`, with the same error.
    """
    if not len(system):  # LAPACK takes no empty system
        return np.zeros_like(right)
    _, solution, failed = lapack.dposv(system, right, lower=1)
    return solve(cholesky(system), right) if failed else np.asarray(solution)


def inverse(factor: Float) -> Float:
    """(L L^T)^-1, both triangles."""
    lower, failed = lapack.dpotri(factor, lower=1)
    _check(failed)
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def solve_lower(factor: Float, right: Float, *, transposed: bool = False) -> Float:
    """x of L x = right, or of L^T x = right, for one or several columns."""
    if right.ndim == 1 or right.flags.f_contiguous:
        solution, failed = lapack.dtrtrs(factor, right, lower=1, trans=int(transposed))
        _check(failed)
        return np.asarray(solution)
    # In C's order, x^T of x^T L^T = right^T is in Fortran's: nothing is turned around, which saves
    # a third of the time.
    side = {"side": 1, "lower": 1, "trans_a": int(not transposed)}
    if len(factor) <= _BLOCK:
        return np.asarray(blas.dtrsm(1.0, factor, right.T, **side).T)
    # In blocks of rows, most of the work is products, which are twice as fast.
    solution = np.array(right, np.float64, order="C")
    blocks = [slice(first, first + _BLOCK) for first in range(0, len(factor), _BLOCK)]
    for block in reversed(blocks) if transposed else blocks:
        if transposed:
            solution[block] -= factor[block.stop :, block].T @ solution[block.stop :]
        else:
            solution[block] -= factor[block, : block.start] @ solution[: block.start]
        blas.dtrsm(1.0, factor[block, block], solution[block].T, overwrite_b=1, **side)
    return solution


def _check(failed: int) -> None:
    """Raise LinAlgError if LAPACK's code says that it failed: then it has returned no solution."""
    if failed:
        raise np.linalg.LinAlgError("matrix is not positive definite")


class _OneBlasThread(ContextDecorator):
    """Limits BLAS to one thread: a context manager or decorator.

    Any number of threads may be inside at once. The limit is that of the process: the first thread
    that enters sets it, and the last one that leaves restores what was there before.
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
                    # Only once, because looking through all loaded libraries takes milliseconds.
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
        # Since version 3.8, threadpoolctl lets only one thread set limits until this thread gives
        # the right back.
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread()


one_blas_thread = _OneBlasThread()
