"""The steps of following people, each with numbers that can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.detections import Detections
from shapepose_fg.skeleton import BODY_25
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import TrackerState

CORE = list(BODY_25.core)
HIP, SHOULDER, ELBOW, WRIST = (BODY_25.index(name) for name in ("MidHip", "RShoulder", "RElbow", "RWrist"))


def states(places, sigma_m=0.02, **known) -> TrackerState:
    """Tracks 0, 1, ... at `places` (A, 25, 3) at 10 s, 5 s old, with evidence, unless `known` says so."""
    count = len(places)
    joints = JointStates.at(np.asarray(places, dtype=float), np.full((count, 25), sigma_m), 0.1)
    start = TrackerState.start(BODY_25, next_id=count)
    columns = {
        "time_s": 10.0,
        "ids": np.arange(count),
        "joints": joints,
        "born_s": np.full(count, 5.0),
        "evident_s": np.full(count, 10.0),
        "misses": np.zeros(count, dtype=int),
        "weak": np.zeros(count, dtype=bool),
    }
    return replace(start, **columns | known)


def test_an_unseen_joint_comes_to_move_as_the_person_does(tracker, two_people):
    """After a quarter of a second 1/e is left of how its velocity differs from the person's: the mean of the core
    joints, weighted by how surely their places are known."""
    rng = np.random.default_rng(0)
    sigma = np.where(np.arange(25) == WRIST, 0.06, rng.uniform(0.01, 0.05, (1, 25)))
    velocity = rng.normal(0, 1, (1, 25, 3))
    before = JointStates.at(two_people[:1], sigma, 0.1).with_velocity(velocity)
    after = tracker._predict(before, 0.25)
    person = np.average(velocity[0, CORE], axis=0, weights=sigma[0, CORE] ** -2.0)
    expected = velocity.copy()
    expected[0, WRIST] = person + (velocity[0, WRIST] - person) / np.e
    np.testing.assert_allclose(after.velocity, expected)
    np.testing.assert_allclose(after.position, two_people[:1] + 0.25 * expected)
    back = tracker._predict(before, -0.25)
    np.testing.assert_allclose(back.position, two_people[:1] - 0.25 * expected)


def test_a_lost_joint_is_sought_around_its_parent_and_a_lost_root_between_the_hips(tracker, two_people):
    """Bones are 0.7 m at the longest: on each axis 0.7 / 1.5 m, for each bone on the way."""
    joints = JointStates.at(two_people, np.full((2, 25), 0.02), 0.1)
    joints = joints.with_velocity(np.random.default_rng(0).normal(0, 1, (2, 25, 3)))
    lost = np.zeros((2, 25), dtype=bool)
    lost[0, [ELBOW, WRIST]] = lost[1, HIP] = True
    found = tracker._beside_neighbours(joints, lost)
    np.testing.assert_allclose(found.mean[0, [ELBOW, WRIST]], joints.mean[0, [SHOULDER, SHOULDER]])
    reach = 0.7 / 1.5
    for joint, bones in ((ELBOW, 1), (WRIST, 2)):
        expected = np.diag([0.02**2 + bones * reach**2] * 3 + [0.1**2 + bones] * 3)
        np.testing.assert_allclose(found.covariance[0, joint], expected, atol=1e-12)
    hips = list(BODY_25.hips)
    np.testing.assert_allclose(found.mean[1, HIP], joints.mean[1, hips].mean(axis=0))
    others = ~lost
    np.testing.assert_array_equal(found.mean[others], joints.mean[others])
    np.testing.assert_array_equal(found.covariance[others], joints.covariance[others])
    assert tracker._beside_neighbours(joints, np.zeros((2, 25), dtype=bool)) is joints


def test_four_core_joints_that_two_views_see_are_evidence(tracker):
    candidate = np.full((3, 25, 5), -1)
    for person, joints in enumerate((CORE[:4], CORE[:3], CORE[:3])):
        candidate[person, joints, :2] = 1
    candidate[2, CORE[3:], 0] = 1  # one view only
    candidate[2, [j for j in range(25) if j not in CORE], :3] = 1  # no core joints
    assert tracker._evident(candidate).tolist() == [True, False, False]


def lists(joints: list[int], views: list[int]) -> Detections:
    count = len(joints)
    none = np.zeros((0, 2), dtype=np.intp)
    return Detections(np.array(views), np.array(joints), np.zeros((count, 2)), np.ones(count), none, np.zeros(0))


def test_six_core_joints_that_two_views_see_may_be_somebody(tracker):
    six = lists(CORE[:6] * 2, [0] * 6 + [3] * 6)
    every = np.ones(12, dtype=bool)
    assert tracker._enough(six, every)
    one_taken = every.copy()
    one_taken[4] = False
    assert not tracker._enough(six, one_taken)
    assert not tracker._enough(lists(CORE[:6] * 2, [0] * 11 + [3]), every), "twice in one view is one view"
    others = [j for j in range(25) if j not in CORE][:6]
    assert not tracker._enough(lists(others * 2, [0] * 6 + [3] * 6), every)


@pytest.mark.parametrize(("beside_m", "double"), [(0.14, True), (0.16, False)])
def test_of_two_tracks_in_one_place_the_older_has_the_evidence(tracker, two_people, beside_m, double):
    state = states([two_people[0], two_people[0] + [beside_m, 0, 0], two_people[1]])
    assert tracker._doubles(state.joints, state).tolist() == [False, double, False]
    weak = replace(state, weak=np.array([True, False, False]))
    assert not tracker._doubles(state.joints, weak).any(), "who is on trial takes nobody's evidence"
    both = replace(state, weak=np.array([True, True, False]))
    assert tracker._doubles(state.joints, both).tolist() == [False, double, False]


@pytest.mark.parametrize(("beside_m", "apart"), [(0.24, False), (0.26, True)])
def test_a_new_person_stands_apart_from_all_tracks(tracker, two_people, beside_m, apart):
    new = two_people[:1] + np.array([0.0, beside_m, 0.0])
    new[0, WRIST:] = np.nan  # joints that are not placed count nothing
    assert tracker._apart(new, states(two_people)).tolist() == [apart]
    assert tracker._apart(new, states(two_people[1:])).tolist() == [True]
    assert tracker._apart(new, states(two_people[:0])).tolist() == [True]


@pytest.mark.parametrize(
    ("waited_s", "away_m", "back"), [(0.4, 0.64, True), (0.4, 0.66, False), (0.0, 0.26, False)]
)
def test_who_comes_back_is_as_far_off_as_a_person_walks(tracker, two_people, waited_s, away_m, back):
    """25 cm and 1 m/s; the second track has evidence, the third is on trial: both wait for nobody."""
    third = two_people[0] + [0.05, 0.0, 0.0]
    state = states(
        [*two_people, third], evident_s=np.full(3, 10.0 - waited_s), weak=np.array([False, False, True])
    )
    evident = np.array([False, True, False])
    places = two_people[:1] + np.array([0.0, away_m, 0.0])
    places[0, CORE[:3]] = np.nan  # the centre is of what is placed, of both
    track, person = tracker._returned(places, np.array([True]), state, evident)
    assert (track.tolist(), person.tolist()) == (([0], [0]) if back else ([], []))
    none = tracker._returned(places, np.array([False]), state, evident)
    assert len(none[0]) == len(none[1]) == 0


def test_two_who_come_back_are_told_apart_together(tracker, two_people):
    """The first is nearer to both tracks; taken greedily it would leave the other to nobody."""
    state = states(two_people, evident_s=np.full(2, 9.6))
    x = two_people[1, CORE].mean(axis=0) - two_people[0, CORE].mean(axis=0)
    places = np.stack([two_people[0] + 0.6 * x, two_people[0] - 0.3 * x])
    track, person = tracker._returned(places, np.ones(2, dtype=bool), state, np.zeros(2, dtype=bool))
    assert dict(zip(track.tolist(), person.tolist(), strict=True)) == {0: 1, 1: 0}


def test_who_comes_back_within_reach_is_not_lost_to_a_track_out_of_reach(tracker, two_people):
    """The tracks' gates are 0.25 and 0.70 m: the person is 0.30 and 0.60 m away, and is the second."""
    places = two_people[:1]
    tracks = [two_people[0] + [0.3, 0.0, 0.0], two_people[0] + [0.0, 0.6, 0.0]]
    state = states(tracks, evident_s=np.array([10.0, 9.55]))
    track, person = tracker._returned(places, np.array([True]), state, np.zeros(2, dtype=bool))
    assert (track.tolist(), person.tolist()) == ([1], [0])
    beside = two_people[0] + [0.25, 0.0, 0.0]  # 5 cm from the first track, 0.65 m from the second
    both = np.stack([places[0], beside])
    track, person = tracker._returned(both, np.ones(2, dtype=bool), state, np.zeros(2, dtype=bool))
    assert dict(zip(track.tolist(), person.tolist(), strict=True)) == {0: 1, 1: 0}


def test_who_is_found_again_on_trial_goes_on(tracker, five_cameras, two_people, seen_exactly):
    """Two misses before, and in this frame stage I finds the person: it is no third one."""
    away = two_people[:1] + np.array([0.4, 0.0, 0.0])  # farther than any detection is taken from
    state = states(away, born_s=np.array([9.8]), evident_s=np.array([9.8]), misses=np.array([2]))
    after, frame = tracker.step(state, seen_exactly(five_cameras, two_people[:1]), five_cameras, 10.0)
    assert frame.ids.tolist() == [0] and frame.evident.tolist() == [True]
    assert after.ids.tolist() == [0] and after.misses.tolist() == [2] and after.evident_s.tolist() == [10.0]


def test_new_joints_are_known_to_4_cm_and_unplaced_ones_are_lost(tracker, two_people):
    places = two_people[:1].copy()
    places[0, WRIST] = np.nan
    new = tracker._with_new(states(two_people[1:]), places, True)
    np.testing.assert_allclose(new.joints.sigma_m[1], np.where(np.arange(25) == WRIST, 0.4, 0.04))
    np.testing.assert_allclose(new.joints.position[1, WRIST], np.nanmean(places[0], axis=0))
    np.testing.assert_allclose(np.diagonal(new.joints.covariance[1], axis1=1, axis2=2)[:, 3:], 2.0**2)
    assert (new.joints.velocity[1] == 0).all()
    assert new.ids.tolist() == [0, 1] and new.next_id == 2
    assert new.born_s.tolist() == [5.0, 10.0] and new.evident_s.tolist() == [10.0, 10.0]
    assert new.misses.tolist() == [0, 0] and new.weak.tolist() == [False, True]


@pytest.mark.parametrize(
    ("age_s", "waited_s", "misses", "weak", "stays"),
    [
        (5.0, 0.49, 9, False, True),
        (5.0, 0.51, 9, False, False),
        (0.24, 0.1, 2, False, True),
        (0.24, 0.1, 3, False, False),
        (0.26, 0.1, 3, False, True),
        (0.49, 0.1, 2, True, True),
        (0.49, 0.1, 3, True, False),
        (0.51, 0.1, 3, True, True),
    ],
)
def test_tracks_end_without_evidence_for_long_and_new_ones_sooner(
    tracker, two_people, age_s, waited_s, misses, weak, stays
):
    """Half a second of patience; a quarter of a second on trial, with weak hips half a second: three misses."""
    state = states(
        two_people,
        born_s=np.array([10.0 - age_s, 0.0]),
        evident_s=np.array([10.0 - waited_s, 10.0]),
        misses=np.array([misses, 0]),
        weak=np.array([weak, False]),
    )
    left = tracker._without_the_ended(state)
    assert left.ids.tolist() == ([0, 1] if stays else [1])
    if stays:
        assert left.weak.tolist() == [weak and age_s < 0.5, False], "after the trial a person is one"


def test_tracks_on_trial_get_what_the_others_leave(tracker, five_cameras, two_people, seen_exactly):
    """Both stand where one person is seen: the one on trial is nearer to all, and gets nothing."""
    detections = seen_exactly(five_cameras, two_people[:1])
    places = np.stack([two_people[0], two_people[0] + [0.03, 0.0, 0.0]])
    joints = JointStates.at(places, np.full((2, 25), 0.02), 0.1)
    lost = np.zeros((2, 25), dtype=bool)
    taken = tracker._assign(joints, lost, np.array([True, False]), detections, five_cameras)
    # Where the two's joints are within 6 px of each other a detection may serve both, but not over the trial.
    assert (taken[1] >= 0).all() and (taken[0] < 0).all()
    both = tracker._assign(joints, lost, np.array([False, False]), detections, five_cameras)
    assert (both[0] >= 0).sum() > (both[1] >= 0).sum()


def test_hips_that_two_views_saw_are_asked_for_last(tracker, five_cameras, two_people, seen_exactly):
    """Stage I is asked for weak hips among what is left; who comes of them is on trial."""
    detections = seen_exactly(five_cameras, two_people[:1])
    asked = []

    def find(left, rig, weak):
        asked.append((len(left), weak))
        everybody = tracker.find(left, rig, False)
        return everybody if weak else everybody.rows(np.zeros(0, dtype=int))

    state = TrackerState.start(BODY_25)
    state, frame = replace(tracker, find=find).step(state, detections, five_cameras, 0.0)
    assert asked == [(125, False), (125, True)]
    assert state.weak.tolist() == [True] and frame.evident.tolist() == [True]
    asked.clear()
    state, _ = replace(tracker, find=find, weak_births=False).step(
        TrackerState.start(BODY_25), detections, five_cameras, 0.0
    )
    assert asked == [(125, False)] and len(state.ids) == 0
