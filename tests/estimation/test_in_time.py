"""How fast joints go and turn, measured from their points, at any frame rate."""

import numpy as np
import pytest

from shapepose_fg.estimation.in_time import motion_of

FREQUENCY_HZ, REACH_M = 2.5, 0.3


def swing(times_s: np.ndarray) -> np.ndarray:
    """(T, 1, 3) a point that swings to and fro: within 0.4 s it is where it was."""
    points = np.zeros((len(times_s), 1, 3))
    points[:, 0, 1] = REACH_M * np.sin(2 * np.pi * FREQUENCY_HZ * times_s)
    return points


@pytest.mark.parametrize("fps", [25, 30, 60, 120])
def test_a_swing_is_as_fast_and_turns_as_much_at_any_rate(fps):
    times = np.arange(3 * fps) / fps
    points = swing(times)
    speed, turning = motion_of(points, np.zeros(points.shape[:2]), times)
    inside = slice(fps // 2, -fps // 2)
    assert np.median(speed[inside]) == pytest.approx(4 * REACH_M * FREQUENCY_HZ, rel=0.3)
    # Second differences over h of white noise on acceleration have the variance 2 q h³ / 3 along
    # each axis.
    acceleration, h = REACH_M * (2 * np.pi * FREQUENCY_HZ) ** 2 / np.sqrt(2), max(0.05, 1 / fps)
    assert 0.3 < np.median(turning[inside]) / (acceleration**2 * h / 2) < 2.0
    assert turning[inside].min() > 0.2 * turning[inside].max()


def test_noise_does_not_turn_and_neither_do_a_few_wrong_points():
    """Joints that stand, seen to a centimetre at 60 frames a second; then half a metre off in four
    frames.
    """
    rng, times = np.random.default_rng(0), np.arange(120) / 60
    points, variance = rng.normal(0, 0.01, (120, 20, 3)), np.full((120, 20), 0.01**2)
    speed, turning = motion_of(points, variance, times)
    assert turning.mean() < 4.0, "a walker's wrist has 5"
    assert speed.mean() < 0.6
    points[60:64, :, 2] += 0.5
    assert motion_of(points, variance, times)[1].mean() < 2 * turning.mean() + 1.0, (
        "a mean would be in hundreds"
    )


def test_motion_goes_on_across_points_that_are_not_known():
    times = np.arange(90) / 30
    points, variance = swing(times), np.full((90, 1), 1e-6)
    whole = motion_of(points, variance, times)
    points[::5], variance[1::9] = np.nan, 1.0
    speed, turning = motion_of(points, variance, times)
    assert 0.5 < np.median(speed) / np.median(whole[0]) < 1.5
    assert 0.3 < np.median(turning) / np.median(whole[1]) < 2.0
    speed, turning = motion_of(np.full_like(points, np.nan), variance, times)
    assert not speed.any() and not turning.any()


def test_of_one_or_two_frames_there_is_little_to_say():
    speed, turning = motion_of(np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros(1))
    assert speed.shape == turning.shape == (0, 3)
    speed, turning = motion_of(
        np.array([[[0.0, 0, 0]], [[1.0, 0, 0]]]), np.zeros((2, 1)), np.array([0.0, 1.0])
    )
    assert speed.item() == pytest.approx(1.0) and turning.item() == 0.0
