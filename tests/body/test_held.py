"""The energy held around a shape and a pose, and bodies that are evaluated once."""

import numpy as np
import pytest

from shapepose_fg.body.fitting.energy import SETTLED, BodyEnergy, EnergyTargets, Held
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.kernels.solving import LIMB_M
from shapepose_fg.body.model.body_model import BodyModel

ROWS = 3
SCALE = 6.0


@pytest.fixture(scope="module")
def energy() -> BodyEnergy:
    return BodyEnergy(BodyModel.default(), PosePrior.default())


def draw(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.fixture(scope="module")
def targets() -> EnergyTargets:
    return EnergyTargets(
        0.4 * draw(ROWS, 25, 3, seed=1), np.tile(400 * np.eye(3), (ROWS, 25, 1, 1))
    )


@pytest.fixture(scope="module")
def free(energy) -> np.ndarray:
    return 0.3 * draw(ROWS, energy.num_free)


@pytest.fixture(scope="module")
def held(energy) -> Held:
    return Held(
        draw(ROWS, 10, seed=2),
        np.exp(draw(ROWS, seed=3)),
        0.2 * draw(ROWS, energy.num_angles, seed=4),
    )


def test_the_gradient_is_that_of_the_energy(energy, targets, free, held):
    here, step = energy.linearise(free, targets, SCALE, held), 1e-5
    for column in range(energy.num_free):
        nudge = np.zeros((ROWS, energy.num_free))
        nudge[:, column] = step
        ahead, behind = (
            energy.linearise(energy.retract(free, sign * nudge), targets, SCALE, held).energy
            for sign in (1, -1)
        )
        # Half the gradient; central differences of energies about 1e4: rounding 1e-12 / 1e-5.
        numeric = (ahead - behind) / (4 * step)
        np.testing.assert_allclose(here.gradient[:, column], numeric, atol=1e-4, rtol=1e-5)


def test_where_it_is_held_it_is_not_pulled(energy, free):
    held = Held(free[:, :10], np.full(ROWS, 5.0), free[:, 13:-3])
    nothing = EnergyTargets(np.zeros((ROWS, 25, 3)), np.zeros((ROWS, 25, 3, 3)))
    here = energy.linearise(free, nothing, SCALE, held)
    assert not here.gradient.any() and not here.energy.any()
    # As tightly as the priors: the stiffness on betas, positive definite on angles, nothing on
    # where it stands.
    hessian = here.hessian
    np.testing.assert_allclose(hessian[:, :10, :10], np.tile(5 * np.eye(10), (ROWS, 1, 1)))
    assert np.linalg.eigvalsh(hessian[:, 13:-3, 13:-3]).min() > 0
    assert not hessian[:, -3:].any() and not hessian[:, 10:13].any()


def test_settled_shapes_stay_and_poses_go_on(energy, targets, free, held):
    betas = draw(ROWS, 10, seed=5)
    settled = Held(betas, np.full(ROWS, SETTLED), held.angles)
    start = np.concatenate((betas, free[:, 10:]), 1)
    here = energy.linearise(start, targets, SCALE, settled)
    step = -np.linalg.solve(here.hessian, here.gradient[..., None])[..., 0]
    assert np.abs(step[:, :10]).max() < 1e-3 < np.abs(step[:, 10:]).max()


def test_a_step_moves_rows_and_keeps_their_linearisation(energy, targets, free, held):
    body, here = (
        energy.evaluate(free, targets, SCALE, held),
        energy.linearise(free, targets, SCALE, held),
    )
    P, root = energy.num_free, np.isin(np.arange(energy.num_free), [10, 11, 12, *range(76, 79)])
    factor = np.tril(body.system[:, :P])
    H = factor @ factor.swapaxes(1, 2)
    np.testing.assert_allclose(H, here.hessian + np.diag(root.astype(float)), atol=1e-8)
    there = energy.retract(free, body.step)
    slope = energy.linearise(there, targets, SCALE, held, slope_only=True)
    body.move(np.array([False, True, False]), there, slope)
    for name in ("gradient", "squared", "energy", "xyz"):
        one, two = getattr(here, name), getattr(slope, name)
        np.testing.assert_allclose(
            getattr(body, name), [one[0], two[1], one[2]], atol=1e-8, rtol=1e-9
        )
    # What the Newton step would gain, worked out the long way.
    gain = np.einsum(
        "bi,bi->b", body.gradient, np.linalg.solve(H, body.gradient[..., None])[..., 0]
    )
    np.testing.assert_allclose(body.left, gain, rtol=1e-8)
    rows = np.array([2, 0])
    alone = energy.linearise(free[rows], targets.rows(rows), SCALE, held.rows(rows))
    np.testing.assert_array_equal(alone.gradient, here.gradient[rows])


def test_covariances_are_the_inverse_hessian_s_and_the_sag_of_a_limb(energy, targets, free, held):
    body, here = (
        energy.evaluate(free, targets, SCALE, held),
        energy.linearise(free, targets, SCALE, held),
    )
    root = np.isin(np.arange(energy.num_free), [10, 11, 12, *range(76, 79)]).astype(float)
    inverse = np.linalg.inv(here.hessian + np.diag(root))
    J = here.jacobian.reshape(ROWS, 25, 3, -1)
    C = np.einsum("bkxp,bpq,bkyq->bkxy", J, inverse, J)
    sag = np.trace(C, axis1=-2, axis2=-1) / (2 * LIMB_M)
    covariance, shape = body.covariances()
    np.testing.assert_allclose(
        covariance, C + sag[..., None, None] ** 2 * np.eye(3), atol=1e-12, rtol=1e-9
    )
    np.testing.assert_allclose(shape, inverse[:, :10, :10], atol=1e-12, rtol=1e-9)
