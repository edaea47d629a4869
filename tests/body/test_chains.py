"""Chains of rows: the motion prior along them, and the solver for their linear systems."""

import numpy as np
import pytest

from factors import CONSTANT_ACCELERATION, CONSTANT_VELOCITY, Motion, matrices
from shapepose_fg.body.fitting.chains import MotionChain
from shapepose_fg.body.fitting.priors import NUM_MOVING, MotionPrior
from shapepose_fg.body.kernels.solving import eliminated, put_back
from shapepose_fg.body.model.rotation import exp_so3


def draw(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("bands", [2, 3])
@pytest.mark.parametrize("length", [2, 3, 7])
def test_poses_are_eliminated_from_a_chain(length, bands):
    """Against the whole of the system at once; a few unknowns a row and as many as bodies have."""
    for N in (5, 69):
        A = draw(length, N + 10, N + 10)
        hessian, gradient = (
            A @ A.swapaxes(1, 2) + 2 * N * np.eye(N + 10),
            draw(length, N + 10, seed=1),
        )
        diagonal, pull = np.abs(draw(length, N, seed=2)), draw(length, N, seed=3)
        beyond, turn = 0.2 * draw(length, N, bands, seed=4), exp_so3(draw(length, 3, seed=5))
        M = (bands + 1) * N + 11
        kept, front = np.zeros((length, M, -(-N // 16) * 16)), np.zeros((M, M))
        system = np.concatenate([np.tril(hessian), gradient[:, None]], 1)
        eliminated(system, turn, diagonal, beyond, pull, 0.1, kept, front)
        Q = np.tile(np.eye(N), (length, 1, 1))
        Q[:, :3, :3] = turn  # the root's tangents become the world's
        own = Q @ hessian[:, 10:, 10:] @ Q.swapaxes(1, 2)
        across = (Q @ hessian[:, 10:, :10]).reshape(-1, 10)
        right = ((Q @ gradient[:, 10:, None])[..., 0] + pull).ravel()
        H = np.zeros((length * N, length * N))
        for t in range(length):
            rows = slice(t * N, t * N + N)
            H[rows, rows] = own[t] + np.diag(diagonal[t])
            H[rows, rows] += 0.1 * np.diag(np.diag(H[rows, rows]))
            for s in range(t + 1, min(t + 1 + bands, length)):
                coupling = np.diag(beyond[t, :, s - t - 1])
                H[rows, s * N : s * N + N] = H[s * N : s * N + N, rows] = coupling
        said = hessian[:, :10, :10].sum(0) - across.T @ np.linalg.solve(H, across)
        np.testing.assert_allclose(np.tril(front[-10:, -10:]), np.tril(said), rtol=1e-8, atol=1e-8)
        left = gradient[:, :10].sum(0) - across.T @ np.linalg.solve(H, right)
        np.testing.assert_allclose(front[-10:, -11], left, rtol=1e-8, atol=1e-8)
        shape, step = draw(10, seed=6), np.zeros((length, N))
        put_back(kept, np.append(1.0, shape), step)
        expected = -np.linalg.solve(H, right + across @ shape)
        np.testing.assert_allclose(step.ravel(), expected, rtol=1e-8, atol=1e-10)


class Damped(Motion):
    """Velocities that die away: another model of order 2, whose last derivative does not stay."""

    def transition(self, dt_s):
        h = np.asarray(dt_s)
        return matrices([[1 + 0 * h, 1 - np.exp(-h)], [0 * h, np.exp(-h)]])


LAWS = {
    "constant velocity": CONSTANT_VELOCITY,
    "constant acceleration": CONSTANT_ACCELERATION,
    "damped": Damped(),
}


@pytest.fixture(params=LAWS.values(), ids=LAWS)
def chain(request) -> tuple[MotionChain, np.ndarray, np.ndarray]:
    """Six rows of uneven steps, turning a few degrees a step; the last two are past the end."""
    T, N = 6, 8
    rng = np.random.default_rng(0)
    step = rng.uniform(0.02, 0.1, T - 1)
    step[3:] = np.inf
    motion = MotionChain(request.param, rng.uniform(0.5, 1.5, N), rng.uniform(0.1, 1.1, N), step)
    return motion, exp_so3(0.05 * draw(T, 3).cumsum(0)), 0.3 * draw(T, N - 3, seed=1)


def test_motion_s_gradient_and_couplings_are_those_of_its_energy(chain):
    motion, root, others = chain
    T, N, h = 6, 8, 1e-5

    def at(step: np.ndarray) -> tuple[float, np.ndarray]:
        return motion.at(exp_so3(step[:, :3]) @ root, others + step[:, 3:])

    _, found = at(np.zeros((T, N)))
    numeric, H = np.zeros((T, N)), np.zeros((T, N, T, N))
    for t in range(T):
        for i in range(N):
            nudge = np.zeros((T, N))
            nudge[t, i] = h
            (ahead, slope), (behind, other) = at(nudge), at(-nudge)
            numeric[t, i], H[t, i] = (ahead - behind) / (4 * h), (slope - other) / (2 * h)
    np.testing.assert_allclose(found, numeric, atol=1e-3, rtol=1e-6)
    assert not found[4:].any()  # past the end
    for number in (3, 6):
        ours = np.diag(motion.diagonal[:, number])
        for offset, coupling in enumerate(np.moveaxis(motion.beyond, -1, 0), start=1):
            values = coupling[:-offset, number]
            ours = ours + np.diag(values, offset) + np.diag(values, -offset)
        np.testing.assert_allclose(ours, H[:, number, :, number], atol=1e-4 * np.abs(ours).max())


def test_even_motion_costs_its_speed_alone():
    motion = MotionChain(CONSTANT_VELOCITY, np.full(6, 2.0), np.full(6, 0.5), np.full(9, 0.1))
    time = 0.1 * np.arange(10)[:, None]
    energy, _ = motion.at(exp_so3(time * [0.0, 0.0, 0.7]), time * [0.3, 0.0, 0.0])
    assert energy == pytest.approx(
        (0.7**2 + 0.3**2) / 0.5 * 0.9
    )  # v² h / density, 9 steps of 0.1 s


def test_the_motion_prior_is_about_people():
    prior = MotionPrior.default()
    root = np.sqrt(prior.acceleration)
    knee, spine = root[3 + 3 * 3], root[3 + 3 * 2 : 3 + 3 * 3].max()
    assert knee > 1.5 * spine  # knees are quicker than the spine
    assert "mocap.cs.cmu.edu" in prior.provenance and "60 61" in prior.provenance
    with pytest.raises(ValueError, match=r"acceleration must be \(75,\), got \(3,\)"):
        MotionPrior(np.ones(3), np.ones(NUM_MOVING), "")
    with pytest.raises(ValueError, match="velocity must be positive"):
        MotionPrior(np.ones(NUM_MOVING), np.zeros(NUM_MOVING), "")
