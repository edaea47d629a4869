"""Models of motion: against numeric integration, and honest on motion that follows them."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.linalg import expm

from factors import (
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    MOTIONS,
    Motion,
    assert_zero_at_truth,
    state_keys,
)
from factors.motion import matrices

TIMES = np.array([0.0, 0.04, 0.08, 0.2, 0.24, 0.9, 0.94, 1.0])
T = len(TIMES)
TAU_S = 0.4


class Damped(Motion):
    """Velocities that die away: v' = -v / tau + white noise."""

    def transition(self, dt_s):
        left = np.exp(-np.asarray(dt_s) / TAU_S)
        return matrices([[1 + 0 * left, TAU_S * (1 - left)], [0 * left, left]])

    def noise(self, dt_s, density=1.0):
        h, q = np.asarray(dt_s), TAU_S * np.asarray(density)
        gone, twice = TAU_S * (1 - np.exp(-h / TAU_S)), TAU_S * (1 - np.exp(-2 * h / TAU_S)) / 2
        return matrices(
            [
                [TAU_S * q * (h - 2 * gone + twice), q * (gone - twice)],
                [q * (gone - twice), q * twice / TAU_S],
            ]
        )


LAWS = {
    "constant velocity": CONSTANT_VELOCITY,
    "constant acceleration": CONSTANT_ACCELERATION,
    "damped": Damped(),
}
RATES = {
    "constant velocity": [[0, 1], [0, 0]],
    "constant acceleration": [[0, 1, 0], [0, 0, 1], [0, 0, 0]],
    "damped": [[0, 1], [0, -1 / TAU_S]],
}
"""The same as differential equations, ds = A s dt + noise on the last."""


@pytest.fixture(params=LAWS)
def name(request) -> str:
    return request.param


def keys_of(law: Motion):
    return state_keys(2, 4, np.arange(T), law.order)


@pytest.mark.parametrize("h", [0.02, 0.3])
def test_transition_and_noise_are_the_integrals_of_the_differential_equation(name, h):
    A, law = np.array(RATES[name], dtype=float), LAWS[name]
    L = np.eye(law.order)[-1:].T
    np.testing.assert_allclose(law.transition(h), expm(h * A), rtol=1e-12, atol=1e-14)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    steps = [expm(h * (1 + node) / 2 * A) @ L for node in nodes]
    expected = (
        h / 2 * sum(weight * step @ step.T for weight, step in zip(weights, steps, strict=True))
    )
    np.testing.assert_allclose(law.noise(h, 3.0), 3.0 * expected, rtol=1e-9, atol=1e-18)
    two = law.noise([h, 2 * h], [3.0, 1.0])
    np.testing.assert_allclose(two, [law.noise(h, 3.0), law.noise(2 * h)], rtol=1e-12)


def test_two_steps_are_one(name):
    """And a step back is the motion the other way round."""
    law, (a, b) = LAWS[name], (0.05, 0.2)
    F, Q = law.transition(b), law.noise(b)
    np.testing.assert_allclose(F @ law.transition(a), law.transition(a + b), atol=1e-12)
    np.testing.assert_allclose(F @ law.noise(a) @ F.T + Q, law.noise(a + b), atol=1e-12)
    turned = np.diag([1.0, -1.0, 1.0][: law.order])
    for back, there in zip(law.step(-b, 2.0), law.step(b, 2.0), strict=True):
        np.testing.assert_allclose(back, turned @ there @ turned)


def test_factors_are_the_gaussian_of_the_step(name):
    """Zero where the motion goes on by itself; elsewhere r' (q Q)^-1 r / 2, and its derivatives are
    constant.
    """
    law, keys = LAWS[name], keys_of(LAWS[name])
    rng, q = np.random.default_rng(0), np.linspace(1, 4, T - 1)
    straight, any_states = [rng.normal(size=(law.order, 3))], rng.normal(size=(T, law.order, 3))
    for before, after in pairwise(TIMES):
        straight.append(law.transition(after - before) @ straight[-1])
    for states in (np.array(straight), any_states):
        values = gtsam.Values()
        for key, point in zip(keys.ravel().tolist(), states.reshape(-1, 3), strict=True):
            values.insert(key, point)
        for i, factor in enumerate(law.factors(keys, TIMES, q)):
            dt = TIMES[i + 1] - TIMES[i]
            away = states[i + 1] - law.transition(dt) @ states[i]
            expected = 0.5 * np.sum(away * np.linalg.solve(law.noise(dt, q[i]), away))
            assert factor.error(values) == pytest.approx(expected, rel=1e-8, abs=1e-12)
            if states is not any_states and name == "constant velocity":
                assert_zero_at_truth(factor, values)
            A, b = factor.linearize(values).jacobian()
            assert 0.5 * b @ b == pytest.approx(expected, rel=1e-8, abs=1e-12)
            root = np.linalg.solve(
                law.noise(dt, q[i]), np.hstack([-law.transition(dt), np.eye(law.order)])
            )
            J = np.hstack([-law.transition(dt), np.eye(law.order)])
            order = [list(factor.keys()).index(key) for key in keys[i : i + 2].ravel().tolist()]
            blocks = (A.T @ A).reshape(2 * law.order, 3, 2 * law.order, 3)[order][:, :, order]
            np.testing.assert_allclose(
                blocks[:, 0, :, 0], J.T @ root, rtol=1e-6, atol=1e-6 * np.abs(blocks).max()
            )


@pytest.mark.slow
def test_covariances_hold_on_motion_that_follows_the_model(name):
    """200 walks drawn from the model, seen with 1 cm of noise: 95 % of truths inside, derivatives
    too.
    """
    law, keys, rng, q, sigma = LAWS[name], keys_of(LAWS[name]), np.random.default_rng(1), 2.0, 0.01
    start = np.array([1.0, *law.start])
    graph = gtsam.NonlinearFactorGraph()
    for factor in law.factors(keys, TIMES, q):
        graph.push_back(factor)
    for key, wide in zip(keys[0].tolist(), start, strict=True):
        graph.push_back(
            gtsam.PriorFactorPoint3(key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, wide))
        )
    squared = []
    for _ in range(200):
        states = [start[:, None] * rng.normal(size=(law.order, 3))]
        for before, after in pairwise(TIMES):
            root = np.linalg.cholesky(law.noise(after - before, q))
            states.append(
                law.transition(after - before) @ states[-1] + root @ rng.normal(size=(law.order, 3))
            )
        seen, values = gtsam.NonlinearFactorGraph(graph), gtsam.Values()
        for key, state in zip(keys[:, 0].tolist(), states, strict=True):
            noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            seen.push_back(
                gtsam.PriorFactorPoint3(key, state[0] + sigma * rng.normal(size=3), noise)
            )
        for key in keys.ravel().tolist():
            values.insert(key, np.zeros(3))
        found = gtsam.LevenbergMarquardtOptimizer(seen, values).optimize()
        marginals = gtsam.Marginals(seen, found)
        for i, state in enumerate(states):
            for key, true in zip(keys[i].tolist(), state, strict=True):
                away = found.atPoint3(key) - true
                squared.append(away @ np.linalg.solve(marginals.marginalCovariance(key), away))
    inside = np.array(squared).reshape(200, T, law.order) < 7.815
    np.testing.assert_allclose(inside.mean(axis=(0, 1)), 0.95, atol=0.02)


def test_what_is_no_model_or_no_states_is_refused():
    with pytest.raises(ValueError, match="order must be one of"):
        Motion(4, (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="order must be one of"):
        Motion(3)
    with pytest.raises(ValueError, match=r"keys must be \(T, 3\)"):
        CONSTANT_ACCELERATION.factors(keys_of(CONSTANT_VELOCITY), TIMES, 1.0)
    assert set(MOTIONS) == {"constant velocity", "constant acceleration"}
