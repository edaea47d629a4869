"""Limbs keep their length where views leave an end open."""

import numpy as np

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.limbs import limb_lengths, limbs_of, with_lengths

SHOULDER, ELBOW, WRIST = (BODY_25.index(name) for name in ("RShoulder", "RElbow", "RWrist"))
LIMBS = limbs_of(BODY_25.joints)
SURE, OPEN = 1e-4 * np.eye(3), 0.25 * np.eye(3)


def arm(elbow, wrist):
    """A person (1, 25, 3) with a right arm, elbow and wrist uncertain by 50 cm; and which joints
    may move.
    """
    joints = np.full((1, 25, 3), np.nan)
    joints[0, [SHOULDER, ELBOW, WRIST]] = [0.0, 0.0, 1.4], elbow, wrist
    covariance = np.tile(SURE, (1, 25, 1, 1))
    covariance[0, [ELBOW, WRIST]] = OPEN
    moved = np.zeros((1, 25), dtype=bool)
    moved[0, [ELBOW, WRIST]] = True
    return joints, covariance, moved


def lengths(upper: float, lower: float):
    known = {(SHOULDER, ELBOW): upper, (ELBOW, WRIST): lower}
    return np.array([known.get(limb, np.nan) for limb in LIMBS])


def test_the_limbs_are_those_that_the_detector_has():
    names = {(BODY_25.joints[a], BODY_25.joints[b]) for a, b in LIMBS}
    assert ("RElbow", "RWrist") in names and ("LHip", "LKnee") in names and len(LIMBS) == 14
    assert limbs_of(("LElbow", "LWrist", "Nose")) == [(0, 1)] and limbs_of(()) == []


def test_the_length_is_the_body_s_over_all_frames():
    body = np.zeros((5, 25, 3))
    body[:, WRIST, 0] = [0.25, 0.26, 0.24, 0.25, np.nan]
    found = dict(zip(LIMBS, limb_lengths(body, LIMBS), strict=True))
    assert found[ELBOW, WRIST] == 0.25 and found[SHOULDER, ELBOW] == 0.0
    assert np.isnan(limb_lengths(np.full((3, 25, 3), np.nan), LIMBS)).all()


def test_a_torn_arm_comes_together_and_what_is_known_stays():
    """The forearm is 70 cm long and should be 25: nine tenths of what is too much goes, the
    shoulder stays.
    """
    joints, covariance, moved = arm([0.0, 0.0, 1.1], [0.0, 0.7, 1.1])
    done = with_lengths(joints, covariance, moved, lengths(0.3, 0.25), LIMBS)[0]
    assert abs(np.linalg.norm(done[WRIST] - done[ELBOW]) - 0.25) < 0.045
    assert abs(np.linalg.norm(done[ELBOW] - done[SHOULDER]) - 0.3) < 0.045
    np.testing.assert_array_equal(done[SHOULDER], joints[0, SHOULDER])
    assert np.isnan(done[0]).all(), "a joint that is not known stays so"


def test_a_joint_on_a_ray_moves_along_it():
    """The wrist is known but for its depth, along y: it goes there, and only there."""
    joints, covariance, moved = arm([0.0, 0.0, 1.1], [0.15, 0.6, 1.1])
    covariance[0, ELBOW], covariance[0, WRIST] = SURE, np.diag([1e-4, 0.25, 1e-4])
    moved[0, ELBOW] = False
    step = (with_lengths(joints, covariance, moved, lengths(0.3, 0.25), LIMBS) - joints)[0, WRIST]
    assert step[1] < -0.3 and abs(step[[0, 2]]).max() < 0.002


def test_what_views_determine_is_not_touched():
    joints, covariance, moved = arm([0.0, 0.0, 1.1], [0.0, 0.7, 1.1])
    still = with_lengths(joints, covariance, np.zeros_like(moved), lengths(0.3, 0.25), LIMBS)
    np.testing.assert_array_equal(still, joints)
