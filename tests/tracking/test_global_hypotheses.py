"""Worlds that are followed side by side: no more of them than there is doubt."""

import numpy as np
import pytest

from shapepose_fg.core.detections import Input
from shapepose_fg.tracking.global_hypotheses import (
    RemainingDetections,
    Seed,
    explained,
    follow_hypotheses,
)
from shapepose_fg.tracking.tracker import Tracker, Tracks


@pytest.fixture
def people_followed(monkeypatch):
    """How many people each step has followed, as a list that grows."""
    counts, step = [], Tracker.step

    def counted(self, tracks, *rest):
        counts.append(len(tracks))
        return step(self, tracks, *rest)

    monkeypatch.setattr(Tracker, "step", counted)
    return counts


def inputs(rig, frames):
    return [Input(t, np.full(len(rig), t / 30.0), frame, rig) for t, frame in enumerate(frames)]


def seed(tracker, truth, key):
    """Both people in frame `key`, their detections not said."""
    zero = np.zeros(2, dtype=np.intp)
    return Seed(key, tracker.at(truth[key], zero, zero, key / 30.0), np.full((2, 25, 5), -1))


def test_worlds_that_have_become_alike_are_followed_once(
    tracker, five_cameras, walking, people_followed
):
    frames, truth = walking
    given, seeds = inputs(five_cameras, frames), [seed(tracker, truth, 6), seed(tracker, truth, 20)]
    found = follow_hypotheses(tracker, RemainingDetections.of(given), seeds, keep=40)
    side_by_side = sum(people_followed)
    people_followed.clear()
    apart = [
        follow_hypotheses(tracker, RemainingDetections.of(given), [each], keep=40) for each in seeds
    ]
    assert side_by_side < 0.75 * sum(people_followed)
    np.testing.assert_array_equal(found.global_hypothesis, [0, 0, 1, 1])
    for rows, own in zip((slice(0, 2), slice(2, 4)), apart, strict=True):
        np.testing.assert_array_equal(found.tracked[rows], own.tracked)
        # A frame's detections may be the other world's for as long as both are told apart; later
        # they are one.
        assert (found.candidate[rows] == own.candidate).mean() > 0.999
        np.testing.assert_allclose(found.places[rows], own.places, atol=0.02)
        np.testing.assert_allclose(found.joints.position[rows], own.joints.position, atol=0.005)
        assert (
            np.linalg.norm(found.places[rows] - truth.swapaxes(0, 1), axis=-1)[:, 6:].max() < 0.03
        )


def test_who_is_always_seen_well_is_followed_once(
    tracker, five_cameras, walking, nobody, people_followed
):
    frames, _ = walking
    found, chosen = explained(
        tracker, inputs(five_cameras, frames), Tracks.none(tracker.skeleton), 44
    )
    assert len(chosen) == len(found) == 2
    assert people_followed == [2] * (len(frames) - 1)
    people_followed.clear()
    # Nobody sees anything for a third of a second: others may explain what comes after.
    gap = [nobody if 20 <= t < 30 else frame for t, frame in enumerate(frames)]
    _, chosen = explained(tracker, inputs(five_cameras, gap), Tracks.none(tracker.skeleton), 44)
    assert len(chosen) == 2 and len(people_followed) > 2 * len(frames)


def test_alternatives_are_sought_in_what_people_seen_well_leave(
    tracker, five_cameras, walking, nobody, people_followed
):
    frames, _ = walking

    def followed(given):
        people_followed.clear()
        nobody_yet = Tracks.none(tracker.skeleton)
        found, chosen = explained(tracker, inputs(five_cameras, given), nobody_yet, 44)
        return found, chosen, sum(people_followed)

    whole, _, _ = followed(frames)
    # A third of a second without the second person's detections, and without anybody's.
    gap = [
        frame.only(~np.isin(np.arange(len(frame)), whole.candidate[1, t]))
        if 20 <= t < 30
        else frame
        for t, frame in enumerate(frames)
    ]
    found, chosen, count = followed(gap)
    empty = [nobody if 20 <= t < 30 else frame for t, frame in enumerate(frames)]
    assert count < 0.8 * followed(empty)[-1]
    assert len(chosen) == 2
    # All hypotheses name detections among those of the whole frame.
    for t, frame in enumerate(gap):
        who, joint, view = np.nonzero(found.candidate[:, t] >= 0)
        own = found.candidate[who, t, joint, view]
        np.testing.assert_array_equal(frame.joint[own], joint)
        np.testing.assert_array_equal(frame.view[own], view)
