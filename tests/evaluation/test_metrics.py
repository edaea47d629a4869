from types import SimpleNamespace

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import (
    covariance_calibration,
    joint_metrics,
    match_people,
    mean_distance,
)

J = 25
MIRROR = np.array(BODY_25.mirror)


@pytest.fixture
def truth():
    """(6, 3, 25, 3): three people two metres apart, each within half a metre of their middle."""
    rng = np.random.default_rng(0)
    middle = np.array([[0.0, 0, 1], [2, 0, 1], [0, 2, 1]])
    return middle[:, None] + rng.uniform(-0.5, 0.5, size=(6, 3, J, 3))


def test_perfect_is_exactly_one(truth):
    metrics = joint_metrics(list(truth), truth)
    assert metrics.precision == metrics.recall == metrics.f1 == 1.0
    assert metrics.mpjpe_mm == 0.0
    assert metrics.people_found == metrics.people_true == 18
    assert metrics.people_missed == metrics.false_positives == 0


def test_order_of_people_and_rows_does_not_matter(truth):
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(6), 3)
    rows = truth[:, [2, 0, 1]].reshape(-1, J, 3)
    order = rng.permutation(18)
    people = SimpleNamespace(frame=frame[order], joints=rows[order])
    assert joint_metrics(people, truth) == joint_metrics(list(truth), truth)


def test_one_person_with_left_and_right_swapped(truth):
    """A person whose left and right are exactly 0.3 m apart: 3 of 25 joints stay, 22 are 0.3 m
    away.
    """
    side = np.sign(MIRROR - np.arange(J))
    truth[0, 0] = np.stack([0.15 * side, np.zeros(J), np.ones(J)], axis=1)
    predicted = truth.copy()
    predicted[0, 0] = predicted[0, 0][MIRROR]
    metrics = joint_metrics(list(predicted), truth)
    assert metrics.joints_correct == 450 - 22
    assert metrics.precision == metrics.recall == pytest.approx(1 - 22 / 450)
    assert metrics.mpjpe_mm == pytest.approx(300 * 22 / 450)
    assert (
        metrics.people_missed == metrics.false_positives == 0
    )  # 0.264 m off in the mean: still that person


def test_a_missing_person_costs_recall_only(truth):
    predicted = [*truth[:5], truth[5, :2]]
    metrics = joint_metrics(predicted, truth)
    assert metrics.precision == 1.0
    assert metrics.recall == pytest.approx(17 / 18)
    assert metrics.f1 == pytest.approx(2 * 17 / 35)
    assert metrics.mpjpe_mm == 0.0
    assert (metrics.people_missed, metrics.people_duplicated, metrics.people_invented) == (1, 0, 0)


def test_a_second_prediction_of_someone_and_one_of_nobody_cost_precision_only(truth):
    double = truth[0, :1] + 0.01
    nobody = truth[1, :1] + 5.0
    predicted = [np.concatenate([truth[0], double]), np.concatenate([nobody, truth[1]]), *truth[2:]]
    metrics = joint_metrics(predicted, truth)
    assert metrics.recall == 1.0
    assert metrics.precision == pytest.approx(18 / 20)
    assert (metrics.people_missed, metrics.people_duplicated, metrics.people_invented) == (0, 1, 1)
    assert metrics.mpjpe_mm == 0.0
    assert metrics.people_missed + metrics.false_positives > 0


def test_the_double_that_is_nearer_is_the_person(truth):
    predicted = [np.concatenate([truth[0] + 0.1, truth[0, 1:2]]), *truth[1:]]
    matches = match_people(
        np.repeat(np.arange(6), [4, 3, 3, 3, 3, 3]), np.concatenate(predicted), truth
    )
    assert matches.duplicated.tolist() == [1]
    assert dict(zip(matches.row.tolist(), matches.person.tolist(), strict=True))[3] == 1


def test_missing_joints_are_not_predicted_and_not_recalled(truth):
    predicted = truth.copy()
    predicted[0, 0, :10] = np.nan
    metrics = joint_metrics(list(predicted), truth)
    assert metrics.joints_predicted == 450 - 10
    assert metrics.precision == 1.0
    assert metrics.recall == pytest.approx(440 / 450)
    assert metrics.mpjpe_mm == 0.0


def test_what_the_truth_does_not_know_counts_neither_way(truth):
    predicted = truth.copy()
    truth[0, 0, :10] = np.nan
    truth[3, 2] = np.nan
    predicted[3, 2] = np.nan
    metrics = joint_metrics(list(predicted), truth)
    assert metrics.joints_predicted == metrics.joints_true == 450 - 10 - 25
    assert metrics.precision == metrics.recall == 1.0
    assert metrics.people_true == 17
    assert metrics.people_missed == metrics.false_positives == 0


def test_joints_at_the_bound(truth):
    """0.2 m is correct, a little more is not; MPJPE counts both."""
    predicted = truth.copy()
    predicted[0, 0, 0, 2] += 0.1999
    predicted[0, 0, 1, 2] += 0.2001
    metrics = joint_metrics(list(predicted), truth)
    assert metrics.joints_correct == 449
    assert metrics.mpjpe_mm == pytest.approx(400 / 450)


def test_frames_that_were_not_run_are_left_out(truth):
    """A reconstruction of frames 10 and 12 only."""
    people = SimpleNamespace(
        frame=np.repeat([10, 12, 99], 3), joints=truth[[0, 1, 2]].reshape(-1, J, 3)
    )
    metrics = joint_metrics(people, truth[:2], frames=[10, 12])
    assert metrics.people_true == metrics.people_found == 6
    assert metrics.people_missed == metrics.false_positives == 0
    assert joint_metrics(people, truth[:2], frames=[10, 11]).people_missed == 3


def test_nobody(truth):
    none = [np.zeros((0, J, 3))] * 6
    metrics = joint_metrics(none, truth)
    assert metrics.recall == 0.0
    assert np.isnan(metrics.precision)
    assert np.isnan(metrics.mpjpe_mm)
    empty = joint_metrics(none, np.zeros((6, 0, J, 3)))
    assert empty.people_missed == empty.false_positives == 0
    assert np.isnan(empty.recall)
    assert joint_metrics([], np.zeros((0, 3, J, 3))).people_true == 0


def test_a_prediction_without_joints_is_nobody_at_all(truth):
    predicted = [np.concatenate([truth[0], np.full((1, J, 3), np.nan)]), *truth[1:]]
    assert joint_metrics(predicted, truth) == joint_metrics(list(truth), truth)


def test_the_assignment_is_the_best_not_the_greedy_one():
    """B lies between two people; greedy would give it the nearer and leave A to the far one."""
    people = np.array([0.0, 0.3])[None, :, None, None] * np.ones((1, 2, 1, 3)) / np.sqrt(3)
    predicted = np.array([-0.25, 0.1])[:, None, None] * np.ones((2, 1, 3)) / np.sqrt(3)
    matches = match_people(np.zeros(2, int), predicted, people)
    assert dict(zip(matches.row.tolist(), matches.person.tolist(), strict=True)) == {0: 0, 1: 1}


def test_someone_far_does_not_decide_about_the_near():
    """Row 1 is 5 m from everyone; its distance must not push row 0 off the person 0.1 m from it."""
    people = np.array([0.0, 0.4])[None, :, None, None] * np.array([1.0, 0, 0])
    predicted = np.array([[[0.1, 0, 0]], [[-5.0, 0, 0]]])
    matches = match_people(np.zeros(2, int), predicted, people)
    assert matches.row.tolist() == [0]
    assert matches.person.tolist() == [0]
    assert matches.invented.tolist() == [1]
    assert matches.missed.tolist() == [[0, 1]]


def test_mean_distance_by_hand():
    predicted = np.array([[[0.0, 0, 0], [np.nan, 0, 0], [1, 1, 1]]])
    truth = np.array([[[0.0, 0.3, 0], [0, 0, 0], [np.nan, 0, 0]], np.full((3, 3), np.nan)])
    np.testing.assert_allclose(
        mean_distance(predicted[:, None], truth), [[(0.3 + 0.5) / 2, np.inf]]
    )


def test_shapes_that_disagree_are_refused(truth):
    with pytest.raises(ValueError, match="one array for each"):
        joint_metrics(list(truth[:5]), truth)
    with pytest.raises(ValueError, match="joints must be"):
        match_people(np.zeros(3, int), truth[0, :, :20], truth)
    with pytest.raises(ValueError, match="frames must be 6 numbers"):
        match_people(np.zeros(3, int), truth[0], truth, frames=[0, 1])


def test_true_covariances_are_called_true():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20000, 3, 3)) * 0.02 + 0.01 * np.eye(3)
    covariance = root @ root.transpose(0, 2, 1) + 1e-8 * np.eye(3)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(20000, 3)))
    calibration = covariance_calibration(error, covariance)
    # Standard error of the mean of 20,000 chi-squared(3): sqrt(6 / 20000) = 0.017; of a share:
    # 0.0035. Four each.
    assert calibration.nees.mean() == pytest.approx(3.0, abs=0.07)
    for level, share in calibration.coverage.items():
        assert share == pytest.approx(level, abs=0.014)


def test_a_covariance_that_promises_too_much_is_seen():
    """Half the true sigma: NEES is four times 3, and the 95 % ellipsoid holds P(chi2_3 < 7.81 / 4)
    = 41.8 %.
    """
    rng = np.random.default_rng(0)
    calibration = covariance_calibration(
        rng.normal(size=(20000, 3)), np.broadcast_to(0.25 * np.eye(3), (20000, 3, 3))
    )
    assert calibration.nees.mean() == pytest.approx(12.0, abs=0.28)
    assert calibration.coverage[0.95] == pytest.approx(0.418, abs=0.014)


def test_nees_by_hand_and_nan_left_out():
    errors = np.array([[[1.0, 0, 2], [np.nan, 0, 0]]])
    covariances = np.array([[np.diag([1.0, 1, 4]), np.eye(3)]])
    calibration = covariance_calibration(errors, covariances)
    np.testing.assert_allclose(calibration.nees, [2.0])
    # -(2 + log det C + 3 log 2 pi) / 2 with det C = 4.
    assert calibration.log_score == pytest.approx(-1 - np.log(4) / 2 - 1.5 * np.log(2 * np.pi))
    assert covariance_calibration(100 * errors, covariances).log_score == -50.0
    assert calibration.coverage == {0.5: 1.0, 0.9: 1.0, 0.95: 1.0}
    assert len(covariance_calibration(np.zeros((0, 3)), np.zeros((0, 3, 3))).nees) == 0
    with pytest.raises(ValueError, match="positive definite"):
        covariance_calibration(np.zeros((1, 3)), -np.eye(3)[None])
