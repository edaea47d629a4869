"""Human proposals, scores of scenes, sweeps: figures that can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.evaluation.experiments.hips import (
    HIP,
    HIPS,
    precision_recall_f1,
    score_hips,
    with_hips_in_views,
)
from shapepose_fg.evaluation.experiments.proposals import VIEWS, curves
from shapepose_fg.evaluation.experiments.scene_scores import mean_of, score_scene
from shapepose_fg.evaluation.experiments.sweeps import thinned
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate
from shapepose_fg.simulation.truth import truth_of


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(5, frames=4)


def test_a_proposal_is_right_once_and_within_20_cm():
    truth = np.array([[[0.0, 0, 1], [1.0, 0, 1]], [[0.0, 0, 1], [1.0, 0, 1]]])
    first = np.array([[0.1, 0, 1], [0.0, 0.15, 1], [1.0, 0.25, 1]])  # right, the same person again, 25 cm off
    second = np.array([[1.0, 0.19, 1], [np.nan] * 3])
    found = score_hips([first, second], truth)
    assert found == {"proposals": 5, "people": 4, "right": 2}
    assert precision_recall_f1([found]) == pytest.approx((40.0, 50.0, 400 / 9))


def test_two_proposals_between_two_people_are_both_given_out():
    truth = np.array([[[0.0, 0, 0], [0.3, 0, 0]]])
    found = score_hips(
        [np.array([[0.15, 0, 0], [-0.1, 0, 0]])], truth
    )  # the first is near both, the second near one
    assert found["right"] == 2


def test_hips_are_left_in_as_many_views_as_are_asked_for_and_nothing_else_goes(scene):
    whole = simulate(scene, DetectorConfig.perfect())
    seen = with_hips_in_views(whole, scene, 2)
    for t, frame in enumerate(seen.detections):
        hips = np.isin(frame.joint, HIPS)
        others = ~np.isin(whole[t].joint, HIPS)
        np.testing.assert_array_equal(frame.xy[~hips], whole[t].xy[others])
        for joint in HIPS:
            assert (frame.joint == joint).sum() == 2 * scene.people
        middle = frame.joint == HIP
        xy, _ = scene.rig.project(scene.truth_at(t)[:, HIP])
        for person in range(scene.people):
            own = np.linalg.norm(frame.xy[middle] - xy[frame.view[middle], person], axis=1) < 0.01
            assert own.sum() == 2  # exact detections: those at the person's own hip
    assert seen.views == 2.0
    assert with_hips_in_views(whole, scene, 6).views == 6.0


def test_the_views_that_see_a_hip_are_the_same_in_every_frame(scene):
    seen = with_hips_in_views(simulate(scene, DetectorConfig.perfect()), scene, 3)
    views = [sorted(frame.view[frame.joint == HIP].tolist()) for frame in seen.detections]
    assert all(each == views[0] for each in views)


def test_curves_are_means_over_stretches():
    good, bad = {"proposals": 4, "people": 4, "right": 4}, {"proposals": 4, "people": 4, "right": 2}
    from shapepose_fg.evaluation.experiments.hips import METHODS

    figures = {
        "2 views, a": {"views": 2.0, "people": 4, **dict.fromkeys(METHODS, good)},
        "2 views, b": {"views": 1.0, "people": 4, **dict.fromkeys(METHODS, bad)},
    }
    assert VIEWS[0] == 2
    [(views, mean, shares)] = curves(figures)
    assert (views, mean) == (2, 1.5)
    assert all(share == (75.0, 75.0) for share in shares.values())


def test_a_shifted_truth_is_as_far_off_as_it_was_shifted(scene):
    truth = truth_of(scene)
    covariance = np.broadcast_to(np.eye(3) * 0.005**2, truth.covariance.shape)
    shifted = replace(truth, joints=truth.joints + np.array([0.01, 0.0, 0.0]), covariance=covariance)
    found = score_scene(shifted, scene)
    joints = 4 * scene.people * 25
    assert found["true"] == found["predicted"] == found["correct"] == joints
    assert found["error_mm"] == found["seen_mm"] == pytest.approx([10.0 * joints, joints])
    assert found["unseen_mm"] == [0.0, 0]
    m = mean_of([found, found | {"nobody": 3}])
    assert m["f1"] == m["idf1"] == 100.0 and m["nobody"] == 3
    assert m["body_mm"] < 0.01  # the bodies were not shifted
    assert m["inside_95"] == 100.0  # two sigma; the 95 % ellipsoid reaches to 2.8
    assert np.isnan(m["unseen_mm"]) and np.isnan(m["ms"])


def test_a_person_who_is_missed_and_one_who_is_invented_cost_f1_what_they_weigh(scene):
    truth = truth_of(scene)
    covariance = np.broadcast_to(np.eye(3) * 0.005**2, truth.covariance.shape)
    joints = truth.joints.copy()
    joints[truth.person == 0] += (0.0, 0.0, 30.0)  # nobody is there, and somebody is missing
    found = score_scene(replace(truth, joints=joints, covariance=covariance), scene)
    assert found["nobody"] == found["missed"] == len(scene)
    assert mean_of([found])["f1"] == pytest.approx(75.0)  # three of four people


def test_a_thinned_scene_is_slower_and_otherwise_the_same(scene):
    half = thinned(scene, 2)
    assert half.fps == scene.fps / 2 and len(half) == 2
    np.testing.assert_array_equal(half.keypoints, scene.keypoints[::2])
