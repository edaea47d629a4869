"""The energy held around a shape and a pose, and bodies that are evaluated once."""

import numpy as np
import pytest
import torch

from shapepose_fg.body.fitting.energy import SETTLED, BodyEnergy, Held, WhitenedTargets
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel

ROWS = 3
SCALE = torch.full((ROWS, 1), 6.0, dtype=torch.float64)


@pytest.fixture(scope="module")
def energy() -> BodyEnergy:
    return BodyEnergy(BodyModel.default().to(torch.float64), PosePrior.default())


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


@pytest.fixture(scope="module")
def targets() -> WhitenedTargets:
    return WhitenedTargets(0.4 * draw(ROWS, 25, 3, seed=1), 20 * torch.eye(3).double().expand(ROWS, 25, 3, 3))


@pytest.fixture(scope="module")
def free(energy) -> torch.Tensor:
    return 0.3 * draw(ROWS, energy.num_free)


@pytest.fixture(scope="module")
def held(energy) -> Held:
    return Held(draw(ROWS, 10, seed=2), draw(ROWS, 1, seed=3).exp(), 0.2 * draw(ROWS, energy.num_angles, seed=4))


def test_the_gradient_is_that_of_the_energy(energy, targets, free, held):
    here, step = energy.linearise(free, targets, SCALE, held), 1e-5
    for column in range(energy.num_free):
        nudge = torch.zeros(ROWS, energy.num_free, dtype=torch.float64)
        nudge[:, column] = step
        ahead, behind = (
            energy.linearise(energy.retract(free, sign * nudge), targets, SCALE, held).energy(SCALE)
            for sign in (1, -1)
        )
        # Half the gradient; central differences of energies about 1e4: rounding 1e-12 / 1e-5.
        numeric = (ahead - behind) / (4 * step)
        np.testing.assert_allclose(here.gradient[:, column].numpy(), numeric.numpy(), atol=1e-4, rtol=1e-5)


def test_priors_alone_are_what_holds_when_nothing_else_does(energy, targets, free):
    plain, priors = (
        energy.linearise(free, targets, SCALE),
        energy.linearise(free, targets, SCALE, Held.by_priors()),
    )
    for name, value in vars(plain).items():
        np.testing.assert_array_equal(value.numpy(), getattr(priors, name).numpy())


def test_where_it_is_held_it_is_not_pulled(energy, free):
    held = Held(free[:, :10], torch.full((ROWS, 1), 5.0, dtype=torch.float64), free[:, 13:-3])
    nothing = WhitenedTargets(torch.zeros(ROWS, 25, 3).double(), torch.zeros(ROWS, 25, 3, 3).double())
    here = energy.linearise(free, nothing, SCALE, held)
    assert not here.gradient.any() and not here.prior.any()
    # As tightly as the priors: the stiffness on betas, positive definite on angles, nothing on where it stands.
    np.testing.assert_allclose(here.hessian[:, :10, :10].numpy(), np.tile(5 * np.eye(10), (ROWS, 1, 1)))
    assert torch.linalg.eigvalsh(here.hessian[:, 13:-3, 13:-3]).min() > 0
    assert not here.hessian[:, -3:].any() and not here.hessian[:, 10:13].any()


def test_settled_shapes_stay_and_poses_go_on(energy, targets, free, held):
    betas = draw(ROWS, 10, seed=5)
    settled = held.at_shape(betas, torch.ones(len(betas), dtype=torch.bool))
    assert settled.angles is held.angles
    start = torch.cat((betas, free[:, 10:]), 1)
    here = energy.linearise(start, targets, SCALE, settled)
    step = -torch.linalg.solve(here.hessian, here.gradient)
    assert float(step[:, :10].abs().max()) < 1e-3 < float(step[:, 10:].abs().max())
    np.testing.assert_array_equal(settled.stiffness.numpy(), np.full((ROWS, 1), SETTLED))


def test_a_step_moves_rows_and_keeps_their_linearisation(energy, targets, free, held):
    body = energy.evaluate(free, targets, SCALE, held)
    here = energy.linearise(free, targets, SCALE, held)
    np.testing.assert_array_equal(body.here.hessian.numpy(), here.hessian.numpy())
    np.testing.assert_array_equal(body.here.xyz.numpy(), energy.keypoints_with_jacobian(free)[0].numpy())
    factor = body.factor.numpy()
    added = factor @ factor.swapaxes(1, 2) - here.hessian.numpy()
    root = np.isin(np.arange(energy.num_free), [10, 11, 12, *range(energy.num_free - 3, energy.num_free)])
    np.testing.assert_allclose(added, np.tile(np.diag(root.astype(float)), (ROWS, 1, 1)), atol=1e-8)
    there = energy.retract(free, body.step)
    slope = energy.slope(there, targets, SCALE, held)
    where = torch.tensor([False, True, False])
    moved = body.moved(where, there, slope)
    other = energy.linearise(there, targets, SCALE, held)
    for name, one, two in (("gradient", here.gradient, other.gradient), ("squared", here.squared, other.squared),
                           ("prior", here.prior, other.prior)):  # fmt: skip
        value = getattr(moved.here, name).numpy()
        np.testing.assert_allclose(value, np.stack([one[0], two[1], one[2]]), atol=1e-8, rtol=1e-9)
    np.testing.assert_array_equal(moved.here.hessian.numpy(), here.hessian.numpy())
    # What the Newton step would gain, worked out the long way.
    g, H = here.gradient.numpy(), factor @ factor.swapaxes(1, 2)
    gain = np.einsum("bi,bi->b", g, np.linalg.solve(H, g[..., None])[..., 0])
    np.testing.assert_allclose(body.left.numpy(), gain, rtol=1e-8)
    rows = torch.tensor([2, 0])
    alone = energy.linearise(free[rows], targets[rows], SCALE[rows], held[rows])
    np.testing.assert_allclose(alone.gradient.numpy(), here.gradient[rows].numpy(), atol=1e-8)
