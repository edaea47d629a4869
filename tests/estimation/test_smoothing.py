"""Drafts smoothed over time, against the whole problem solved at once and against a wrong stretch
of drafts.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation import smoothing
from shapepose_fg.estimation.motion_densities import MotionModel

MOTION = MotionModel.load(BODY_25.joints)
WRIST = BODY_25.index("RWrist")


def test_it_is_the_least_squares_solution_over_all_frames(monkeypatch):
    """With weights that stay 1: positions and velocities of all frames solved as one dense
    system.
    """
    monkeypatch.setattr(smoothing, "KERNEL", 1e12)
    motion = replace(MOTION, psd_speed=np.zeros(len(BODY_25.joints)))
    rng, T, J = np.random.default_rng(0), 9, len(BODY_25.joints)
    times = np.cumsum(rng.uniform(0.02, 0.2, T))
    joints, sigma = rng.normal(0, 0.01, size=(T, J, 3)), rng.uniform(0.01, 0.1, T)
    covariance = np.broadcast_to((sigma**2)[:, None, None, None] * np.eye(3), (T, J, 3, 3))
    mean, found = smoothing.smoothed(joints, covariance, np.zeros(T, dtype=int), times, motion)
    q = motion.density(np.zeros(J))[WRIST]
    weight = 1 / (4 * sigma**2 + smoothing.LEAST_SIGMA_M**2)
    H, b = np.zeros((2 * T, 2 * T)), np.zeros((2 * T, 3))
    H[::2, ::2], b[::2] = np.diag(weight), weight[:, None] * joints[:, WRIST]
    H[1, 1] += 1 / MOTION.law.start[0] ** 2
    for k, h in enumerate(np.diff(times)):
        step = np.array([[-1, -h, 1, 0], [0, -1, 0, 1]])
        noise = q * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
        H[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += step.T @ np.linalg.inv(noise) @ step
    np.testing.assert_allclose(mean[:, WRIST], np.linalg.solve(H, b)[::2], atol=1e-5)
    np.testing.assert_allclose(found[:, WRIST, 0, 0], np.diag(np.linalg.inv(H))[::2], rtol=1e-4)


def test_a_wrong_draft_of_two_frames_does_not_lead_the_joint_away():
    """A neighbour's wrist half a metre off in two frames, of two people of whom one walks and one
    stands.
    """
    T, J = 30, len(BODY_25.joints)
    times = np.tile(np.arange(T) / 30, 2)
    true = np.zeros((2 * T, J, 3))
    true[:T, :, 0] = 1.5 * times[:T, None]
    track = np.repeat([7, 3], T)
    drafts = true + np.random.default_rng(1).normal(0, 0.01, true.shape)
    drafts[12:14, WRIST, 2] += 0.5
    covariance = np.broadcast_to(0.01**2 * np.eye(3), (2 * T, J, 3, 3))
    mean, _ = smoothing.smoothed(drafts, covariance, track, times, MOTION)
    error = np.linalg.norm(mean - true, axis=-1)
    assert np.delete(error, WRIST, axis=1).max() < 0.03
    assert error[:, WRIST].max() < 0.1, "a mean of the frames around would be 0.25 off and more"


def test_what_is_never_known_stays_unknown_and_gaps_grow_uncertain():
    T, J = 20, len(BODY_25.joints)
    joints = np.zeros((T, J, 3))
    joints[:, 0], joints[5:15, 1] = np.nan, np.nan
    covariance = np.where(np.isfinite(joints)[..., None], 1e-4 * np.eye(3), np.nan)
    mean, found = smoothing.smoothed(
        joints, covariance, np.zeros(T, dtype=int), np.arange(T) / 30, MOTION
    )
    assert np.isnan(mean[:, 0]).all() and np.isnan(found[:, 0]).all()
    assert mean[:, 1] == pytest.approx(0.0, abs=1e-6)
    sigma = np.sqrt(found[:, 1, 0, 0])
    assert sigma[10] > 1.2 * sigma[4] and sigma[10] == sigma[5:15].max()


@pytest.mark.parametrize("fps", [30, 60])
def test_a_limb_that_swings_is_followed(fps):
    """At 3 Hz over half a metre, 180 m/s²: the drafts say so frame after frame."""
    J, times = len(BODY_25.joints), np.arange(2 * fps) / fps
    true = np.zeros((2 * fps, J, 3))
    true[:, WRIST, 0] = 0.5 * np.sin(2 * np.pi * 3 * times)
    drafts = true + np.random.default_rng(2).normal(0, 0.01, true.shape)
    covariance = np.broadcast_to(0.01**2 * np.eye(3), (2 * fps, J, 3, 3))
    mean, _ = smoothing.smoothed(drafts, covariance, np.zeros(2 * fps, dtype=int), times, MOTION)
    error = np.linalg.norm(mean - true, axis=-1)[5:-5]
    assert error[:, WRIST].mean() < 0.03
    assert np.delete(error, WRIST, axis=1).mean() < 0.01, "joints that stand are smoothed as before"
