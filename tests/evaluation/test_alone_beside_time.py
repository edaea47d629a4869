"""Frames alone beside the same frames over time."""

from dataclasses import replace

import numpy as np

from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.alone_beside_time import beside

WRIST, ANKLE, NOSE = (BODY_25.joints.index(name) for name in ("RWrist", "LAnkle", "Nose"))


def three_people() -> Reconstruction:
    """Three frames of three people who stand two metres apart; everything is seen but the second's nose."""
    rng = np.random.default_rng(0)
    frame, person = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    joints = rng.normal(0, 0.3, (9, 25, 3)) + 2.0 * person[:, None, None]
    known = np.full((9, 25), Known.SEEN)
    known[person == 1, NOSE] = Known.MOTION
    covariance = np.tile(1e-4 * np.eye(3), (9, 25, 1, 1))
    return Reconstruction(
        frame=frame,
        person=person,
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=covariance,
        confidence=np.ones((9, 25)),
        betas=np.zeros((9, 10)),
        global_orient=np.zeros((9, 3)),
        body_pose=np.zeros((9, 23, 3)),
        transl=np.zeros((9, 3)),
        status=np.full(9, "ok"),
        time_s=frame / 25,
        velocity=np.zeros((9, 25, 3)),
        velocity_covariance=covariance,
        known=known,
        run={},
    )


def test_what_is_elsewhere_is_counted_joint_by_joint():
    """In other order, one wrist 16 cm away and one 14, an ankle without a place, a nose that time does not see."""
    timed = three_people()
    order = np.array([2, 0, 1, 5, 4, 3, 6, 8, 7])
    joints = timed.joints.copy()
    joints[0, WRIST, 0] += 0.16
    joints[1, WRIST, 0] += 0.14
    joints[8, ANKLE] = np.nan
    joints[4, NOSE] += 1.0
    found = beside(replace(timed, joints=joints).rows(order), timed)
    assert found.apart.sum() == 2 and found.apart[WRIST] == 1 and found.apart[ANKLE] == 1
    assert found.seen.tolist() == [9 - 3 * (joint == NOSE) for joint in range(25)]
    assert found.missing == 0
    np.testing.assert_allclose(found.share, 2 / (9 * 25 - 3))


def test_people_who_are_not_there_or_elsewhere_are_missing():
    timed = three_people()
    joints = timed.joints.copy()
    joints[3] += 1.0  # he is nobody whom time knows
    found = beside(replace(timed, joints=joints).rows(np.array([0, 3, 4, 5])), timed)
    assert found.missing == 2 + 1 + 3
    assert found.apart.sum() == 0 and found.seen[WRIST] == 3
    nobody = beside(timed.rows(np.zeros(0, dtype=int)), timed)
    assert nobody.missing == 9 and nobody.share == 0.0
