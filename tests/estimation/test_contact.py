"""Feet that stand: told from those that move by noisy velocities, and what a window makes of it."""

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25, COCO_17
from shapepose_fg.estimation.contact import (
    FREE_M2_S,
    FootMotion,
    feet_of,
    smoothed,
    standing_density,
)


def walk(fps: float, noise: float, swing: float = 1.5):
    """A foot that stands for a second, steps for half of one, and stands again, its velocities seen
    with noise.
    """
    times = np.arange(round(2.5 * fps)) / fps
    speed = np.where((times > 1.0) & (times < 1.5), swing, 0.0)
    velocity = np.stack([speed, np.zeros_like(speed), np.zeros_like(speed)], axis=-1)[:, None]
    velocity = velocity + np.random.default_rng(0).normal(0.0, noise, velocity.shape)
    return times, velocity, np.broadcast_to(noise**2 * np.eye(3), (len(times), 1, 3, 3))


@pytest.mark.parametrize("fps", [10, 30, 60])
def test_a_standing_foot_hardly_walks_and_a_stepping_one_is_free(fps):
    times, velocity, covariance = walk(fps, 0.07)
    density = standing_density(velocity, covariance, times)[:, 0]
    middle = (times[1:] + times[:-1]) / 2
    standing = (middle < 0.8) | (middle > 1.7)
    stepping = (middle > 1.1) & (middle < 1.4)
    # A walk of 2 cm in a second at the most, where every frame's velocity is off by 0.12 m/s.
    assert np.sqrt(np.median(density[standing])) < 0.02
    assert density[stepping].min() > FREE_M2_S


def test_a_sliding_foot_is_not_held():
    """A tenth of a second at 0.3 m/s, were it held like a standing one, would be lost."""
    times, velocity, covariance = walk(30, 0.03, swing=0.3)
    density = standing_density(velocity, covariance, times)[:, 0]
    sliding = ((times[1:] + times[:-1]) / 2 > 1.1) & ((times[1:] + times[:-1]) / 2 < 1.4)
    assert density[sliding].min() > 20 * np.median(density[:20])


def test_what_was_not_seen_says_nothing():
    times, velocity, covariance = walk(30, 0.07)
    velocity = np.full_like(velocity, np.nan)
    assert (standing_density(velocity, covariance, times) > FREE_M2_S).all()


def test_without_evidence_it_is_as_often_as_ever():
    """Rates and shares of the three ways to move agree: a chain that nothing is seen of keeps its
    shares.
    """
    feet = FootMotion.measured()
    rate = (feet.turns - np.eye(3)) / feet.lasts_s[:, None]
    np.testing.assert_allclose(feet.turns.sum(axis=1), 1.0)
    np.testing.assert_allclose(feet.first @ rate, 0.0, atol=0.06)
    nothing = smoothed(np.zeros((40, 1, 3)), np.arange(40) / 30)
    np.testing.assert_allclose(nothing[20, 0], feet.first, atol=0.05)


def test_feet_of_skeletons():
    assert [BODY_25.joints[n] for n in feet_of(BODY_25.joints)][:2] == ["RAnkle", "LAnkle"]
    assert len(feet_of(BODY_25.joints)) == 8
    assert [COCO_17.joints[n] for n in feet_of(COCO_17.joints)] == ["LAnkle", "RAnkle"]
    assert len(feet_of(("Head", "Neck"))) == 0
