"""Detections of predicted joints, joints that cannot be a person's own, and detections given out
again.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking import view_assignment
from shapepose_fg.tracking.plausibility import find_implausible
from shapepose_fg.tracking.reassociation import LEAST_PROBABILITY, reassociate
from shapepose_fg.tracking.view_assignment import Predicted, Scored, assign, assign_with_probability

WRIST, ELBOW = BODY_25.index("RWrist"), BODY_25.index("RElbow")


@njit
def _torn(places, trusted, views, longest, parents, reach, above, way, count, too_long, torn):
    for a in range(len(places)):
        find_implausible(
            places[a],
            trusted[a],
            views[a],
            longest,
            parents,
            reach,
            above,
            way,
            count,
            too_long,
            torn[a],
        )


def torn_joints(places, trusted, views, longest_m, reach_m):
    """(A, J) by `find_implausible`."""
    torn, parents = np.ones(trusted.shape, dtype=bool), np.array(BODY_25.parents)
    _torn(
        places,
        trusted,
        views,
        longest_m,
        parents,
        reach_m,
        np.empty(25, np.intp),
        *np.empty((3, 25)),
        torn,
    )
    return torn


def own(detections, rig, people, candidate):
    """Share of the detections in `candidate` (P, J, V) that are the person's own."""
    xy, _ = rig.project(people)
    right = total = 0
    for person, joint, view in np.argwhere(candidate >= 0):
        right += (
            np.linalg.norm(detections.xy[candidate[person, joint, view]] - xy[view, person, joint])
            < 1e-6
        )
        total += 1
    return right / total, total


def test_everybody_gets_their_own_detection_once(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people)
    rng = np.random.default_rng(0)
    predicted = two_people + rng.normal(0, 0.02, two_people.shape)
    sigma, lost = np.full((2, 25), 0.02), np.zeros((2, 25), dtype=bool)
    candidate = assign(
        Predicted(predicted, sigma, lost), FrameArrays.of(detections, five_cameras, BODY_25)
    )
    share, total = own(detections, five_cameras, two_people, candidate)
    assert share == 1.0 and total == 2 * 25 * 5
    taken = candidate[candidate >= 0]
    assert len(np.unique(taken)) == len(taken)


def test_a_lost_wrist_is_found_by_its_elbow(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people)
    predicted, sigma = two_people.copy(), np.full((2, 25), 0.02)
    lost = np.zeros((2, 25), dtype=bool)
    lost[:, WRIST] = True
    predicted[:, WRIST] = predicted[:, ELBOW]
    sigma[:, WRIST] = 0.3
    candidate = assign(
        Predicted(predicted, sigma, lost), FrameArrays.of(detections, five_cameras, BODY_25)
    )
    share, _ = own(detections, five_cameras, two_people, candidate)
    assert share == 1.0 and (candidate[:, WRIST] >= 0).all()


def test_nobody_gets_what_is_too_far_away(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people[:1])
    beside = two_people[:1] + np.array([0.0, 0.0, 0.4])
    predicted = Predicted(beside, np.full((1, 25), 0.02), np.zeros((1, 25), bool))
    nothing = assign(predicted, FrameArrays.of(detections, five_cameras, BODY_25))
    # 0.4 m up is farther than 0.12 + 2 x 0.02 m, but for other joints of the same kind; there are
    # none.
    assert (nothing < 0).all()


@pytest.mark.slow
def test_a_wrist_a_metre_from_its_elbow_is_torn_and_its_neighbours_are_not(two_people):
    places = two_people.copy()
    places[0, WRIST] += 1.0
    longest, views = np.full(25, 0.7), np.full((2, 25), 4)
    torn = torn_joints(places, np.ones((2, 25), bool), views, longest, 0.5)
    assert torn.sum() == 1 and torn[0, WRIST]
    # A shoulder that is off takes two bones with it: it goes, and nothing else.
    shoulder = BODY_25.index("RShoulder")
    places = two_people.copy()
    places[1, shoulder] += [0.0, 0.0, 1.0]
    torn = torn_joints(places, np.ones((2, 25), bool), views, longest, 0.5)
    assert np.argwhere(torn).tolist() == [[1, shoulder]]
    assert not torn_joints(places, np.zeros((2, 25), bool), views, longest, 0.5).any(), (
        "nothing is judged"
    )


def test_the_legs_of_somebody_else_are_torn_off(two_people):
    """They hang on nothing but a pelvis that nobody sees: they are judged by the shoulders."""
    legs = [
        BODY_25.index(f"{side}{joint}")
        for side in "LR"
        for joint in ("Hip", "Knee", "Ankle", "Heel")
    ]
    legs += [BODY_25.index(f"{side}{toe}") for side in "LR" for toe in ("BigToe", "SmallToe")]
    places = two_people.copy()
    places[0, legs] = places[1, legs] + [0.0, 6.0, 0.0]
    trusted, longest, views = np.ones((2, 25), bool), np.full(25, 0.7), np.full((2, 25), 4)
    trusted[:, BODY_25.root] = False
    torn = torn_joints(places, trusted, views, longest, 0.5)
    assert sorted(np.flatnonzero(torn[0])) == sorted(legs) and not torn[1].any()
    # So they are with a shoulder that is not judged either, or with no shoulder: by the next joint
    # that is.
    trusted[0, [BODY_25.index(joint) for joint in ("Neck", "LShoulder", "RShoulder")]] = False
    torn = torn_joints(places, trusted, views, longest, 0.5)
    assert set(legs) <= set(np.flatnonzero(torn[0])) and not torn[1].any()
    # Legs that are 0.3 m farther off than bones allow may be put right by a whole body: they stay.
    trusted[:] = True
    trusted[:, BODY_25.root] = False
    neck, hips = BODY_25.index("Neck"), [BODY_25.index(f"{side}Hip") for side in "LR"]
    for beyond_m, gone in ((0.3, 0), (0.7, 2)):
        places = two_people.copy()
        places[0, legs] -= [0.0, 0.0, 5.0]
        below = places[0, hips].mean(axis=0)
        places[0, legs] += places[0, neck] - below - [0.0, 0.0, 1.4 + beyond_m]
        assert torn_joints(places, trusted, views, longest, 0.5)[0, hips].sum() == gone


def test_detections_are_given_out_again_and_doubles_go(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people)
    given = [Input(7, np.zeros(5), detections, five_cameras)]
    double = two_people[1] + 0.05
    joints = np.stack([two_people[0], two_people[1], double])
    covariance = np.broadcast_to(0.02**2 * np.eye(3), (3, 25, 3, 3))
    none = np.full((3, 25, 5), -1)
    rows = Observations.of(none, detections, joints)
    rows = replace(
        rows, track=np.array([4, 5, 6]), frame=np.full(3, 7), time_s=np.full((3, 5), 0.5)
    )
    kept = reassociate(given, rows, joints, covariance, BODY_25)
    assert kept.track.tolist() == [4, 5, 6] and (kept.time_s == 0.5).all()
    alone = reassociate(given, rows, joints, covariance, BODY_25, LEAST_PROBABILITY)
    assert alone.track.tolist() == [4, 5]
    share, total = own(detections, five_cameras, two_people, alone.candidate)
    assert share == 1.0 and total == 250


def test_the_first_detection_of_a_frame_counts_as_any_other(five_cameras, two_people, seen_exactly):
    """Somebody of whom two views see six core joints and nothing else, the first detection among
    them.
    """
    every = seen_exactly(five_cameras, two_people[:1])
    chosen = np.isin(every.joint, list(BODY_25.core)[:6]) & (every.view < 2)
    detections = every.only(chosen)
    assert len(detections) == 12
    given = [Input(0, np.zeros(5), detections, five_cameras)]
    rows = Observations.of(np.full((1, 25, 5), -1), detections, two_people[:1])
    covariance = np.broadcast_to(0.02**2 * np.eye(3), (1, 25, 3, 3))
    for least, people in ((0.5, 1), (0.95, 0)):
        asked = given, rows, two_people[:1], covariance, BODY_25, least
        assert len(reassociate(*asked)) == people


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_nothing_is_expected_where_a_person_is_outside_of_the_picture(
    five_cameras, two_people, seen_exactly, axis, side
):
    """Three of five pictures end left, right, above or below of everybody; the other two see all
    joints.
    """
    cameras = []
    for number, camera in enumerate(five_cameras.cameras):
        K = camera.K.copy()
        K[axis, 2] += 0 if number < 2 else side * 10_000
        cameras.append(replace(camera, K=K))
    rig = replace(five_cameras, cameras=tuple(cameras))
    every = seen_exactly(rig, two_people[:1])
    detections = every.only(every.view < 2)
    rows = Observations.of(np.full((1, 25, 5), -1), detections, two_people[:1])
    covariance = np.broadcast_to(0.02**2 * np.eye(3), (1, 25, 3, 3))
    asked = [Input(0, np.zeros(5), detections, rig)], rows, two_people[:1], covariance, BODY_25
    assert len(reassociate(*asked, 0.99)) == 1


def by_enumeration(weight, slot):
    """(A, D) marginals over all ways to give D detections to A people, one a slot and one a
    detection.
    """
    people, count = weight.shape
    total, marginal = 0.0, np.zeros(weight.shape)
    for owners in itertools.product(range(-1, people), repeat=count):
        taken = {(owner, slot[d]) for d, owner in enumerate(owners) if owner >= 0}
        if len(taken) == sum(owner >= 0 for owner in owners):
            of_this = np.prod([weight[owner, d] for d, owner in enumerate(owners) if owner >= 0])
            total += of_this
            for d, owner in enumerate(owners):
                marginal[owner, d] += of_this * (owner >= 0)
    return marginal / total


def test_probabilities_are_the_marginals_of_all_ways_to_give_detections_out():
    """Two people, three wrists in one view and two in another; exact where they compete for one
    only.
    """
    nothing = np.zeros((0, 2), dtype=int)
    detections = Detections(
        np.array([0, 1, 0, 1, 0]), np.full(5, 4), np.zeros((5, 2)), np.ones(5), nothing, np.zeros(0)
    )
    score = np.random.default_rng(0).uniform(0, 1.6, (2, 5))
    possible = np.ones((2, 5), dtype=bool)
    possible[0, 2:4] = possible[1, 4] = False
    weight = np.where(possible, np.exp(5 * (score - 0.45)), 0.0)
    expected = by_enumeration(weight, detections.view)

    def found(score, possible, view):
        """(A, D) of `probabilities`, which wants what is possible sorted by view."""
        order = np.argsort(view, kind="stable")
        person, place = np.nonzero(np.ones_like(score))
        by_view = np.lexsort((person, view[order[place]]))
        person, detection = person[by_view], order[place[by_view]]
        first = np.searchsorted(view[detection], np.arange(3))
        near = first, person, detection, np.zeros(len(person))
        given = Scored(*near, score[person, detection], possible[person, detection])
        probable = np.zeros(score.shape)
        probable[person, detection] = view_assignment.probabilities(given, len(view))
        return probable

    view = detections.view
    both = found(score, possible, view)
    np.testing.assert_allclose(both[:, [1, 3]], expected[:, [1, 3]], atol=1e-9)
    np.testing.assert_allclose(
        both, expected, atol=0.15
    )  # both can have wrist 0 and both wrist 4: a cycle
    np.testing.assert_allclose(
        found(score[:1], possible[:1], view), by_enumeration(weight[:1], view), atol=1e-12
    )
    order = np.array([3, 0, 4, 1, 2])
    again = found(score[::-1][:, order], possible[::-1][:, order], view[order])
    np.testing.assert_allclose(again[::-1], both[:, order], atol=1e-12)


def test_two_people_side_by_side_are_less_certain_than_one_alone(
    five_cameras, two_people, seen_exactly
):
    """Joints 4 cm apart, and no affinities: either may have either. A metre apart each is
    somebody's.
    """
    median = []
    for apart in (0.04, 1.0):
        people = np.stack([two_people[0], two_people[0] + [0, apart, 0]])
        seen = seen_exactly(five_cameras, people)
        detections = replace(seen, pairs=np.zeros((0, 2), dtype=int), affinity=np.zeros(0))
        sigma, lost = np.full((2, 25), 0.02), np.zeros((2, 25), dtype=bool)
        chosen, probability = assign_with_probability(
            Predicted(people, sigma, lost), FrameArrays.of(detections, five_cameras, BODY_25)
        )
        assert (chosen >= 0).all()
        median.append(np.median(probability))
    assert median[0] < 0.85 < 0.92 < median[1], median
