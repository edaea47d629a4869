"""Chains of rows: the motion prior along them, the solver for their linear systems, and how they are cut."""

import numpy as np
import pytest
import torch

from shapepose_fg.body.fitting.chains import Motion, cut_segments, solve_banded
from shapepose_fg.body.fitting.priors import NUM_MOVING, MotionPrior
from shapepose_fg.body.model.rotation import exp_so3


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


@pytest.mark.parametrize("length", [2, 3, 7])
def test_a_banded_system_is_solved(length):
    G, N, K = 3, 5, 2
    A = draw(length, G, N, N)
    diagonal = A @ A.mT + 4 * torch.eye(N)
    one, two, right = (
        0.5 * draw(length, G, N, seed=1),
        0.3 * draw(length, G, N, seed=2),
        draw(length, G, N, K, seed=3),
    )
    found = solve_banded(diagonal.clone(), one, two, right.clone())
    for chain in range(G):
        H = torch.zeros(length * N, length * N, dtype=torch.float64)
        for t in range(length):
            rows = slice(t * N, t * N + N)
            H[rows, rows] = diagonal[t, chain]
            for s, coupling in ((t + 1, one), (t + 2, two)):
                if s < length:
                    H[rows, s * N : s * N + N] = torch.diag(coupling[t, chain])
                    H[s * N : s * N + N, rows] = torch.diag(coupling[t, chain])
        expected = torch.linalg.solve(H, right[:, chain].flatten(0, 1)).unflatten(0, (length, N))
        torch.testing.assert_close(found[:, chain], expected)


@pytest.fixture
def chain() -> tuple[Motion, torch.Tensor, torch.Tensor]:
    """Two chains of uneven steps, the second one two rows shorter, turning a few degrees a step."""
    T, N = 6, 8
    rng = np.random.default_rng(0)
    step = torch.from_numpy(rng.uniform(0.02, 0.1, (T - 1, 2)))
    step[3:, 1] = torch.inf
    motion = Motion(rng.uniform(0.5, 1.5, N), rng.uniform(0.1, 1.1, N), step)
    root = exp_so3(0.05 * draw(T, 2, 3).cumsum(0))
    return motion, root, 0.3 * draw(T, 2, N - 3, seed=1)


def test_motion_s_gradient_and_couplings_are_those_of_its_energy(chain):
    motion, root, others = chain
    _, found = motion.at(root, others)

    def energy(step: torch.Tensor) -> torch.Tensor:
        return motion.at(exp_so3(step[..., :3]) @ root, others + step[..., 3:])[0].sum()

    still = torch.zeros(6, 2, 8, dtype=torch.float64, requires_grad=True)
    gradient = torch.autograd.grad(energy(still), still)[0] / 2
    torch.testing.assert_close(found, gradient, atol=1e-9, rtol=1e-9)
    assert not found[4:, 1].any()  # past the end
    H = torch.autograd.functional.hessian(energy, still.detach()) / 2
    for chain_, number in ((0, 3), (1, 6)):
        whole = H[:, chain_, number][:, :, chain_, number]
        ours = torch.diag(motion.diagonal[:, chain_, number])
        for offset, coupling in ((1, motion.next_one), (2, motion.next_two)):
            values = coupling[:-offset, chain_, number]
            ours = ours + torch.diag(values, offset) + torch.diag(values, -offset)
        torch.testing.assert_close(ours, whole, atol=1e-8, rtol=1e-9)


def test_even_motion_costs_its_speed_alone():
    step = torch.full((9, 1), 0.1, dtype=torch.float64)
    motion = Motion(np.full(6, 2.0), np.full(6, 0.5), step)
    time = 0.1 * torch.arange(10, dtype=torch.float64)[:, None, None]
    root = exp_so3(time * torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64))
    energy, _ = motion.at(root, time * torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64))
    assert float(energy) == pytest.approx((0.7**2 + 0.3**2) / 0.5 * 0.9)  # v² h / density, 9 steps of 0.1 s


def test_chains_end_at_gaps_and_long_ones_are_cut_with_overlap():
    time_s = np.concatenate([np.arange(10) * 0.1, 5 + np.arange(3) * 0.1, [0.0, 0.1]])
    group = np.repeat([4, 4, 7], [10, 3, 2])
    rows = np.random.default_rng(0).permutation(15)
    segments = cut_segments(rows, group, time_s, gap_s=1.0, length=6, overlap=2)
    assert [(s.rows.tolist(), s.kept.tolist(), s.group) for s in segments] == [
        (list(range(8)), [True] * 6 + [False] * 2, 4),
        (list(range(4, 10)), [False] * 2 + [True] * 4, 4),
        ([10, 11, 12], [True] * 3, 4),
        ([13, 14], [True] * 2, 7),
    ]
    assert cut_segments(rows[:0], group, time_s, gap_s=1.0, length=6, overlap=2) == []
    time_s[11] = time_s[10]
    with pytest.raises(ValueError, match=r"group 4 has two rows at 5\.0 s: give one row a time"):
        cut_segments(rows, group, time_s, gap_s=1.0, length=6, overlap=2)


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
