"""Factors that join people of a window: one graph, against the closed form of linear Gaussian
estimation.
"""

import gtsam
import numpy as np
import pytest

from factors import isotropic, joint_key
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig, WindowGraphConfig
from shapepose_fg.estimation.frame_graph import FrameGraph, state_covariances
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.estimation.user_factors import add_factors

R, L = BODY_25.index("RWrist"), BODY_25.index("LWrist")
EXACT = WindowGraphConfig(max_iterations=100, tolerance=1e-12)
APART_M, SIGMA_M = np.array([0.3, 0.0, 0.05]), 0.01


@pytest.fixture
def seen(five_cameras, two_people):
    """Detections of three people (the third a metre beside the first), 6 px of noise: (3, 25, 5,
    2).
    """
    truth = np.concatenate([two_people, two_people[:1] + np.array([1.0, 0.0, 0.0])])
    xy = np.moveaxis(five_cameras.project(truth)[0], 0, 2)
    return truth, xy + np.random.default_rng(0).normal(0, 6.0, xy.shape)


def graphs(rig, truth, xy, frames=1) -> list[FrameGraph]:
    """A graph for each person, in so many frames of the same detections."""
    people, V = [], len(rig)
    for number in range(len(truth)):
        seen = Observations(
            np.repeat(xy[number][None], frames, axis=0),
            np.full((frames, 25, V), 0.8),
            np.full((frames, 25, 3), np.nan),
            np.full(frames, number),
            np.arange(frames),
            np.repeat(0.1 * np.arange(frames)[:, None], V, axis=1),
        )
        settings = EstimatorConfig(ObservationConfig(kernel="none"), EXACT)
        sigmas, first = (
            np.full((frames, 25, V), 6.0),
            np.repeat(truth[number][None], frames, axis=0),
        )
        people.append(FrameGraph(seen, sigmas, Views.of(rig), settings, first=first))
    return people


def solve(people: list[FrameGraph], truth) -> None:
    nothing = JointTargets(np.full((1, 25, 3), np.nan), np.zeros((1, 25, 3, 3)))
    for number, person in enumerate(people):
        person.prepare(np.ones((1, 25, 5), bool), nothing, truth[number][None])
    for person in people:
        if person is person.ties.people[0]:
            person.optimise()


def box(window, keys):
    """r = (left wrist - right wrist) - d: whoever comes before holds its left end."""
    for other in window.partners:
        if {window.track, other.track} == {0, 1}:
            mine, theirs = window.shared(other)
            for right, left in zip(
                keys[mine, R].tolist(), other.keys[theirs, L].tolist(), strict=True
            ):
                yield gtsam.BetweenFactorPoint3(right, left, APART_M, isotropic(3, SIGMA_M))


def test_the_joint_posterior_is_that_of_the_closed_form(five_cameras, seen):
    """Two independent Gaussians and a linear factor between them: Kalman's update of both."""
    truth, xy = seen
    alone = graphs(five_cameras, truth, xy)
    solve(alone, truth)
    before = [each[0] for each in state_covariances(alone)]
    tied = graphs(five_cameras, truth, xy)
    add_factors(tied, [box])
    assert [person.track for person in tied[0].ties.people] == [0, 1] and tied[2].ties.people == [
        tied[2]
    ]
    solve(tied, truth)
    after = [each[0] for each in state_covariances(tied)]

    a, b, A, B = alone[0].positions[0, R], alone[1].positions[0, L], before[0][R], before[1][L]
    gain = np.linalg.inv(A + B + SIGMA_M**2 * np.eye(3))
    missing = (b - a) - APART_M
    # The projections are not linear: 20 cm away their information is a little another.
    np.testing.assert_allclose(
        tied[0].positions[0, R] - a, A @ gain @ missing, atol=0.1 * np.linalg.norm(missing)
    )
    expected = A - A @ gain @ A
    assert (
        np.linalg.norm(after[0][R] - expected)
        < 0.25 * np.linalg.norm(expected)
        < 0.25 * np.linalg.norm(A)
    )
    across = gtsam.Marginals(tied[0].graph, tied[0].values).jointMarginalCovariance(
        gtsam.KeyVector([int(tied[0].keys[0, R]), int(tied[1].keys[0, L])])
    )
    found = across.at(int(tied[0].keys[0, R]), int(tied[1].keys[0, L]))
    expected = A @ gain @ B
    assert np.linalg.norm(found - expected) < 0.3 * np.linalg.norm(expected)
    # Joints that no factor is on, and people whom none ties, are as they were.
    others = np.delete(np.arange(25), [R])
    np.testing.assert_allclose(
        tied[0].positions[0, others], alone[0].positions[0, others], atol=1e-6
    )
    np.testing.assert_array_equal(tied[2].positions, alone[2].positions)


def test_a_shared_point_of_the_user_s_own(five_cameras, seen):
    """Both hold the same point: a variable that is nobody's joint."""
    truth, xy = seen
    point = gtsam.symbol("b", 0)

    def same_point(window, keys):
        if window.track > 1:
            return
        start = gtsam.Values()
        start.insert(point, window.first[0, R])
        yield start
        yield gtsam.BetweenFactorPoint3(int(keys[0, R]), point, np.zeros(3), isotropic(3, 0.001))

    tied = graphs(five_cameras, truth, xy)
    add_factors(tied, [same_point])
    solve(tied, truth)
    held = tied[0].values.atPoint3(point)
    for person in tied[:2]:
        assert person.failure == "" and np.linalg.norm(person.positions[0, R] - held) < 0.01
    assert len(tied[0].ties.people) == 2 and not tied[2].values.exists(point)
    of_both = state_covariances(tied)
    assert all(np.isfinite(of_both[n][0, R]).all() for n in range(2))


def test_factors_that_cannot_count_are_refused_or_counted(five_cameras, seen):
    truth, xy = seen
    people = graphs(five_cameras, truth, xy)
    for key, words in (
        (joint_key(7, R, 0), "joint 4, frame 0"),
        (joint_key(1, R, 99), "frame 99"),
        (gtsam.symbol("b", 3), "b3"),
    ):
        lost = gtsam.RangeFactor3(int(people[0].keys[0, R]), key, 0.5, isotropic(1, 0.05))
        with pytest.raises(ValueError, match=words) as refused:
            add_factors(people, [lambda window, keys, lost=lost: [lost]])
        assert "gtsam.Values" in str(refused.value)
    taken = gtsam.Values()
    taken.insert(int(people[0].keys[0, R]), np.zeros(3))
    with pytest.raises(ValueError, match="is the key of a joint"):
        people[0].add(taken)
    people = graphs(five_cameras, truth, xy)
    add_factors(people, [box])
    start = truth.copy()
    start[1, L] = np.nan
    solve(people, start)
    assert len(people[0].ties.factors) == 1 and len(people[0].ties.active) == 0
