# SPDX-License-Identifier: Apache-2.0
"""Factors against numpy, and matrices that rounding has made indefinite."""

import numpy as np
import pytest

from ohmskin.circuit.small import (
    cholesky,
    gram,
    gram_factor,
    inverse,
    solve,
    solve_lower,
    solve_positive,
)


@pytest.mark.parametrize("order", ["C", "F"])
def test_factors_solve_what_numpy_solves(order: str) -> None:
    random = np.random.default_rng(1)
    rows = random.normal(size=(5, 9))
    right = random.normal(size=(5, 3))
    system = np.array(rows @ rows.T, order=order)
    kept = system.copy()
    factor = cholesky(system)
    np.testing.assert_array_equal(system, kept)
    for solution in (solve(factor, right), solve_positive(system, right)):
        np.testing.assert_allclose(solution, np.linalg.solve(kept, right))
    np.testing.assert_allclose(inverse(factor), np.linalg.inv(kept))
    lower = np.linalg.cholesky(kept)
    np.testing.assert_allclose(solve_lower(factor, right), np.linalg.solve(lower, right))
    transposed = solve_lower(factor, right, transposed=True)
    np.testing.assert_allclose(transposed, np.linalg.solve(lower.T, right))


@pytest.mark.parametrize("transposed", [False, True])
def test_a_factor_of_several_blocks_solves_what_numpy_solves(transposed: bool) -> None:
    random = np.random.default_rng(3)
    rows, right = random.normal(size=(150, 160)), random.normal(size=(150, 7))
    kept, lower = right.copy(), np.linalg.cholesky(rows @ rows.T)
    factor = cholesky(gram(rows))
    expected = np.linalg.solve(lower.T if transposed else lower, right)
    solution = solve_lower(factor, right, transposed=transposed)
    np.testing.assert_allclose(solution, expected, rtol=1e-6)
    wider = np.hstack([right, right])[:, :7]  # not in one piece
    np.testing.assert_array_equal(solve_lower(factor, wider, transposed=transposed), solution)
    np.testing.assert_array_equal(right, kept)


def test_gram_adds_lower_triangles() -> None:
    random = np.random.default_rng(2)
    one, two = random.normal(size=(4, 6)), random.normal(size=(4, 3))
    both = gram(two, gram(one))
    np.testing.assert_allclose(np.tril(both), np.tril(one @ one.T + two @ two.T))
    turned = gram(np.asfortranarray(one))
    np.testing.assert_allclose(np.tril(turned), np.tril(one @ one.T))


def test_the_factor_of_a_sum_keeps_what_was_added() -> None:
    random = np.random.default_rng(4)
    rows, onto = random.normal(size=(5, 3)), np.asfortranarray(np.diag(np.arange(1.0, 6.0)))
    kept = onto.copy()
    factor = np.tril(gram_factor(rows, onto))
    np.testing.assert_allclose(factor @ factor.T, rows @ rows.T + kept)
    np.testing.assert_array_equal(onto, kept)
    rounded = gram_factor(np.array([[1e10], [2e10], [3e10]]), np.eye(3, order="F") * 1e-3)
    assert np.isfinite(np.tril(rounded)).all()  # indefinite by rounding, and mended


def test_a_matrix_that_rounding_made_indefinite_is_mended() -> None:
    row = np.array([[1e10, 2e10, 3e10]])
    system = row.T @ row + np.eye(3)
    system[1, 1] -= 1e5
    factor = np.tril(cholesky(system))
    np.testing.assert_allclose(factor @ factor.T, system, rtol=1e-6)
    right = system @ [1.0, 2.0, 3.0]
    np.testing.assert_allclose(system @ solve_positive(system, right), right, rtol=1e-6)


def test_an_indefinite_matrix_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(-np.eye(2))
    with pytest.raises(np.linalg.LinAlgError):
        solve_positive(-np.eye(2), np.ones(2))


def test_a_factor_with_a_zero_on_its_diagonal_is_refused() -> None:
    """LAPACK leaves the right side as it is, and says so by a code."""
    factor = np.diag([1.0, 0.0])
    with pytest.raises(np.linalg.LinAlgError):
        solve_lower(factor, np.ones(2))
    with pytest.raises(np.linalg.LinAlgError):
        inverse(factor)
