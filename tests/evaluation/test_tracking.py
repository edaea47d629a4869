from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.tracking import (
    acceleration_errors,
    body_joints,
    fast_wrist_errors,
    frames_unseen,
    joints_by_frame,
    score_tracks,
)
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of

FPS = 30.0
J = 25


def standing(places_m, frames):
    """(T, P, 25, 3) people who stand still, each a stack of joints 2 cm apart above its place on
    the x axis.
    """
    person = np.stack([np.zeros(J), np.zeros(J), 0.02 * np.arange(J)], axis=1)
    at = np.stack([places_m, np.zeros(len(places_m)), np.zeros(len(places_m))], axis=1)
    return np.broadcast_to(at[:, None] + person, (frames, len(places_m), J, 3)).copy()


def result(frame, identity, joints, sigma_m=0.02):
    """A result without bodies."""
    N = len(frame)
    bodies = {"betas": (N, 10), "global_orient": (N, 3), "body_pose": (N, 23, 3), "transl": (N, 3)}
    return Reconstruction(
        frame=np.asarray(frame),
        person=np.asarray(identity),
        joint_names=np.array(BODY_25.joints),
        joints=np.asarray(joints),
        covariance=np.broadcast_to(sigma_m**2 * np.eye(3), (N, J, 3, 3)),
        confidence=np.ones((N, J)),
        status=np.full(N, "ok"),
        **{name: np.full(shape, np.nan) for name, shape in bodies.items()},
    )


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=3, frames=20)


@pytest.fixture
def truth(scene):
    return truth_of(scene)


def noisy(truth, sigma_m=0.02, seed=0):
    """The truth with independent noise along each axis, and covariances that say so."""
    rng = np.random.default_rng(seed)
    covariance = np.broadcast_to(sigma_m**2 * np.eye(3), truth.covariance.shape)
    return replace(
        truth,
        joints=truth.joints + rng.normal(0, sigma_m, truth.joints.shape),
        covariance=covariance,
    )


def test_a_person_who_jumps_by_3_cm_in_one_frame():
    """Second differences of (0, 0, 3 cm, 0, 0) are 3, -6, 3 cm: times 30² 27, 54 and 27 m/s²."""
    truth = standing([0.0], 5)
    found = truth.copy()
    found[2, 0, :, 2] += 0.03
    together = np.ones((5, 1), dtype=bool)
    errors = acceleration_errors(found, truth, together, FPS)
    np.testing.assert_allclose(errors[:, 0, 0], [27, 54, 27])
    together[3] = False  # frames 2 and 3 are not the same track
    np.testing.assert_allclose(
        acceleration_errors(found, truth, together, FPS)[:, 0, 0], [27, np.nan, np.nan]
    )


def test_the_acceleration_of_the_truth_is_no_error():
    truth = standing([0.0], 5)
    truth[..., 0] += (0.5 * 9.81 * (np.arange(5) / FPS) ** 2)[:, None, None]
    assert np.abs(acceleration_errors(truth, truth, np.ones((5, 1), dtype=bool), FPS)).max() == 0.0
    still = np.broadcast_to(truth[:1], truth.shape)
    errors = acceleration_errors(still, truth, np.ones((5, 1), dtype=bool), FPS)
    np.testing.assert_allclose(errors, 9.81)


def test_fast_joints():
    """A wrist at 2 m/s is fast, one at 1 m/s not; a smoother that leaves the fast one 5 cm behind
    is seen.
    """
    truth = standing([0.0], 6)
    truth[:, 0, 4, 1] = 2.0 * np.arange(6) / FPS
    truth[:, 0, 7, 1] = 1.0 * np.arange(6) / FPS
    found = truth.copy()
    found[:, 0, 4, 1] -= 0.05
    found[:, 0, 7, 1] -= 0.5
    np.testing.assert_allclose(fast_wrist_errors(found, truth, FPS), 0.05)
    truth[3] = np.nan  # beside a frame that is missing there is no speed
    assert len(fast_wrist_errors(found, truth, FPS)) == 1


def test_frames_unseen():
    seen = np.array([1, 0, 0, 1, 0, 0, 0], dtype=bool)[:, None]
    frame = np.array([0, 1, 2, 3, 4, 6, 7])  # one missing between 4 and 6
    assert frames_unseen(seen, frame, np.zeros(7, int))[:, 0].tolist() == [0, 1, 2, 0, 1, 1, 2]
    order = np.array([3, 0, 6, 2, 5, 1, 4])
    mixed = frames_unseen(seen[order], frame[order], np.zeros(7, int))[:, 0]
    assert mixed.tolist() == [[0, 1, 2, 0, 1, 1, 2][i] for i in order]
    # Another identity is another person.
    assert frames_unseen(seen, frame, np.array([0, 0, 1, 1, 1, 1, 1]))[:, 0].tolist() == [
        0,
        1,
        1,
        0,
        1,
        1,
        2,
    ]


def test_a_noisy_result_by_its_statistics(truth, scene):
    """20 mm along each axis: mean distance 20 sqrt(8 / pi) = 31.9 mm; second differences have
    sqrt(6) of that.
    """
    score = score_tracks(noisy(truth), truth, scene.fps)
    # 1,500 joints: standard error of the mean 0.35 mm; accelerations are correlated over time, 5 %.
    assert score["mpjpe_mm"] == pytest.approx(31.9, abs=1.4)
    assert score["acceleration_error"] == pytest.approx(
        0.0319 * np.sqrt(6) * scene.fps**2, rel=0.05
    )
    assert score["idf1"] == 100.0
    assert score["false_positives"] == 0
    assert score["seen_inside_50"] == pytest.approx(50, abs=5)
    assert score["body_mpjpe_mm"] < 1e-3
    assert score["body_acceleration_error"] < 1.0  # float32 joints, times 25²


def test_without_identities_the_truth_says_who_is_who(truth, scene):
    people = noisy(truth)
    rng = np.random.default_rng(1)
    shuffled = replace(people, person=np.concatenate([rng.permutation(3) for _ in range(20)]))
    by_truth = score_tracks(shuffled, truth, scene.fps, identities=False)
    assert "idf1" not in by_truth
    error = score_tracks(people, truth, scene.fps)["acceleration_error"]
    assert by_truth["acceleration_error"] == error
    assert score_tracks(shuffled, truth, scene.fps)["idf1"] < 70


def test_joints_long_unseen_are_judged_apart(truth, scene):
    """Nobody sees the left wrist in frames 5 to 19: from frame 14 on it is long unseen; its sigma
    is 10 cm.
    """
    people = noisy(truth)
    hidden = people.frame >= 5
    confidence, covariance = people.confidence.copy(), people.covariance.copy()
    confidence[hidden, 7], covariance[hidden, 7] = 0.0, 0.01 * np.eye(3)
    score = score_tracks(
        replace(people, confidence=confidence, covariance=covariance), truth, scene.fps
    )
    assert score["joints_unseen"] == 3 * 6  # frames 14 to 19
    assert score["joints_seen"] == 3 * (20 * 25 - 15) and score["joints_no_view"] == 3 * 15
    assert score["unseen_inside_50"] == 100


def test_duplicates_phantoms_and_missed(truth, scene):
    people = noisy(truth)
    double = replace(people.rows(people.person == 0), person=np.full(20, 17))
    double = replace(double, joints=double.joints + 0.1)
    rows = Reconstruction.concatenate([people.rows(people.person != 2), double])
    score = score_tracks(rows, truth, scene.fps)
    assert (score["false_positives"], score["people_missed"]) == (20, 20)
    assert score["idf1"] == pytest.approx(4000 / 60)


def test_velocities_and_their_covariances(truth, scene):
    """The difference over two frames is exact here; 0.1 m/s of noise along each axis is found as
    that.
    """
    rng = np.random.default_rng(0)
    true = np.gradient(scene.keypoints, axis=0).reshape(-1, J, 3) * scene.fps
    covariance = np.broadcast_to(0.01 * np.eye(3), truth.covariance.shape)
    moving = replace(
        noisy(truth), velocity=true + rng.normal(0, 0.1, true.shape), velocity_covariance=covariance
    )
    score = score_tracks(moving, truth, scene.fps)
    # 3 people x 18 frames x 25 joints: standard errors of 0.0012 m/s and 0.6 %.
    assert score["velocity_error"] == pytest.approx(0.1 * np.sqrt(8 / np.pi), abs=0.005)
    assert score["velocity_inside_95"] == pytest.approx(95, abs=2.5)
    assert score["joints_velocity"] == 3 * 18 * J
    assert score_tracks(noisy(truth), truth, scene.fps)["velocity_error"] is None


def test_frames_that_the_truth_does_not_have_are_not_scored(truth, scene):
    people = noisy(truth)
    part = truth.rows((truth.frame >= 5) & (truth.frame < 10))
    score = score_tracks(people, part, scene.fps)
    assert (score["false_positives"], score["people_missed"]) == (0, 0)
    gone = part.rows((part.person != 1) | (part.frame == 9))  # nobody's column in the first frames
    assert score_tracks(people, gone, scene.fps)["false_positives"] == 4
    assert score_tracks(people.rows(people.frame < 0), truth, scene.fps)["recall"] == 0.0


def test_a_result_without_bodies():
    truth = standing([0.0, 2.0], 6)
    people = result(np.repeat(np.arange(6), 2), np.tile([0, 1], 6), truth.reshape(-1, J, 3) + 0.01)
    reference = replace(people, joints=truth.reshape(-1, J, 3))
    score = score_tracks(people, reference, FPS)
    assert score["mpjpe_mm"] == pytest.approx(10 * np.sqrt(3))
    assert score["body_mpjpe_mm"] is None
    assert score["acceleration_error"] == pytest.approx(0.0, abs=1e-9)
    nobody = score_tracks(Reconstruction.empty(), Reconstruction.empty(), FPS)
    assert nobody["people_missed"] == 0 and nobody["idf1"] is None


def test_frames_and_people_of_a_table():
    people = result([5, 5, 7], [3, 1, 3], standing([0.0, 1.0, 2.0], 1)[0])
    table = joints_by_frame(people)
    assert table.shape == (3, 2, J, 3)
    assert np.isnan(table[1]).all()
    assert table[0, :, 0, 0].tolist() == [1.0, 0.0]


def test_joints_of_bodies_are_the_scene_s_own(truth):
    np.testing.assert_allclose(body_joints(truth), truth.joints, atol=1e-5)  # float32
