"""How fast joints go, measured along their paths, at any frame rate."""

import numpy as np
import pytest

from shapepose_fg.estimation.in_time import path_speeds, within


@pytest.mark.parametrize("fps", [15, 25, 30, 60, 120])
def test_a_swing_that_comes_back_is_fast_at_any_rate(fps):
    """2.5 Hz: over 0.2 s the point goes nowhere, over 0.4 s it is where it was."""
    times, reach_m, frequency_hz = np.arange(2 * fps) / fps, 0.3, 2.5
    points = np.zeros((len(times), 1, 3))
    points[:, 0, 1] = reach_m * np.sin(2 * np.pi * frequency_hz * times)
    speed = path_speeds(points, times)
    inside = slice(fps // 3, -fps // 3)
    np.testing.assert_allclose(speed[inside], 4 * reach_m * frequency_hz, rtol=0.35)
    assert np.median(speed[inside]) == pytest.approx(4 * reach_m * frequency_hz, rel=0.2)


@pytest.mark.parametrize("fps", [30, 120])
def test_noise_is_slow_at_any_rate(fps):
    """A joint that stands, seen to 5 mm: over one frame of 120 a second it would go at 1.5 m/s."""
    points = np.random.default_rng(0).normal(0, 0.005, (2 * fps, 20, 3))
    assert path_speeds(points, np.arange(2 * fps) / fps).mean() < 0.5


def test_unknown_points_do_not_count_and_nothing_is_known_of_one_frame():
    times = np.arange(60) / 30
    points = np.zeros((60, 2, 3))
    points[..., 0] = 2.0 * times[:, None]
    points[::3, 0], points[:, 1] = np.nan, np.nan
    speed = path_speeds(points, times)
    np.testing.assert_allclose(speed[:, 0], 2.0)
    assert not speed[:, 1].any()
    assert path_speeds(points[:1], times[:1]).shape == (0, 2)
    assert path_speeds(points[1:3, :1], np.array([0.0, 1.0])).item() == pytest.approx(2.0 / 30)


def test_values_near_in_time_are_put_together():
    times = np.array([0.0, 0.1, 0.2, 0.5])
    near = within(np.arange(4.0)[:, None], times, times - 0.1, times + 0.1)
    expected = [[0, 1], [0, 1, 2], [1, 2], [3]]
    assert [each[np.isfinite(each)].tolist() for each in near[..., 0].T] == expected
