"""Identities: who is who over time, from when to when."""

from dataclasses import fields, replace

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.runs.parts import Checkpoint, checkpoint_arrays, checkpoint_of
from shapepose_fg.pipeline.windows import StreamState
from shapepose_fg.tracking.global_hypotheses import RemainingDetections, Seed, follow_hypotheses
from shapepose_fg.tracking.identities import BLOCK_S, FollowingConfig, FollowState, finish, follow
from shapepose_fg.tracking.stitching import Ends, StitchingConfig, Trace, stitch
from shapepose_fg.tracking.tracker import Tracks
from tests.marks import slow


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
    np.testing.assert_array_equal(
        rows.xy[row][seen], frames[rows.frame[row]].xy[rows.candidate[row][seen]]
    )


@pytest.mark.parametrize(("missing", "bridged"), [(12, True), (18, False)])
def test_who_is_out_of_sight_has_rows_for_half_a_second(
    followed, five_cameras, walking, nobody, missing, bridged
):
    """They pass each other meanwhile, at 1.2 m/s; after a longer time `stitching` knows them."""
    frames, truth = walking
    gap = range(20, 20 + missing)
    rows = followed(five_cameras, [nobody if t in gap else frame for t, frame in enumerate(frames)])
    tracks = identities(
        rows.rows(np.flatnonzero(np.isfinite(rows.initial).all(axis=(1, 2)))), truth
    )
    assert all(len(own) == (1 if bridged else 2) for own in tracks.values())
    assert not tracks[0] & tracks[1]
    # 0.6 s is more than the patience of 0.5 s.
    assert len(rows) == 2 * (len(frames) if bridged else len(frames) - missing)


def test_uneven_times_and_missing_frames_do_not_matter(followed, five_cameras, walking):
    frames, truth = walking
    kept = np.setdiff1d(np.arange(len(frames)), [3, 4, 11, 25, 26, 27, 40])
    rows = followed(five_cameras, [frames[t] for t in kept], kept / 30.0)
    tracks = identities(rows, truth[kept])
    assert len(rows) == 2 * len(kept) and all(len(own) == 1 for own in tracks.values())


@pytest.mark.parametrize("fps", [1, *slow(2, 3), 4])
def test_few_frames_a_second_cost_nobody_the_first_ones(
    followed, five_cameras, seen_exactly, two_people, fps
):
    """Five frames of evidence are more than a second: who stands there from the first frame on has
    all rows.
    """
    frames = [seen_exactly(five_cameras, two_people)] * 12
    rows = followed(five_cameras, frames, np.arange(12) / fps)
    assert len(rows) == 2 * 12
    assert all(len(own) == 1 for own in identities(rows, np.stack([two_people] * 12)).values())


def present(five_cameras, seen_exactly, truth, when):
    """Both people in the frames that `when` has, else the first alone."""
    return [
        seen_exactly(five_cameras, people if t in when else people[:1])
        for t, people in enumerate(truth)
    ]


def test_people_in_view_for_a_quarter_of_a_second_at_either_end(
    followed, five_cameras, seen_exactly, walking
):
    """Evidence of 0.27 s less 0.125 s for one end: more than 0.1 s."""
    _, truth = walking
    here = [*range(8), *range(len(truth) - 8, len(truth))]
    rows = followed(five_cameras, present(five_cameras, seen_exactly, truth, here))
    person, _ = who(rows, truth)
    assert np.bincount(person).tolist() == [len(truth), 16]
    assert sorted(rows.frame[person == 1].tolist()) == here


@pytest.mark.parametrize(("count", "people"), [(9, 1), (12, 2)])
def test_who_is_seen_for_less_than_a_third_of_a_second_is_nobody_and_that_is_noted(
    followed, tracker, five_cameras, seen_exactly, walking, count, people
):
    """Two ends cost 0.25 s, and 0.1 s of evidence must be left: 0.35 s of all that can be seen."""
    truth, noted, here = walking[1], [], range(17, 17 + count)
    taking_notes = replace(tracker, drop=lambda _, frames: noted.append(frames))
    rows = followed(
        five_cameras, present(five_cameras, seen_exactly, truth, here), tracker=taking_notes
    )
    assert noted == ([list(here)] if people == 1 else [])
    assert len(np.unique(rows.track)) == people and len(rows) == 45 + (count if people == 2 else 0)


def test_rows_begin_and_end_with_detections(followed, five_cameras, walking, nobody):
    """Half a second without anybody at either end of a recording: as long as a track lives without
    evidence.
    """
    frames, truth = walking
    seen = [frame if 14 <= t < 31 else nobody for t, frame in enumerate(frames)]
    rows = followed(five_cameras, seen)
    assert (
        rows.frame.tolist() == np.arange(14, 31).repeat(2).tolist()
        and len(identities(rows, truth)) == 2
    )


@pytest.mark.slow
def test_who_enters_late_leaves_early_and_comes_back_is_the_same_person(
    followed, five_cameras, seen_exactly, walking
):
    """4 s: the second person comes after 0.8 s, is away for 0.7 s, and leaves 0.7 s before the
    end.
    """
    truth = np.linspace(walking[1][0], walking[1][-1], 60)
    here = [*range(12, 28), *range(38, 49)]
    rows = followed(
        five_cameras, present(five_cameras, seen_exactly, truth, here), np.arange(60) / 15
    )
    person, _ = who(rows, truth)
    assert sorted(rows.frame[person == 1].tolist()) == here and (person == 0).sum() == 60
    traces = (
        Trace.of(n, rows.time_s[own].mean(axis=1), rows.initial[own], BODY_25)
        for n in np.unique(rows.track).tolist()
        for own in [rows.track == n]
    )
    named = stitch(Ends.of(traces), StitchingConfig())
    same = [{named[n] for n in own} for own in identities(rows, truth).values()]
    assert len(same) == 2 and same[0] != same[1] and all(len(own) == 1 for own in same)


@pytest.mark.parametrize("fps", [5, *slow(30, 60)])
def test_identities_last_over_the_border_of_a_block(
    followed, five_cameras, seen_exactly, two_people, fps
):
    """4.2 s before three cameras: a block ends after 3 s, and no frame of anybody is missing or
    twice.
    """
    times = np.arange(round(4.2 * fps)) / fps
    truth = (
        two_people
        + np.stack([0 * times, 0.3 * np.sin(2 * times), 0 * times], axis=1)[:, None, None]
    )
    rig = replace(five_cameras, cameras=five_cameras.cameras[:3])
    rows = followed(rig, [seen_exactly(rig, people) for people in truth], times)
    assert len(rows) == 2 * len(times)
    tracks = identities(rows, truth)
    assert all(len(own) == 1 for own in tracks.values()) and tracks[0] != tracks[1]


@pytest.mark.parametrize("fps", [10, 30])
def test_what_one_of_two_cameras_sees_goes_on(followed, five_cameras, seen_exactly, walking, fps):
    """For a second the other camera sees nothing: along the ray joints are uncertain by more than
    20 cm then.
    """
    two = replace(five_cameras, cameras=five_cameras.cameras[:2])
    truth = np.linspace(walking[1][0], walking[1][-1], round(2.4 * fps))[:, :1]
    blind = np.arange(round(0.8 * fps), round(1.8 * fps))
    seen = [seen_exactly(two, people) for people in truth]
    seen = [frame.only(frame.view < 1) if t in blind else frame for t, frame in enumerate(seen)]
    rows = followed(two, seen, np.arange(len(seen)) / fps)
    assert rows.frame.tolist() == list(range(len(seen))) and len(np.unique(rows.track)) == 1
    assert (rows.candidate[blind][..., 0] >= 0).mean() > 0.9 and (
        rows.candidate[blind][..., 1] < 0
    ).all()
    both = np.setdiff1d(rows.frame, blind)
    assert np.nanmax(np.linalg.norm(rows.initial - truth[:, 0], axis=-1)[both]) < 0.1
    # Joints that are over 0.5 m off along the ray do not get the other view's detections again, so
    # not all do; those that do have them from the first frame on, and legs are among them.
    again = rows.candidate[blind[-1] + 1 :, :, 1] >= 0
    assert (again == again[0]).all() and again[0].mean() > 0.5
    assert again[0, [BODY_25.index(name) for name in ("RHip", "RKnee", "LHip", "LKnee")]].all()


def test_the_order_of_detections_does_not_matter(followed, five_cameras, walking):
    rng, frames, shuffled = np.random.default_rng(0), [], []
    for exact in walking[0][10:30]:
        n = len(exact)
        frame = replace(
            exact, xy=exact.xy + rng.normal(0, 2, (n, 2)), confidence=rng.uniform(0.5, 1, n)
        )
        order = rng.permutation(n)
        columns = {
            name: getattr(frame, name)[order] for name in ("view", "joint", "xy", "confidence")
        }
        frames.append(frame)
        shuffled.append(replace(frame, **columns, pairs=np.argsort(order)[frame.pairs]))
    both = [followed(five_cameras, each) for each in (frames, shuffled)]
    one, other = (rows.rows(np.lexsort((rows.initial[:, 0, 1], rows.frame))) for rows in both)
    assert len(set(zip(one.track.tolist(), other.track.tolist(), strict=True))) == 2
    np.testing.assert_allclose(other.initial, one.initial, atol=1e-9)
    np.testing.assert_array_equal(other.xy, one.xy)


@pytest.fixture
def found_late(five_cameras, seen_exactly, walking) -> list[Detections]:
    """Two people walking; the hips of the second are not detected in the first 12 frames: stage I
    finds nobody.
    """
    frames, truth = walking
    hips = [8, 9, 12]
    seen = []
    for t in range(len(frames)):
        detections = seen_exactly(five_cameras, truth[t])
        if t < 12:
            xy, _ = five_cameras.project(truth[t, 1])
            own = (
                np.linalg.norm(detections.xy - xy[detections.view, detections.joint], axis=1) < 1e-6
            )
            detections = detections.only(~(own & np.isin(detections.joint, hips)))
        seen.append(detections)
    return seen


def test_who_is_found_on_the_way_forwards_is_followed_back_in_the_same_world(
    tracker, five_cameras, found_late
):
    """A world that begins with nobody in the first frame has two people, and both in every
    frame.
    """
    frames = [Input(t, np.full(5, t / 30), each, five_cameras) for t, each in enumerate(found_late)]
    none = np.zeros((0, len(tracker.skeleton), 5), dtype=np.intp)
    found = follow_hypotheses(
        tracker, RemainingDetections.of(frames), [Seed(0, Tracks.none(tracker.skeleton), none)], 0
    )
    assert found.tracked.shape == (2, len(frames)) and found.tracked.all()
    seen = (found.candidate >= 0).sum(axis=(2, 3))
    assert (
        (seen[0] == 5 * 25).all()
        and (seen[1, 12:] == 5 * 25).all()
        and (seen[1, :12] == 5 * 22).all()
    )


def test_who_is_found_late_was_there_before(followed, five_cameras, walking, found_late):
    """Stage I finds nobody at first, the way back does."""
    frames, truth = walking
    rows = followed(five_cameras, found_late)
    tracks = identities(rows, truth)
    assert all(len(own) == 1 for own in tracks.values()) and len(rows) == 2 * len(frames)
    before = (rows.frame < 12) & (who(rows, truth)[0] == 1)
    counts = (rows.candidate[before] >= 0).sum(axis=(1, 2))
    assert (counts == 5 * 22).all(), "on the way back, too, they have all their detections"


def test_a_camera_that_fails_half_way_costs_nobody(followed, five_cameras, walking):
    frames, truth = walking
    seen = [frame if t < 20 else frame.only(frame.view < 3) for t, frame in enumerate(frames)]
    rows = followed(five_cameras, seen)
    assert len(rows) == 2 * len(frames) and all(
        len(own) == 1 for own in identities(rows, truth).values()
    )


def test_one_frame_is_a_recording_too(followed, five_cameras, walking):
    frames, truth = walking
    rows = followed(five_cameras, frames[:1])
    assert len(rows) == 2 and len(identities(rows, truth)) == 2


def test_nobody_is_no_row(followed, five_cameras):
    assert len(followed(five_cameras, [Detections.empty()] * 40)) == 0


def test_moving_cameras_are_followed_too(tracker, five_cameras, seen_exactly, walking):
    """The rig slides 2 cm a frame: each frame has its own."""
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


def test_the_memory_of_a_long_recording_is_that_of_a_block_and_the_look_ahead(
    tracker, five_cameras, walking
):
    frames, _ = walking
    state, longest = FollowState(Tracks.none(tracker.skeleton)), 0
    for t in range(65):
        given = Input(t, np.full(5, t / 5.0), frames[min(t, len(frames) - 1)], five_cameras)
        state, _ = follow(tracker, state, given, FollowingConfig())
        longest = max(longest, len(state.pending))
    assert longest <= 5 * (BLOCK_S + 1.0) + 1 and sorted(state.people.ids.tolist()) == [0, 1]
    assert state.next_id == 2


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [12, *slow(44)])
def test_whoever_goes_on_from_a_checkpoint_finds_the_same_bytes(
    tracker, five_cameras, walking, stopped
):
    """10 frames a second: within the first block, and after it while the second is open."""
    frames = [walking[0][t // 2] for t in range(60)]
    given = [Input(t, np.full(5, t / 10.0), frame, five_cameras) for t, frame in enumerate(frames)]

    def through(stop: int | None) -> tuple[FollowState, list]:
        state, decided = FollowState(Tracks.none(tracker.skeleton)), []
        for each in given:
            if each.frame == stop:
                assert len(state.pending) > 0 and len(state.people) == (2 if stop > 40 else 0)
                arrays = checkpoint_arrays(Checkpoint(stop, state=StreamState(state)))
                first = state.pending[0].frame
                nobody = Tracks.none(tracker.skeleton)
                state = checkpoint_of(
                    arrays, given.__getitem__, first, range(60), nobody, tracker.skeleton
                ).state.follow
            state, more = follow(tracker, state, each, FollowingConfig())
            decided += more
        return state, decided + finish(tracker, state)[1]

    (_, whole), (_, resumed) = through(None), through(stopped)
    assert len(whole) == len(resumed) == 60
    for (_, rows), (_, again) in zip(whole, resumed, strict=True):
        for name in (each.name for each in fields(rows)):
            np.testing.assert_array_equal(getattr(again, name), getattr(rows, name), err_msg=name)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="look_ahead_s must be positive"):
        FollowingConfig(look_ahead_s=0.0)
