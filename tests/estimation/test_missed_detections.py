"""A detector that reports nothing where a joint is in plain view: counted by hand in a room with
four cameras.
"""

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.missed_detections import (
    ELSEWHERE_M,
    MISSED,
    UNUSUAL,
    elsewhere_variance,
    limbs_that_hide,
)

WRIST = BODY_25.index("RWrist")


def variance(rig, people, strong):
    frame = np.zeros(len(people), dtype=int)
    return elsewhere_variance(people, frame, strong, Views.of(rig), limbs_that_hide(BODY_25.joints))


def raised(two_people):
    """The first person with the right arm stretched out to the side, high: no limb is before the
    wrist.
    """
    person = two_people[:1].copy()
    away = person[0, BODY_25.index("RShoulder")] - person[0, BODY_25.index("LShoulder")]
    person[0, BODY_25.index("RElbow")] = (
        person[0, BODY_25.index("RShoulder")] + 0.3 * away / 0.36 + [0, 0, 0.3]
    )
    person[0, WRIST] = person[0, BODY_25.index("RElbow")] + [0, 0, 0.3]
    return person


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_a_wrist_that_nobody_reports_is_elsewhere_the_likelier_the_more_views_look(
    five_cameras, two_people, count
):
    rig = Rig(five_cameras.cameras[:count], five_cameras.up)
    strong = np.ones((1, 25, count), dtype=bool)
    strong[:, WRIST] = False
    found = variance(rig, raised(two_people), strong)
    unusual = UNUSUAL / (UNUSUAL + MISSED**count) if count >= 3 else 0.0
    assert found[0, WRIST] == pytest.approx(unusual * ELSEWHERE_M**2)
    assert not np.delete(found, WRIST, axis=1).any(), "what one view reports is where it reports it"


def test_a_wrist_behind_somebody_is_hidden_and_one_outside_the_picture_is_not_looked_at(
    five_cameras, two_people
):
    """A second person halfway to a camera takes it away; so does a step out of its picture."""
    rig, person = Rig(five_cameras.cameras[:3], five_cameras.up), raised(two_people)
    strong = np.ones((1, 25, 3), dtype=bool)
    strong[:, WRIST] = False
    assert variance(rig, person, strong)[0, WRIST] > 0
    centre = five_cameras.centres[1]
    chest = person[0, [BODY_25.index("Neck"), BODY_25.index("MidHip")]].mean(axis=0)
    other = person + 0.5 * (centre - person[0, WRIST]) + (person[0, WRIST] - chest)
    both = np.concatenate([person, other])
    assert variance(rig, both, np.concatenate([strong, np.ones_like(strong)]))[0, WRIST] == 0
    assert variance(rig, person + np.array([30.0, 0, 0]), strong)[0, WRIST] == 0
