"""Detections of predicted joints on a crowded frame, against what they are defined to be, one thing
at a time.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal import nearby
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking import view_assignment
from shapepose_fg.tracking.reassociation import (
    LEAST_PROBABILITY,
    people_to_remove,
    probabilities_of,
    reassociate,
)
from shapepose_fg.tracking.view_assignment import Predicted, assign

CORE = list(BODY_25.core)
LIMBS = {tuple(sorted(limb)) for limb in BODY_25.limbs}
SWINGS = {BODY_25.index(side + name) for side in "RL" for name in (
    "Elbow", "Wrist", "Knee", "Ankle", "BigToe", "SmallToe", "Heel", "Ear"
)}  # fmt: skip


@pytest.fixture(scope="module")
def predicted(two_people):
    """Where the four people of the crowded frame are thought to be, how surely, and which joints
    are lost.
    """
    rng = np.random.default_rng(2)
    people = np.concatenate([two_people, two_people[::-1] + np.array([0.1, 0.5, 0.0])])
    sigma = rng.uniform(0.01, 0.2, (4, 25))
    lost = rng.random((4, 25)) < 0.2
    places = people + rng.normal(0, 0.04, people.shape)
    for person, joint in np.argwhere(lost).tolist():
        places[person, joint] = people[person, max(BODY_25.parents[joint], 0)]
    places[3, 4] = np.nan
    return Predicted(places, sigma, lost)


DEFAULTS = {
    "near_m": 0.06,
    "far_m": 0.12,
    "farthest_m": 0.5,
    "least_affinity": 0.3,
    "reach_m": 0.8,
    "overlap_m": 0.025,
    "passes": 2,
    "trunk_joints": 2,
}
"""What is documented, so that another default is noticed."""


@pytest.fixture
def settle(monkeypatch):
    """Sets constants by the names that they have in `DEFAULTS`."""

    def settle(**settings):
        kernels = [(view_assignment, name) for name in ("_assign", "claim", "share")]
        for module, name in [*kernels, (nearby, "_together")]:
            # As Python runs it: constants are compiled in.
            monkeypatch.setattr(
                module, name, getattr(getattr(module, name), "py_func", getattr(module, name))
            )
        for name, value in settings.items():
            for module in (view_assignment, nearby):
                for constant in (name.upper(), f"_{name.upper()}"):
                    if hasattr(module, constant):
                        monkeypatch.setattr(module, constant, value)

    return settle


def assigned(predicted: Predicted, crowded, rig, config: SimpleNamespace) -> np.ndarray:
    """Score every detection for every person, take the best first; again with the affinities to
    what was taken.
    """
    places, sigma, lost = predicted.places, predicted.sigma_m, predicted.lost
    xy, depth = rig.project(places)
    listed = {
        tuple(pair): value
        for pair, value in zip(crowded.pairs.tolist(), crowded.affinity, strict=True)
    }
    near = [
        [
            other
            for other in np.flatnonzero(crowded.view == crowded.view[row]).tolist()
            if tuple(sorted((int(crowded.joint[row]), int(crowded.joint[other])))) in LIMBS
        ]
        for row in range(len(crowded))
    ]
    owned: list[set[int]] = [set() for _ in places]
    chosen = np.full((*lost.shape, len(rig)), -1)
    for _ in range(1 + config.passes):
        offers, shared, before = [], [], chosen.copy()
        for person in range(len(places)):
            for row in range(len(crowded)):
                view, joint = int(crowded.view[row]), int(crowded.joint[row])
                px = float(np.linalg.norm(xy[view, person, joint] - crowded.xy[row]))
                metres = px * depth[view, person, joint] / rig.focal_px[view]
                mine = [other for other in near[row] if other in owned[person]]
                joints = {int(crowded.joint[other]) for other in mine}
                total = sum(
                    listed.get((row, other), listed.get((other, row), 0.0)) for other in mine
                )
                affinity = total / max(len(joints), 1)
                if np.isnan(px):
                    px = metres = np.inf
                sure = sigma[person, joint]
                gate = min(config.far_m + 2 * sure, config.farthest_m)
                near_enough = lost[person, joint] or metres < gate
                score = (
                    np.exp(-0.5 * metres**2 / (config.near_m**2 + sure**2)) if near_enough else 0.0
                )
                score += affinity if joints else config.least_affinity
                trunk = sum(
                    j not in SWINGS for j in np.flatnonzero(before[person, :, view] >= 0).tolist()
                )
                free = lost[person, joint] or (joint in SWINGS and trunk >= config.trunk_joints)
                within = config.reach_m if free else gate
                if lost[person, joint]:
                    likely = bool(joints) and affinity >= config.least_affinity
                else:
                    likely = score >= 2 * config.least_affinity
                if metres < within and likely:
                    offers.append((score, person, row))
                if metres < config.overlap_m and affinity >= config.least_affinity:
                    shared.append((metres, person, row))
        chosen[:], used = -1, set()
        for _, person, row in sorted(offers, key=lambda offer: -offer[0]):
            slot = person, int(crowded.joint[row]), int(crowded.view[row])
            if chosen[slot] < 0 and row not in used:
                chosen[slot] = row
                used.add(row)
        owned = [set(each[each >= 0].tolist()) for each in chosen]
    empty = chosen < 0
    for _, person, row in sorted(shared, key=lambda each: -each[0]):
        slot = person, int(crowded.joint[row]), int(crowded.view[row])
        if empty[slot]:
            chosen[slot] = row
    return chosen


@pytest.mark.parametrize(
    "settings", [{}, {"passes": 1, "overlap_m": 0.3, "reach_m": 0.4}, {"least_affinity": 0.1}]
)
def test_detections_are_taken_best_first_by_nearness_and_affinity(
    settings, predicted, crowded, five_cameras, settle
):
    expected = assigned(predicted, crowded, five_cameras, SimpleNamespace(**DEFAULTS | settings))
    settle(**settings)
    arrays = FrameArrays.of(crowded, five_cameras, BODY_25)
    found = assign(predicted, arrays)
    np.testing.assert_array_equal(found, expected)
    assert (found >= 0).mean() > 0.5 and (found[predicted.lost] >= 0).any(), (
        "lost joints are found, too"
    )
    settle(overlap_m=0.005)
    assert (
        assign(predicted, FrameArrays.of(crowded, five_cameras, BODY_25)) != found
    ).any() or "overlap_m" not in settings


def test_a_detection_that_serves_two_is_theirs_with_a_probability_of_one_at_most(
    predicted, crowded, five_cameras, monkeypatch, settle
):
    """Marginals of competitors that form a cycle are not exact: those of one detection may add up
    to more.
    """
    monkeypatch.setattr(
        view_assignment, "probabilities", lambda scored, _: np.full(len(scored.score), 0.6)
    )
    settle(passes=1, overlap_m=0.6, farthest_m=0.6)
    arrays = FrameArrays.of(crowded, five_cameras, BODY_25)
    chosen, probability = view_assignment.assign_with_probability(predicted, arrays)
    owners = np.bincount(chosen[chosen >= 0], minlength=len(crowded))
    assert (owners > 1).any(), "overlaps happen here"
    expected = np.where(owners[chosen] > 1, 1.0, 0.6)
    np.testing.assert_array_equal(probability, np.where(chosen >= 0, expected, 0.0))


@pytest.fixture
def three(five_cameras, two_people, seen_exactly):
    """A frame, and all detections of two people; a third is 15 cm beside the first and has none."""
    detections = seen_exactly(five_cameras, two_people)
    places = np.stack([*two_people, two_people[0] + [0.15, 0.0, 0.0]])
    candidate = np.full((3, 25, 5), -1)
    sure = np.full((2, 25), 0.02), np.zeros((2, 25), dtype=bool)
    candidate[:2] = assign(
        Predicted(two_people, *sure), FrameArrays.of(detections, five_cameras, BODY_25)
    )
    return Input(0, np.zeros(5), detections, five_cameras), candidate, places


def test_who_has_too_little_or_is_a_double_goes(three):
    frame, candidate, places = three

    def gone(candidate, places, *asked):
        return people_to_remove(
            probabilities_of(frame, candidate, places, BODY_25), places, BODY_25, *asked
        )

    assert gone(candidate, places, 0.0).tolist() == [False, False, True], "a double"
    assert not gone(candidate, places, 0.0, 0.14).any()
    assert gone(candidate, places, 0.5, 0.14).tolist() == [False, False, True]
    # Joints that one view sees are next to nothing.
    few = candidate.copy()
    few[1, :, 1:] = -1
    assert gone(few[:2], places[:2], LEAST_PROBABILITY).tolist() == [False, True]
    # Of two that have equally much the later one goes; who is not placed is nobody's double.
    equal = np.stack([candidate[0], candidate[1], candidate[0]])
    assert gone(equal, places, 0.0).tolist() == [False, False, True]
    lost = places.copy()
    lost[2] = np.nan
    assert not gone(candidate, lost, 0.0).any()
    part = places.copy()
    part[2, CORE[:10]] = np.nan  # the distance is of the joints that both have
    assert gone(candidate, part, 0.0).tolist() == [False, False, True]


def test_rows_without_a_joint_are_carried_by_motion_unless_they_must_survive(three, two_people):
    """A third row whose joints are not known at all: kept without detections, or gone."""
    frame, _, _ = three
    joints = np.stack([*two_people, np.full((25, 3), np.nan)])
    rows = Observations.of(np.full((3, 25, 5), -1), frame.detections, joints)
    rows = replace(rows, track=np.array([4, 5, 6]), frame=np.zeros(3, dtype=int))
    covariance = np.where(np.isnan(joints)[..., None], np.nan, 0.02**2 * np.eye(3))
    kept = reassociate([frame], rows, joints, covariance, BODY_25)
    assert kept.track.tolist() == [4, 5, 6] and not kept.seen[2].any() and kept.seen[:2].all()
    left = reassociate([frame], rows, joints, covariance, BODY_25, LEAST_PROBABILITY)
    assert left.track.tolist() == [4, 5]


@pytest.mark.parametrize(
    ("away_m", "tied", "taken"),
    [
        (0.4, True, True),
        (0.78, True, True),
        (0.82, True, False),
        (0.04, False, True),
        (0.15, False, False),
    ],
)
def test_what_is_tied_to_the_elbow_is_the_wrist_wherever_it_was_predicted(
    five_cameras, two_people, seen_exactly, away_m, tied, taken
):
    """A wrist that strikes is far from where it was predicted; without affinities it must be
    near.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    wrist = BODY_25.index("RWrist")
    of_wrist = (detections.joint[detections.pairs] == wrist).any(axis=1)
    detections = replace(
        detections, affinity=np.where(of_wrist & (not tied), 0.0, detections.affinity)
    )
    right = five_cameras.cTw[
        0, 0, :3
    ]  # to the right in the first picture: there it is as long as it is
    predicted = two_people[:1].copy()
    predicted[0, wrist] += away_m * right
    sigma, lost = np.full((1, 25), 1e-6), np.zeros((1, 25), dtype=bool)
    found = assign(
        Predicted(predicted, sigma, lost), FrameArrays.of(detections, five_cameras, BODY_25)
    )
    assert (found[0, wrist, 0] >= 0) == taken
    assert (np.delete(found, wrist, axis=1) >= 0).all()


def test_somebody_alone_in_a_frame_may_be_nobody(five_cameras, two_people, seen_exactly):
    """Two metres beside the only one who is seen."""
    detections = seen_exactly(five_cameras, two_people[:1])
    frame = Input(0, np.zeros(5), detections, five_cameras)
    joints = two_people[:1] + np.array([0.0, 2.0, 0.0])
    rows = replace(
        Observations.of(np.full((1, 25, 5), -1), detections, joints),
        track=np.array([4]),
        frame=np.zeros(1, dtype=int),
    )
    covariance = np.broadcast_to(0.02**2 * np.eye(3), (1, 25, 3, 3))
    asked = [frame], rows, joints, covariance, BODY_25
    assert len(reassociate(*asked)) == 1 and len(reassociate(*asked, LEAST_PROBABILITY)) == 0
