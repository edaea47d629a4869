"""Shapes pooled over the rows of one person, against one big least-squares problem."""

import numpy as np
import pytest

from shapepose_fg.body.fitting.energy import Held
from shapepose_fg.body.fitting.fitter import check_groups
from shapepose_fg.body.fitting.posterior import pooled_betas, shared

BETAS, REST = 10, 6


def linear_rows(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements y = A x + noise of x = (betas, rest): A (count, 30, 16) and y (count, 30)."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, 30, BETAS + REST)) * rng.uniform(0.1, 3, (count, 1, 1))
    return A, rng.normal(size=(count, 30))


def solved_alone(A: np.ndarray, y: np.ndarray, centre: np.ndarray, stiffness: float):
    """Optimum (16,) and half Hessian of |A x - y|² + stiffness |betas - centre|²."""
    H = A.T @ A
    H[:BETAS, :BETAS] += stiffness * np.eye(BETAS)
    right = A.T @ y
    right[:BETAS] += stiffness * centre
    return np.linalg.solve(H, right), H


def solved_jointly(
    A: np.ndarray, y: np.ndarray, centre: np.ndarray, stiffness: float
) -> np.ndarray:
    """The betas (10,) of sum_i |A_i (betas, rest_i) - y_i|² + stiffness |betas - centre|², solved
    as one.
    """
    n = len(A)
    big = np.zeros((n * 30, BETAS + n * REST))
    for row in range(n):
        lines = slice(row * 30, row * 30 + 30)
        big[lines, :BETAS] = A[row, :, :BETAS]
        big[lines, BETAS + row * REST : BETAS + (row + 1) * REST] = A[row, :, BETAS:]
    pull = np.sqrt(stiffness) * np.eye(BETAS, big.shape[1])
    right = np.concatenate((y.ravel(), np.sqrt(stiffness) * centre))
    return np.linalg.lstsq(np.concatenate((big, pull)), right, rcond=None)[0][:BETAS]


def precision_of_betas(hessian: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.linalg.inv(hessian)[:, :BETAS, :BETAS])


def by_priors(rows: int) -> Held:
    return Held(np.zeros((rows, BETAS)), np.ones(rows), np.zeros((rows, 63)))


@pytest.mark.parametrize("own_centres", [False, True])
def test_a_linear_problem_is_pooled_exactly(own_centres):
    groups = np.array([5, -2, 5, 5, 9, -2])
    A, y = linear_rows(6, seed=0)
    centre = np.random.default_rng(1).normal(size=(6, BETAS)) * own_centres
    alone = [solved_alone(A[row], y[row], centre[row], 2.5) for row in range(6)]
    free = np.stack([x for x, _ in alone])
    hessian = np.stack([H for _, H in alone])
    held = Held(centre, np.full(6, 2.5), np.zeros((6, 63)))
    votes = np.ones(6, dtype=bool)
    pooled = pooled_betas(free[:, :BETAS], precision_of_betas(hessian), groups, votes, held)
    for number in (5, -2):
        rows = groups == number
        # What a group was held by counts once: around the mean of where its rows were held.
        expected = solved_jointly(A[rows], y[rows], centre[rows].mean(axis=0), 2.5)
        np.testing.assert_allclose(pooled[rows], np.tile(expected, (rows.sum(), 1)), atol=1e-10)
    np.testing.assert_array_equal(pooled[4], free[4, :BETAS])  # nobody to agree with


def test_shapes_held_by_the_priors_alone_are_pooled_too():
    A, y = linear_rows(3, seed=2)
    alone = [solved_alone(A[row], y[row], np.zeros(BETAS), 1.0) for row in range(3)]
    free, hessian = (np.stack(part) for part in zip(*alone, strict=True))
    pools, votes = np.zeros(3, dtype=int), np.ones(3, bool)
    pooled = pooled_betas(free[:, :BETAS], precision_of_betas(hessian), pools, votes, by_priors(3))
    np.testing.assert_allclose(pooled[0], solved_jointly(A, y, np.zeros(BETAS), 1.0), atol=1e-9)


def test_rows_that_do_not_vote_take_the_others_shape():
    A, y = linear_rows(5, seed=3)
    alone = [solved_alone(A[row], y[row], np.zeros(BETAS), 1.0) for row in range(5)]
    free, hessian = (np.stack(part) for part in zip(*alone, strict=True))
    pools, votes = np.array([0, 0, 0, 1, 1]), np.array([True, True, False, False, False])
    pooled = pooled_betas(free[:, :BETAS], precision_of_betas(hessian), pools, votes, by_priors(5))
    expected = solved_jointly(A[:2], y[:2], np.zeros(BETAS), 1.0)
    np.testing.assert_allclose(pooled[:3], np.tile(expected, (3, 1)), atol=1e-9)
    np.testing.assert_array_equal(pooled[3:], free[3:, :BETAS])  # no vote in their pool
    assert shared(pools, votes).tolist() == [True, True, True, False, False]


@pytest.mark.parametrize(
    "groups", [[0, 1], [[0], [1], [2]], [0.0, 1.0, 2.0], ["a", "b", "c"], [True] * 3]
)
def test_groups_that_are_not_one_number_a_row_are_refused(groups):
    with pytest.raises(ValueError, match="groups must be 3 whole numbers"):
        check_groups(np.array(groups), 3)
