import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.assignment import least_cost_pairs


@pytest.mark.parametrize("ties", [False, True])
def test_pairs_cost_as_little_as_scipy_s(ties):
    rng = np.random.default_rng(0)
    for _ in range(200):
        shape = rng.integers(0, 9, 2)
        cost = rng.integers(-2, 3, shape).astype(float) if ties else rng.normal(size=shape)
        rows, columns = least_cost_pairs(cost)
        theirs = linear_sum_assignment(cost)
        assert len(rows) == len(columns) == min(shape)
        assert (np.diff(rows) > 0).all()
        assert len(set(columns.tolist())) == len(columns)
        # Sums of eight numbers of about 1, in any order.
        assert cost[rows, columns].sum() == pytest.approx(cost[theirs].sum(), abs=1e-12)
        if not ties:  # then it is the only one
            assert np.array_equal(rows, theirs[0])
            assert np.array_equal(columns, theirs[1])


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_costs_that_are_no_numbers_are_refused(wrong):
    with pytest.raises(ValueError, match="costs must be finite"):
        least_cost_pairs(np.array([[1.0, wrong], [0.0, 2.0]]))
