"""Whether the measurement of a detector finds what was put in: on series made for it, and on a recording."""

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.measurement.classes import GROUP, GROUPS, joint_states
from shapepose_fg.simulation.measurement.comparison import kolmogorov_smirnov
from shapepose_fg.simulation.measurement.memories import autocorrelation, memory_of
from shapepose_fg.simulation.measurement.misses import tetrachoric
from shapepose_fg.simulation.measurement.people import CONFIG, find, tracks, twin
from shapepose_fg.simulation.measurement.sample import pool, take_sample
from shapepose_fg.simulation.measurement.statistics import statistics

LAGS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40])


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=3, frames=30, cameras=5)


@pytest.fixture(scope="module")
def people(scene):
    return find(simulate(scene), scene.rig, CONFIG)


def test_autocorrelation_of_a_series_that_forgets():
    """x(t + 1) = 0.8 x(t) + noise, 200 series of 100 frames: 0.8 to the power of the lag, to about 0.02."""
    rng = np.random.default_rng(0)
    series = np.zeros((200, 100))
    series[:, 0] = rng.normal(size=200)
    for t in range(1, 100):
        series[:, t] = 0.8 * series[:, t - 1] + 0.6 * rng.normal(size=200)
    track, frame = np.indices(series.shape)
    table = {"track": track.ravel(), "frame": frame.ravel()}
    table |= {"view": np.zeros(series.size, int), "joint": np.zeros(series.size, int)}
    found = autocorrelation(series.ravel(), table, np.array([1, 2, 5]))
    np.testing.assert_allclose(found, 0.8 ** np.array([1, 2, 5]), atol=0.04)
    known = series.ravel().copy()
    known[::3] = np.nan  # what is not known is left out
    np.testing.assert_allclose(autocorrelation(known, table, np.array([1])), 0.8, atol=0.05)


def test_two_memories_are_told_apart():
    lag_s = LAGS / 25.0
    curve = 0.3 * np.exp(-lag_s / 0.15) + 0.5 * np.exp(-lag_s / 2.0)
    fast, slow = memory_of(curve, LAGS, 25.0)
    np.testing.assert_allclose(fast + slow, [0.3, 0.15, 0.5, 2.0], rtol=0.05)


def test_tetrachoric_correlation_by_drawing():
    """Pairs of normal values with correlation 0.6: how often both are among the lowest 20 % gives 0.6 back."""
    rng = np.random.default_rng(0)
    a, b = rng.multivariate_normal([0, 0], [[1, 0.6], [0.6, 1]], 100_000).T
    low = -0.8416  # 20 % are below
    phi = np.corrcoef(a < low, b < low)[0, 1]
    assert tetrachoric(np.array([phi]), 0.2)[0] == pytest.approx(0.6, abs=0.02)


def test_kolmogorov_smirnov_by_hand():
    assert kolmogorov_smirnov(np.array([1.0, 2.0]), np.array([1.0, 2.0])) == 0.0
    assert kolmogorov_smirnov(np.array([1.0, 2.0, 3.0, 4.0]), np.array([3.5, 4.5])) == 0.75


def test_groups_are_those_of_mirrored_joints():
    for joint in range(25):
        assert GROUP[joint] == GROUP[BODY_25.mirror[joint]]
    assert len(GROUPS) == 14


def test_states_of_joints():
    expected = {"seen": np.array([0.9, 0.1, 0.1, 0.5]), "hidden_by": np.array([-1, -1, 3, -1])}
    assert joint_states(expected).tolist() == [0, 1, 2, -1]


def test_people_are_linked_over_time():
    """Two people half a metre apart who walk 0.1 m a frame; one is missing in frame 2."""
    frame = np.array([0, 0, 1, 1, 2, 3, 3])
    place = np.array([0.0, 2.0, 0.1, 2.1, 0.2, 0.3, 2.3])
    joints = np.zeros((7, 25, 3))
    joints[:, :, 0] = place[:, None]
    found = tracks(frame, joints)
    assert found[0] == found[2] == found[4] == found[5]
    assert found[1] == found[3]
    assert found[6] not in (found[0], found[1])  # who is lost for a frame is somebody else afterwards


def test_a_recording_is_measured(scene, people):
    """Of 3 people in 30 frames most are found; the statistics have a share of misses for every joint and state."""
    assert len(people.frame) >= 80
    sample = take_sample(simulate(scene), scene.rig, people, CONFIG)
    assert sample.expected["hit"].mean() > 0.6
    assert np.nanmedian(np.linalg.norm(sample.expected["residual_m"], axis=1)) < 0.04
    both = pool([sample, sample])
    assert len(both.expected["hit"]) == 2 * len(sample.expected["hit"])
    found = statistics(both, scene.rig, scene.fps)
    assert np.shape(found["miss"]) == (14, 3)
    assert all(0 <= share <= 1 for row in found["miss"] for share in row)


def test_a_twin_shows_the_same_people(scene, people):
    """Whom 25 or more frames show, within centimetres of the truth, though smoothed."""
    same = twin(people, scene.rig, scene.fps)
    assert len(same) == 30
    assert same.people >= 2
    apart = np.linalg.norm(same.keypoints[15][:, None] - scene.keypoints[15][None], axis=-1).mean(axis=-1)
    assert np.sort(apart.min(axis=1))[1] < 0.1
