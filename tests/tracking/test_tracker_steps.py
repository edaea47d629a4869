"""The steps of following people, each with numbers that can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from factors import CONSTANT_VELOCITY
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.tracking.motion_filter import Bones, JointStates, predicted
from shapepose_fg.tracking.tracker import Tracks, mean_distance

CORE = list(BODY_25.core)
HIP, SHOULDER, ELBOW, WRIST = (
    BODY_25.index(name) for name in ("MidHip", "RShoulder", "RElbow", "RWrist")
)


def tracks_at(places, sigma_m=0.02, **known) -> Tracks:
    """Tracks 0, 1, ... of one world at `places` (A, 25, 3) at 10 s, with evidence, unless `known`
    says so.
    """
    count = len(places)
    joints = JointStates.at(np.asarray(places, dtype=float), np.full((count, 25), sigma_m), (0.1,))
    start = Tracks(10.0, np.arange(count), np.zeros(count, dtype=int), joints, np.full(count, 10.0))
    return replace(start, **known)


def moving(places, sigma_m, velocity) -> JointStates:
    """People's joints at `places` (A, 25, 3), of a velocity that is known to 0.1 m/s."""
    joints = JointStates.at(places, sigma_m, (0.1,))
    return replace(joints, mean=np.concatenate([places, velocity], axis=-1))


def ahead(joints, step_s, density=10.0):
    """`predicted`, with bones of 0.7 m."""
    return predicted(
        joints, step_s, CONSTANT_VELOCITY, np.full(25, density), Bones.of(BODY_25, np.full(25, 0.7))
    )


def test_an_unseen_joint_comes_to_move_as_the_person_does(two_people):
    """After a quarter of a second 1/e is left of how its velocity differs from the person's: the
    mean of the core joints, weighted by how surely their places are known; and at rest, as surely
    as 10 cm.
    """
    rng = np.random.default_rng(0)
    sigma = np.where(np.arange(25) == WRIST, 0.06, rng.uniform(0.01, 0.05, (1, 25)))
    velocity = rng.normal(0, 1, (1, 25, 3))
    before = moving(two_people[:1], sigma, velocity)
    after, _ = ahead(before, 0.25)
    certainty = sigma[0, CORE] ** -2.0
    person = certainty @ velocity[0, CORE] / (certainty.sum() + 0.1**-2)
    expected = velocity.copy()
    expected[0, WRIST] = person + (velocity[0, WRIST] - person) / np.e
    np.testing.assert_allclose(after.velocity, expected)
    np.testing.assert_allclose(after.position, two_people[:1] + 0.25 * expected)
    back, _ = ahead(before, -0.25)
    np.testing.assert_allclose(back.position, two_people[:1] - 0.25 * expected)


def test_a_lost_joint_is_sought_around_its_parent_and_a_lost_root_between_the_hips(two_people):
    """Bones are 0.7 m at the longest: on each axis 0.7 / 1.5 m, for each bone on the way. Lost is
    what was not known to 10 cm, and is not to 20.
    """
    lost = np.zeros((2, 25), dtype=bool)
    lost[0, [ELBOW, WRIST]] = lost[1, HIP] = True
    velocity = np.random.default_rng(0).normal(0, 1, (2, 25, 3))
    joints = moving(two_people, np.where(lost, 0.3, 0.02), velocity)
    found, gone = ahead(joints, 1e-9, density=0.0)
    np.testing.assert_array_equal(gone, lost)
    np.testing.assert_allclose(
        found.mean[0, [ELBOW, WRIST]], joints.mean[0, [SHOULDER, SHOULDER]], atol=1e-8
    )
    reach = 0.7 / 1.5
    for joint, bones in ((ELBOW, 1), (WRIST, 2)):
        expected = np.diag([0.02**2 + bones * reach**2] * 3 + [0.1**2 + bones] * 3)
        np.testing.assert_allclose(found.covariance[0, joint], expected, atol=1e-8)
    hips = list(BODY_25.hips)
    np.testing.assert_allclose(found.mean[1, HIP], joints.mean[1, hips].mean(axis=0), atol=1e-8)
    others = ~lost
    np.testing.assert_allclose(found.mean[others], joints.mean[others], atol=1e-8)
    np.testing.assert_allclose(found.covariance[others], joints.covariance[others], atol=1e-8)
    # Somebody of whom nothing is placed has nothing beside which joints were to be sought; nor is
    # lost who was known to 10 cm.
    assert not ahead(moving(two_people, np.full((2, 25), 0.3), velocity), 0.04)[1].any()
    assert not ahead(moving(two_people, np.where(lost, 0.09, 0.02), velocity), 0.5)[1].any()


@pytest.mark.parametrize(
    ("core", "views", "evident"), [(4, 2, True), (3, 2, False), (9, 1, True), (8, 1, False)]
)
def test_evidence_is_core_joints_that_two_views_see_or_most_that_one_does(
    tracker, five_cameras, two_people, seen_exactly, core, views, evident
):
    """Four that two views see, or nine of one view; others count nothing."""
    seen = seen_exactly(five_cameras, two_people[:1])
    chosen = np.isin(seen.joint, CORE[:core]) & (seen.view < views)
    others = ~np.isin(seen.joint, CORE) & (seen.view < views)
    after, _ = tracker.step(
        tracks_at(two_people[:1]), seen.only(chosen | others), five_cameras, 10.03
    )
    assert (after.evident_s[0] == 10.03) == evident


def lists(joints: list[int], views: list[int]) -> Detections:
    count = len(joints)
    none = np.zeros((0, 2), dtype=np.intp)
    return Detections(
        np.array(views), np.array(joints), np.zeros((count, 2)), np.ones(count), none, np.zeros(0)
    )


def test_four_core_joints_that_two_views_see_may_be_somebody(tracker):
    four = lists(CORE[:4] * 2, [0] * 4 + [3] * 4)
    every = np.ones(8, dtype=bool)
    assert tracker.enough(four, every)
    one_taken = every.copy()
    one_taken[2] = False
    assert not tracker.enough(four, one_taken)
    assert not tracker.enough(lists(CORE[:4] * 2, [0] * 7 + [3]), every), (
        "twice in one view is one view"
    )
    others = [j for j in range(25) if j not in CORE][:4]
    assert not tracker.enough(lists(others * 2, [0] * 4 + [3] * 4), every)


@pytest.mark.parametrize(("beside_m", "apart"), [(0.24, False), (0.26, True)])
def test_a_new_person_stands_apart_from_all_tracks(two_people, beside_m, apart):
    new = two_people[:1] + np.array([0.0, beside_m, 0.0])
    new[0, WRIST:] = np.nan  # joints that are not placed count nothing
    assert (mean_distance(new, two_people) > 0.25).all() == apart
    assert mean_distance(new, two_people[1:]) > 0.25
    assert mean_distance(new, two_people[:0]).shape == (1, 0)


def test_new_joints_are_known_to_4_cm_and_unplaced_ones_are_lost(tracker, two_people):
    places = two_people[:1].copy()
    places[0, WRIST] = np.nan
    new = tracker.at(places, np.array([7]), np.array([3]), 10.0)
    np.testing.assert_allclose(new.joints.sigma_m[0], np.where(np.arange(25) == WRIST, 0.4, 0.04))
    np.testing.assert_allclose(new.joints.position[0, WRIST], np.nanmean(places[0], axis=0))
    np.testing.assert_allclose(
        np.diagonal(new.joints.covariance[0], axis1=1, axis2=2)[:, 3:], 2.0**2
    )
    assert (new.joints.velocity[0] == 0).all()
    assert (new.ids.tolist(), new.global_hypothesis.tolist(), new.evident_s.tolist()) == (
        [7],
        [3],
        [10.0],
    )


@pytest.mark.parametrize("fps", [10, 30, 60])
def test_a_newborn_keeps_its_joints_at_any_rate(
    tracker, five_cameras, two_people, seen_exactly, fps
):
    """2 m/s of unknown speed are 20 cm after 0.1 s, from where on joints count as lost and affinity
    alone finds them. Here there are no affinities: what was placed to 4 cm is sought where it is
    expected.
    """
    detections = seen_exactly(five_cameras, two_people)
    detections = replace(detections, pairs=np.zeros((0, 2), dtype=np.intp), affinity=np.zeros(0))
    zero = np.zeros(2, dtype=int)
    new = tracker.at(two_people, np.arange(2), zero, 0.0)
    after, candidate = tracker.step(new, detections, five_cameras, 1 / fps)
    assert (candidate >= 0).mean() > 0.95 and (after.joints.sigma_m < 0.03).all()
    np.testing.assert_allclose(after.joints.position, two_people, atol=0.01)


@pytest.mark.parametrize("direction", [1, -1])
def test_tracks_live_for_half_a_second_without_evidence(tracker, two_people, direction):
    waited = np.array([0.49, 0.51])
    state = tracks_at(two_people, evident_s=10.0 - direction * waited)
    assert tracker.alive(state).tolist() == [True, False]


def test_evidence_is_dated_and_a_frame_without_it_is_not(
    tracker, five_cameras, two_people, seen_exactly
):
    state = tracks_at(two_people)
    after, candidate = tracker.step(
        state, seen_exactly(five_cameras, two_people[1:]), five_cameras, 9.9
    )
    assert (
        after.time_s == 9.9
        and after.evident_s.tolist() == [10.0, 9.9]
        and after.ids.tolist() == [0, 1]
    )
    assert (candidate[0] < 0).all() and (candidate[1] >= 0).all()


def test_worlds_do_not_compete_for_detections(tracker, five_cameras, two_people, seen_exactly):
    """Two stand 8 cm apart where one person is seen: in one world one of them has the detections,
    in two both.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    places = np.stack([two_people[0], two_people[0] + [0.08, 0.0, 0.0]])
    _, apart = tracker.step(
        tracks_at(places, global_hypothesis=np.array([0, 1])), detections, five_cameras, 10.03
    )
    assert (apart >= 0).all() and (apart[0] == apart[1]).all()
    _, together = tracker.step(tracks_at(places), detections, five_cameras, 10.03)
    assert (together[0] >= 0).mean() > 0.9 and (together[1] >= 0).mean() < 0.5
    alone = [tracker.step(tracks_at(places[[n]]), detections, five_cameras, 10.03) for n in (0, 1)]
    for n, (_, candidate) in enumerate(alone):
        np.testing.assert_array_equal(candidate[0], apart[n])


def test_who_is_lost_entirely_is_sought_where_expected(
    tracker, five_cameras, two_people, seen_exactly
):
    """After 0.4 s all joints are uncertain by 0.4 m, and none has a neighbour with detections."""
    detections = seen_exactly(five_cameras, two_people)
    moved = two_people - [0.1, 0.0, 0.0]
    _, candidate = tracker.step(tracks_at(moved, sigma_m=0.4), detections, five_cameras, 10.03)
    assert (candidate >= 0).mean() > 0.95
    xy, _ = five_cameras.project(two_people)
    for person in (0, 1):
        joint, view = np.nonzero(candidate[person] >= 0)
        off = detections.xy[candidate[person, joint, view]] - xy[view, person, joint]
        assert (np.linalg.norm(off, axis=1) < 1e-6).mean() > 0.95


def test_hips_that_two_views_saw_are_asked_for_last(
    tracker, five_cameras, two_people, seen_exactly
):
    """Stage I is asked for weak hips among what is left, and not at all where that is too
    little.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    asked = []

    def sure(left, rig):
        asked.append((len(left), "sure"))
        return tracker.find[0](left, rig).rows(np.zeros(0, dtype=int))

    def weak(left, rig):
        asked.append((len(left), "weak"))
        return tracker.find[0](left, rig)

    none, searching = np.zeros((0, 25, 5), dtype=int), replace(tracker, find=(sure, weak))
    places, candidate = searching.newcomers(Tracks.none(BODY_25), none, detections, five_cameras)
    assert asked == [(125, "sure"), (125, "weak")] and len(places) == 1
    assert sorted(candidate.ravel().tolist()) == list(range(125))
    asked.clear()
    places, _ = replace(searching, find=(sure,)).newcomers(
        Tracks.none(BODY_25), none, detections, five_cameras
    )
    assert asked == [(125, "sure")] and len(places) == 0
    asked.clear()
    places, _ = searching.newcomers(tracks_at(two_people[:1]), candidate, detections, five_cameras)
    assert asked == [] and len(places) == 0


def test_newcomers_are_sought_among_what_nobody_has(
    tracker, five_cameras, two_people, seen_exactly
):
    detections = seen_exactly(five_cameras, two_people)
    there, candidate = tracker.step(tracks_at(two_people[:1]), detections, five_cameras, 10.0)
    places, own = tracker.newcomers(there, candidate, detections, five_cameras)
    assert len(places) == 1 and not np.isin(own[own >= 0], candidate).any()
    np.testing.assert_allclose(places[0], two_people[1], atol=0.01)
