"""The motion model's numbers come out as they were put in, for motion and errors that are drawn from the model."""

import numpy as np
import pytest

from factors import motion_covariance
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.simulation.training.motion_statistics import _lasting, densities

FPS = 30.0


def test_densities_of_white_acceleration_are_its_own():
    """Slow wandering with q = 0.02 m²/s³, of no joint faster than another: 3 % of each other's spread."""
    rng, q = np.random.default_rng(0), 0.02
    root = np.linalg.cholesky(motion_covariance(1 / FPS, q))
    motions = []
    for _ in range(20):
        state, joints = np.zeros((25, 6)), []
        for _ in range(90):
            state = (
                np.hstack([state[:, :3] + state[:, 3:] / FPS, state[:, 3:]]) + rng.normal(size=(25, 6)) @ root.T
            )
            joints.append(state[:, :3])
        motions.append((np.array(joints), FPS))
    found = np.array([densities(motions)[name] for name in BODY_25.joints])
    assert found.shape == (25, 3)
    # 1,780 second differences of three axes, neighbours correlated by 1/4; sides taken together.
    np.testing.assert_allclose(found[:, 0].mean(), q, rtol=0.15)
    # The ends' velocities come from neighbouring frames, which adds to what a gap needs.
    np.testing.assert_allclose(found[:, 2].mean(), q, rtol=0.25)


@pytest.mark.parametrize(("share", "correlation_s"), [(0.2, 1.0), (0.5, 0.6)])
def test_lasting_errors_are_told_from_white_ones(share, correlation_s):
    rng, sigma = np.random.default_rng(1), 0.03
    T, P, J = 240, 20, 25
    kept = np.exp(-1 / FPS / correlation_s)
    slow = [rng.normal(size=(P, J, 3))]
    for _ in range(T - 1):
        slow.append(kept * slow[-1] + np.sqrt(1 - kept**2) * rng.normal(size=(P, J, 3)))
    error = np.sqrt(1 - share) * np.array(slow) + np.sqrt(share) * rng.normal(size=(T, P, J, 3))
    truth = rng.normal(size=(T, P, J, 3))
    information = np.tile(np.eye(3) / sigma**2, (T * P, J, 1, 1))
    measured = (truth + sigma * error).reshape(T * P, J, 3)
    found = _lasting(measured, information, np.ones((T * P, J), dtype=bool), truth, FPS)
    assert found.white_share == pytest.approx(share, abs=0.04)
    assert found.correlation_s == pytest.approx(correlation_s, rel=0.15)


def test_the_shipped_model_holds_what_was_measured():
    """Hips turn slowest, feet and wrists fastest; about a third of an error is new from frame to frame."""
    model = MotionModel.load(BODY_25.joints)
    slowest, fastest = BODY_25.joints[model.psd_lost.argmin()], BODY_25.joints[model.psd_lost.argmax()]
    assert slowest == "MidHip" and "Toe" in fastest
    assert 0.2 < model.views.white_share < 0.5 and 0.5 < model.body.correlation_s < 2.0
    assert (model.density(np.full(25, 2.0)) > 5 * model.psd_still).all()
