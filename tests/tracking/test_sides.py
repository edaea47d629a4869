"""Left and right exchanged by a detector in some views: put right by where people are predicted."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.tracking.sides import with_sides_held

MIRROR = np.array(BODY_25.mirror)
NEAR_M = 0.03


@pytest.fixture
def seen(five_cameras, two_people, seen_exactly) -> Detections:
    return seen_exactly(five_cameras, two_people)


def person_of(found: Detections, rig, people) -> np.ndarray:
    """(D,) whose each detection is."""
    xy, _ = rig.project(people)
    apart = np.linalg.norm(xy[found.view, :, found.joint] - found.xy[:, None], axis=-1)
    return apart.argmin(axis=1)


def held(found, rig, people, sigma_m=NEAR_M):
    return with_sides_held(found, people, np.full(people.shape[:2], sigma_m), rig, BODY_25)


def test_what_is_right_stays(seen, five_cameras, two_people):
    assert held(seen, five_cameras, two_people) is seen
    assert held(seen, five_cameras, two_people[:0]) is seen


@pytest.mark.parametrize("views", [[1], [0, 3], [0, 1, 2, 4]])
def test_a_person_whose_sides_are_exchanged_in_some_views(seen, five_cameras, two_people, views):
    """Predicted 5 cm off; the other person is as they are."""
    wrong = np.isin(seen.view, views) & (person_of(seen, five_cameras, two_people) == 1)
    turned = replace(seen, joint=np.where(wrong, MIRROR[seen.joint], seen.joint))
    again = held(turned, five_cameras, two_people + np.array([0.03, 0.03, 0.02]))
    np.testing.assert_array_equal(again.joint, seen.joint)
    assert len(again.pairs) == len(seen.pairs)


def test_what_all_views_say_is_so(seen, five_cameras, two_people):
    """A person who was followed the wrong way round is not followed so for ever."""
    turned = replace(seen, joint=MIRROR[seen.joint])
    assert held(turned, five_cameras, two_people) is turned


def test_somebody_else_who_faces_the_other_way_stays_as_they_are(five_cameras, two_people, seen_exactly):
    """Of two people only one is followed; the other stands half a metre away, turned round."""
    about = two_people[0, 8]
    other = two_people[0].copy()
    other[:, :2] = 2 * about[:2] - other[:, :2]
    other[:, :2] += 0.5
    found = seen_exactly(five_cameras, np.stack([two_people[0], other]))
    assert held(found, five_cameras, two_people[:1]) is found


@pytest.mark.parametrize(
    "joints", [("Shoulder", "Elbow", "Wrist"), ("Hip", "Knee", "Ankle", "BigToe", "SmallToe", "Heel")]
)
def test_arms_or_legs_that_are_exchanged_alone(seen, five_cameras, two_people, joints):
    of = np.isin(seen.joint, [BODY_25.joints.index(side + name) for side in "RL" for name in joints])
    wrong = of & np.isin(seen.view, [1, 3, 4]) & (person_of(seen, five_cameras, two_people) == 0)
    turned = replace(seen, joint=np.where(wrong, MIRROR[seen.joint], seen.joint))
    again = held(turned, five_cameras, two_people + np.array([0.02, 0.02, 0.01]))
    sides = MIRROR[seen.joint] != seen.joint
    assert (again.joint == seen.joint)[sides].mean() > 0.98
    assert (again.joint == seen.joint)[wrong].mean() > 0.95
