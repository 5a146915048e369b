# SPDX-License-Identifier: Apache-2.0
"""Cholesky factors, by LAPACK directly: for matrices as small as a skin's, what scipy.linalg checks
before it calls LAPACK takes as long again.

Symmetric matrices and factors are lower triangles, in Fortran's order; what is above is anything.
"""

import numpy as np
from scipy.linalg import blas, lapack

from ohmskin.arrays import Float


def gram(rows: Float, scale: float = 1.0, onto: Float | None = None) -> Float:
    """scale * rows rows^T, added onto a matrix that is overwritten, if there is one."""
    turned = rows.T  # C's order is Fortran's of the transpose: nothing is copied
    beta = 0.0 if onto is None else 1.0
    return np.asarray(blas.dsyrk(scale, turned, beta, onto, trans=1, lower=1, overwrite_c=1))


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
