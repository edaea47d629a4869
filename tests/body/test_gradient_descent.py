import numpy as np
import pytest
import torch

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.energy import BodyEnergy, Held, WhitenedTargets
from shapepose_fg.body.fitting.fitter import FitStatus, JointTargets
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.evaluation.gradient_descent import GradientDescentConfig, GradientDescentFitter


@pytest.fixture(scope="module")
def targets() -> JointTargets:
    rng = np.random.default_rng(0)
    betas, orient, transl = rng.normal(size=(24, 10)), rng.normal(size=(24, 3)), rng.uniform(-2, 2, (24, 3))
    parts = (betas, orient, PosePrior.default().sample(rng, 24), transl)
    xyz = BodyModel.default().to(torch.float64).keypoints(BodyParameters(*map(torch.from_numpy, parts))).numpy()
    return JointTargets(xyz, np.broadcast_to(np.eye(3) / 0.01**2, (24, 25, 3, 3)).copy())


def test_the_gradient_alone_is_that_of_the_linearisation(tiny_model):
    """With pose blend shapes and without; each keypoint of this body rides on all bones."""
    energy = BodyEnergy(tiny_model, PosePrior.default())
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    free, root = 0.3 * draw(6, energy.num_free), draw(6, 25, 3, 3)
    seen, scale = WhitenedTargets(draw(6, 25, 3), root @ root.mT), torch.full((6, 1), 3.0, dtype=torch.float64)
    settled = Held(draw(6, 10), draw(6, 1).exp(), draw(6, energy.num_angles))
    for held in (None, settled):
        expected = energy.linearise(free, seen, scale, held).gradient
        torch.testing.assert_close(energy.slope(free, seen, scale, held).gradient, expected, atol=1e-9, rtol=1e-9)


def test_steps_lead_to_the_optimum(targets):
    optimum = LevenbergMarquardtFitter().fit(targets)
    apart = {}
    for steps in (10, 100):
        fit = GradientDescentFitter(config=GradientDescentConfig(max_iterations=steps)).fit(targets)
        assert fit.ok.all()
        apart[steps] = np.linalg.norm(fit.joints - optimum.joints, axis=-1).mean()
    assert apart[100] < 0.004  # millimetres: flat directions are left, in which the energy hardly changes
    assert apart[100] < apart[10] / 5


def test_targets_are_judged_as_for_every_fitter(targets):
    information = targets.information.copy()
    information[0] = 0
    information[1, 3] = np.nan
    fit = GradientDescentFitter(config=GradientDescentConfig(max_iterations=2)).fit(
        JointTargets(targets.xyz, information)
    )
    assert fit.status[:3].tolist() == [FitStatus.TOO_FEW_JOINTS, FitStatus.INVALID_TARGETS, FitStatus.OK]
    assert np.isfinite(fit.body_pose).all()


def test_rows_of_one_person_share_a_shape(targets):
    fit = GradientDescentFitter().fit(targets, groups=np.repeat(np.arange(12), 2))
    assert fit.ok.all()
    np.testing.assert_allclose(fit.betas[::2], fit.betas[1::2], atol=0.01)  # next to immovable
    assert np.ptp(fit.betas[:, 0]) > 0.5
