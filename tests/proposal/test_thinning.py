"""Frames with more detections than people can make: what stays, that it is said, and clusters as
before.
"""

import time
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.config import PeopleConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.proposal.candidates import (
    CandidateConfig,
    Candidates,
    PairPoints,
    greedy_seeds,
    triangulate_pairs,
    vote,
)
from shapepose_fg.proposal.thinning import (
    ThinnedFrames,
    kept_detections,
    thinned_candidates,
    thinned_points,
)
from shapepose_fg.simulation.scene import ring_of_cameras


def crowd(rig: Rig, people: int, seed: int = 0) -> Detections:
    """So many people at random places of each picture, different ones in each; affinity 0.9 within
    each.
    """
    rng, views = np.random.default_rng(seed), len(rig)
    centre = rng.uniform(0, 1, (views, people, 1, 2)) * rig.image_sizes[:, None, None]
    xy = (centre + rng.normal(0, 60, (views, people, 25, 2))).transpose(0, 2, 1, 3).reshape(-1, 2)
    view, joint, person = (index.ravel() for index in np.indices((views, 25, people)))
    place = np.arange(len(view)).reshape(views, 25, people)
    first, second = np.array(BODY_25.limbs).T
    pairs = np.stack([place[:, first], place[:, second]], axis=-1).reshape(-1, 2)
    assert (person[pairs[:, 0]] == person[pairs[:, 1]]).all()
    confidence = rng.uniform(0.3, 1, len(view))
    return Detections(view, joint, xy, confidence, pairs, np.full(len(pairs), 0.9))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring_of_cameras(5, np.random.default_rng(0))


def test_ordinary_frames_are_left_as_they_are(five_cameras, two_people, seen_exactly):
    config, detections = CandidateConfig(), seen_exactly(five_cameras, two_people)
    assert kept_detections(detections, 5, config) is None
    points = triangulate_pairs(detections, five_cameras, config)
    assert thinned_points(points, config) is points
    candidates = vote(points, detections, 5, config)
    assert thinned_candidates(candidates, detections, config) is candidates
    frames = ThinnedFrames(Recording(BODY_25, [detections]), five_cameras, config)
    assert len(frames[0]) == len(detections) and not frames.is_thinned(0)


def test_the_most_confident_detections_stay(rig):
    detections = crowd(rig, 30)
    config = CandidateConfig(most_pairs=1000)  # 10 pairs of views: 10 detections each
    keep = kept_detections(detections, len(rig), config)
    assert keep is not None
    for view, joint in ((0, 0), (3, 8), (4, 24)):
        group = (detections.view == view) & (detections.joint == joint)
        assert (group & keep).sum() == 10
        assert (
            detections.confidence[group & keep].min() > detections.confidence[group & ~keep].max()
        )
    frames = ThinnedFrames(Recording(BODY_25, [detections]), rig, config)
    assert frames.is_thinned(0)
    for view in range(len(rig)):  # what is left knows its place in the recording
        own = frames[0].view == view
        in_recording = detections.xy[detections.view == view]
        np.testing.assert_array_equal(in_recording[frames[0].place[own]], frames[0].xy[own])


def test_the_most_confident_points_of_each_joint_stay(rig):
    points = triangulate_pairs(crowd(rig, 20), rig, CandidateConfig())
    kept = thinned_points(points, CandidateConfig(most_points=100))
    for joint in (0, 8, 24):
        before, after = (np.sort(each.score[each.joint == joint])[::-1] for each in (points, kept))
        assert len(before) > 100
        np.testing.assert_array_equal(after, before[:100])


def test_of_candidates_with_too_many_links_half_stay(rig):
    """250 candidates for each joint, all made of the same two detections: 3 million links, where 2
    are allowed.
    """
    view, joint = (index.ravel() for index in np.indices((2, 25)))
    first, second = np.array(BODY_25.limbs).T
    pairs = np.concatenate([np.column_stack([25 * v + first, 25 * v + second]) for v in range(2)])
    detections = Detections(
        view, joint, np.zeros((50, 2)), np.full(50, 0.8), pairs, np.full(len(pairs), 0.9)
    )
    of_joint = np.arange(25).repeat(250)
    support = np.concatenate(
        [np.column_stack([np.arange(len(of_joint)), 25 * v + of_joint]) for v in range(2)]
    )
    rng = np.random.default_rng(0)
    every = Candidates(
        rng.normal(size=(len(of_joint), 3)), of_joint, rng.uniform(size=len(of_joint)),
        np.full(len(of_joint), 3), np.ones(len(of_joint), dtype=bool), support,
    )  # fmt: skip
    kept = thinned_candidates(every, detections, CandidateConfig(most_candidates=250))
    assert np.bincount(kept.joint).tolist() == [125] * 25
    few = thinned_candidates(every, detections, CandidateConfig(most_candidates=200))
    assert np.bincount(few.joint).tolist() == [100] * 25


def test_strong_candidates_and_those_with_most_votes_stay(rig):
    detections, config = crowd(rig, 20), CandidateConfig(most_candidates=20)
    every = vote(triangulate_pairs(detections, rig, config), detections, len(rig), config)
    kept = thinned_candidates(every, detections, config)
    assert np.bincount(every.joint).max() > 20 and np.bincount(kept.joint).max() == 20
    for joint in (0, 8):
        before, after = (np.flatnonzero(each.joint == joint) for each in (every, kept))
        order = np.lexsort((-every.score[before], -every.votes[before], ~every.strong[before]))[:20]
        assert set(map(tuple, kept.xyz[after])) == set(map(tuple, every.xyz[before[order]]))
    # Each candidate still has the detections that made it.
    assert set(kept.support[:, 0].tolist()) == set(range(len(kept)))
    made = detections.joint[kept.support[:, 1]]
    np.testing.assert_array_equal(made, kept.joint[kept.support[:, 0]])


@pytest.mark.slow
def test_many_points_are_clustered_as_if_one_by_one():
    rng = np.random.default_rng(0)
    count, radius = 9000, 0.12
    points = PairPoints(
        rng.uniform(0, 2.5, (count, 3)),
        rng.integers(0, 3, count),
        np.zeros((count, 2), dtype=np.intp),
        np.round(rng.uniform(0, 1, count), 2),  # equal scores, too
    )
    expected = np.full(count, -1)
    for pick in np.argsort(-points.score, kind="stable"):
        if expected[pick] < 0:
            near = (np.linalg.norm(points.xyz - points.xyz[pick], axis=1) <= radius) & (
                expected < 0
            )
            expected[near & (points.joint == points.joint[pick])] = pick
    np.testing.assert_array_equal(greedy_seeds(points, radius), expected)


@pytest.mark.slow
def test_a_crowd_of_strangers_ends():
    """120 people a view, none of whom two views share: 3.6 million pairs, and once a frame without
    end.
    """
    rig = ring_of_cameras(5, np.random.default_rng(0))
    detections, start = crowd(rig, 120), time.process_time()
    people = find_people(detections, rig, BODY_25, PipelineConfig())
    assert time.process_time() - start < 30  # 10 s on one core; the bound is for slow machines
    assert len(people) <= 3 * PipelineConfig().proposals.most_people


def among_strangers(people: Detections, strangers: Detections) -> Detections:
    """Both, as a reader lists them; of the strangers the detector is less sure."""
    first = len(people)
    view, joint = (
        np.concatenate([getattr(each, name) for each in (people, strangers)])
        for name in ("view", "joint")
    )
    order = np.lexsort((joint, view))
    pairs = np.concatenate([people.pairs, strangers.pairs + first])
    confidence = np.concatenate([people.confidence, strangers.confidence / 3])
    xy = np.concatenate([people.xy, strangers.xy])
    affinity = np.concatenate([people.affinity, strangers.affinity])
    return Detections(
        view[order], joint[order], xy[order], confidence[order], np.argsort(order)[pairs], affinity
    )


def test_what_was_left_out_is_said(five_cameras, two_people, seen_exactly):
    rig, seen = five_cameras, seen_exactly(five_cameras, two_people)
    config = PipelineConfig(people=PeopleConfig(most_pairs=1000), batch_frames=2)
    config = replace(config, offsets=replace(config.offsets, source="none"))
    frames = [
        among_strangers(seen, crowd(rig, count, seed)) for seed, count in enumerate((16, 1, 16))
    ]
    people = reconstruct(Recording(BODY_25, frames), rig, config)
    assert people.run["thinned_frames"]["detections"] == [[0, 1], [2, 3]]
    table = people.observations
    assert table is not None and len(people) == 6 and (table.candidate >= 0).any()
    for row, joint, view in np.argwhere(table.candidate >= 0)[:50].tolist():
        seen = frames[table.frame[row]]
        xy = seen.xy[seen.view == view][table.candidate[row, joint, view]]
        np.testing.assert_allclose(table.xy[row, joint, view], xy, rtol=1e-6)  # float32
