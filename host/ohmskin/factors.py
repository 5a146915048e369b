# SPDX-License-Identifier: Apache-2.0
"""Cholesky factors, by LAPACK directly: for matrices as small as a skin's, what scipy.linalg checks
before it calls LAPACK takes as long again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Float = NDArray[np.float64]


def cholesky(system: Float) -> Float:
    """L of a symmetric positive definite matrix L L^T, lower; `system` is overwritten.

    Raises LinAlgError if it is not positive definite, as where it holds NaN.
    """
    # A C-ordered matrix is its transpose in Fortran's order, and this one is its own transpose.
    factor, failed = lapack.dpotrf(system.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    return np.asarray(factor)


def solve(factor: Float, right: Float) -> Float:
    """x of L L^T x = right, for one or several columns."""
    solution, _ = lapack.dpotrs(factor, right, lower=1)
    return np.asarray(solution)


def solve_lower(factor: Float, right: Float, *, transposed: bool = False) -> Float:
    """x of L x = right, or of L^T x = right."""
    solution, _ = lapack.dtrtrs(factor, right, lower=1, trans=int(transposed))
    return np.asarray(solution)
