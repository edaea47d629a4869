"""Identities: who is who over time, from when to when."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.detections import Detections
from shapepose_fg.tracking.following import FollowingConfig


def who(rows, truth):
    """(N,) which of the true people each row is: whose joints are nearest."""
    distance = np.linalg.norm(rows.initial[:, None] - truth[rows.frame], axis=-1)
    return np.nanmean(distance, axis=-1).argmin(axis=1), np.nanmean(distance, axis=-1).min(axis=1)


def identities(rows, truth):
    """{true person: its tracks}, every row within 3 cm of somebody."""
    person, distance = who(rows, truth)
    assert distance.max() < 0.03
    return {p: set(rows.track[person == p].tolist()) for p in np.unique(person).tolist()}


def test_two_who_pass_each_other_keep_their_names(followed, five_cameras, walking):
    frames, truth = walking
    rows = followed(five_cameras, frames)
    assert len(rows) == 2 * len(frames)
    tracks = identities(rows, truth)
    assert all(len(own) == 1 for own in tracks.values()) and tracks[0] != tracks[1]
    # Every detection is known by its place in the frame.
    row = len(rows) // 2
    seen = rows.candidate[row] >= 0
    np.testing.assert_array_equal(rows.xy[row][seen], frames[rows.frame[row]].xy[rows.candidate[row][seen]])


def test_frames_without_detections_are_bridged_for_half_a_second(followed, five_cameras, walking, nobody):
    frames, truth = walking
    for missing, gap in ((12, range(20, 32)), (18, range(20, 38))):
        rows = followed(five_cameras, [nobody if t in gap else frame for t, frame in enumerate(frames)])
        tracks = identities(rows.rows(np.flatnonzero(np.isfinite(rows.initial).all(axis=(1, 2)))), truth)
        if missing < 15:
            assert all(len(own) == 1 for own in tracks.values())
            assert len(rows) == 2 * len(frames), "rows in the gap, too"
        else:
            # 0.6 s is more than the patience of 0.5 s: two new identities, nothing in between.
            assert all(len(own) == 2 for own in tracks.values())
            assert not np.isin(rows.frame, np.arange(21, 37)).any()


def test_uneven_times_and_missing_frames_do_not_matter(followed, five_cameras, walking):
    frames, truth = walking
    kept = np.setdiff1d(np.arange(len(frames)), [3, 4, 11, 25, 26, 27, 40])
    rows = followed(five_cameras, [frames[t] for t in kept], kept / 30.0)
    tracks = identities(rows, truth[kept])
    assert len(rows) == 2 * len(kept) and all(len(own) == 1 for own in tracks.values())


@pytest.mark.parametrize("fps", [1, 2, 3, 4])
def test_few_frames_a_second_cost_nobody_the_first_ones(followed, five_cameras, seen_exactly, two_people, fps):
    """Five frames of evidence are more than a second: who stands there from the first frame on has all rows."""
    frames = [seen_exactly(five_cameras, two_people)] * 12
    rows = followed(five_cameras, frames, np.arange(12) / fps)
    assert len(rows) == 2 * 12
    assert all(len(own) == 1 for own in identities(rows, np.stack([two_people] * 12)).values())


def test_people_in_view_for_five_frames_at_either_end(followed, five_cameras, seen_exactly, walking):
    frames, truth = walking
    last = len(frames) - 5

    def present(t):
        who = [0] if 5 <= t < last else [0, 1]
        return seen_exactly(five_cameras, truth[t, who])

    rows = followed(five_cameras, [present(t) for t in range(len(frames))])
    person, _ = who(rows, truth)
    assert np.bincount(person).tolist() == [len(frames), 10]
    assert sorted(np.unique(rows.frame[person == 1]).tolist()) == [*range(5), *range(last, len(frames))]


@pytest.mark.parametrize(("count", "people"), [(3, 1), (4, 1), (5, 2)])
def test_fewer_than_five_frames_in_the_middle_are_a_phantom(
    followed, five_cameras, seen_exactly, walking, count, people
):
    _, truth = walking
    seen = [seen_exactly(five_cameras, truth[t, [0, 1] if 8 <= t < 8 + count else [0]]) for t in range(30)]
    rows = followed(five_cameras, seen)
    assert len(np.unique(rows.track)) == people and len(rows) == 30 + (count if people == 2 else 0)


def test_who_is_found_late_was_there_before(followed, five_cameras, seen_exactly, walking):
    """The hips of the second person are not detected at first: stage I finds nobody, the way back does."""
    frames, truth = walking
    hips = [8, 9, 12]
    seen = []
    for t in range(len(frames)):
        detections = seen_exactly(five_cameras, truth[t])
        if t < 12:
            xy, _ = five_cameras.project(truth[t, 1])
            own = np.linalg.norm(detections.xy - xy[detections.view, detections.joint], axis=1) < 1e-6
            detections = detections.only(~(own & np.isin(detections.joint, hips)))
        seen.append(detections)
    rows = followed(five_cameras, seen)
    tracks = identities(rows, truth)
    assert all(len(own) == 1 for own in tracks.values()) and len(rows) == 2 * len(frames)
    before = (rows.frame < 12) & (who(rows, truth)[0] == 1)
    counts = (rows.candidate[before] >= 0).sum(axis=(1, 2))
    assert (counts == 5 * 22).all(), "on the way back, too, they have all their detections"


def test_a_camera_that_fails_half_way_costs_nobody(followed, five_cameras, walking):
    frames, truth = walking
    seen = [frame if t < 20 else frame.only(frame.view < 3) for t, frame in enumerate(frames)]
    rows = followed(five_cameras, seen)
    assert len(rows) == 2 * len(frames) and all(len(own) == 1 for own in identities(rows, truth).values())


def test_one_frame_is_a_recording_too(followed, five_cameras, walking):
    frames, truth = walking
    rows = followed(five_cameras, frames[:1])
    assert len(rows) == 2 and len(identities(rows, truth)) == 2


def test_nobody_is_no_row(followed, five_cameras):
    assert len(followed(five_cameras, [Detections.empty()] * 40)) == 0


def test_moving_cameras_are_followed_too(tracker, five_cameras, seen_exactly, walking):
    """The rig slides 2 cm a frame: each frame has its own."""
    from shapepose_fg.tracking.following import FollowState, finish, follow
    from shapepose_fg.tracking.hypotheses import Input
    from shapepose_fg.tracking.tracker import Tracks

    _, truth = walking
    state, rows = FollowState(Tracks.none(tracker.skeleton)), []
    for t in range(20):
        cameras = []
        for camera in five_cameras.cameras:
            wTc = camera.wTc.copy()
            wTc[:3, 3] += [0.02 * t, 0.0, 0.0]
            cameras.append(replace(camera, wTc=wTc))
        rig = replace(five_cameras, cameras=tuple(cameras))
        given = Input(t, np.full(5, t / 30.0), seen_exactly(rig, truth[t]), rig)
        state, more = follow(tracker, state, given, FollowingConfig())
        rows += more
    rows += finish(tracker, state)[1]
    for frame, part in rows:
        distance = np.linalg.norm(part.initial[:, None] - truth[frame.frame], axis=-1).mean(axis=-1)
        assert len(part) == 2 and (distance.min(axis=1) < 0.03).all()


def test_the_memory_of_a_long_recording_is_that_of_the_look_ahead(tracker, five_cameras, walking):
    from shapepose_fg.tracking.following import FollowState, follow
    from shapepose_fg.tracking.hypotheses import Input
    from shapepose_fg.tracking.tracker import Tracks

    frames, _ = walking
    state, longest = FollowState(Tracks.none(tracker.skeleton)), 0
    for t in range(90):
        given = Input(t, np.full(5, t / 30.0), frames[min(t, len(frames) - 1)], five_cameras)
        state, _ = follow(tracker, state, given, FollowingConfig())
        longest = max(longest, len(state.pending))
    assert longest <= 31 and len(state.evident) == len(state.real) == 2


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="look_ahead_s must be positive"):
        FollowingConfig(look_ahead_s=0.0)
