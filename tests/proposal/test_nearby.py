"""Lists of what is near: what is in them, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.detections import Input
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.proposal.nearby import FrameArrays, nearby
from shapepose_fg.proposal.possible_people import Frame, _claimed
from shapepose_fg.proposal.stage_one import StageOne
from shapepose_fg.tracking.identities import FollowState, finish


@pytest.fixture(scope="module")
def people(two_people, crowded, five_cameras):
    """Four people around those of a crowded frame, a fifth of whose joints are not placed, and what
    they have.
    """
    rng = np.random.default_rng(5)
    places = np.concatenate([two_people, two_people[::-1] + np.array([0.02, 0.03, 0.0])])
    places = np.where(
        rng.random((4, 25, 1)) < 0.2, np.nan, places + rng.normal(0, 0.02, places.shape)
    )
    frame = Frame(crowded, five_cameras, BODY_25, longest_bones(BODY_25))
    own = _claimed(np.tile(two_people, (2, 1, 1)), np.full((4, 25, 5), -1), frame, exclusive=False)
    return places, own, frame


def test_what_is_near_and_in_order(people, crowded, five_cameras):
    places, _, _ = people
    (xy, depth), world = five_cameras.project(places), np.array([1, 0, 1, 0])
    at = crowded.view, slice(None), crowded.joint
    away = np.linalg.norm(xy[at] - crowded.xy[:, None], axis=-1) * depth[at]
    away_m = (away / five_cameras.focal_px[crowded.view][:, None]).T
    near = nearby(
        places, np.full((4, 25), 0.3), world, FrameArrays.of(crowded, five_cameras, BODY_25)
    )
    inside = np.zeros(away_m.shape, dtype=bool)
    inside[near.person, near.detection] = True
    np.testing.assert_array_equal(inside, away_m < 0.3)
    np.testing.assert_allclose(near.distance_m, away_m[near.person, near.detection])
    slot = crowded.joint[near.detection] * 5 + crowded.view[near.detection]
    np.testing.assert_array_equal(near.first, np.searchsorted(slot, np.arange(126)))
    order = np.lexsort((near.person, world[near.person], slot))
    np.testing.assert_array_equal(near.person, near.person[order])


def test_whoever_shares_detections_with_nobody_gets_the_same_alone_and_among_all(people):
    """Who competes for nothing is decided by the nearest alone; with others in the room it comes to
    the same.
    """
    places, own, frame = people
    apart = np.concatenate([places[:2], places[2:] + np.array([0.0, 0.0, 50.0])])
    among = _claimed(apart, own, frame, exclusive=True)[:2]
    np.testing.assert_array_equal(among, _claimed(apart[:2], own[:2], frame, exclusive=True))
    alone = _claimed(apart[:2], own[:2], frame, exclusive=False)
    once = np.bincount(alone[alone >= 0], minlength=len(frame.detections)) == 1
    uncontested = (alone >= 0) & once[alone] & (alone == among)
    assert uncontested.sum() > 0.8 * (alone >= 0).sum()


def test_without_hips_nobody_is_sought_by_hips(five_cameras, two_people, seen_exactly, monkeypatch):
    """No pair of rays meets at a mid-hip, nor at both hips: whatever else is there, nobody is
    found, and fast.
    """
    every = seen_exactly(five_cameras, two_people)
    hips = [BODY_25.root, BODY_25.hips[0]]
    config = PipelineConfig()
    search = StageOne(BODY_25, config.candidates, config.proposals, Notebook()).of_the_rest()
    assert len(search(every, five_cameras)) >= 2
    without = every.only(~np.isin(every.joint, hips) | (every.view == 0))
    assert len(search(without, five_cameras)) == 0
    monkeypatch.setattr("shapepose_fg.proposal.stage_one.vote", None)
    assert len(search(without, five_cameras)) == 0, "not even asked"


def test_what_is_left_out_of_what_evidence_leaves_is_said(
    five_cameras, two_people, seen_exactly, monkeypatch
):
    """14 people on whom no affinities speak, nobody by evidence: over 100 points of a joint, and 50
    candidates.
    """
    monkeypatch.setattr("shapepose_fg.proposal.stage_one._POINTS_OF_FEW", 100)
    beside = np.array([[0.0, 0.3 * n, 0.0] for n in range(7)])
    seen = seen_exactly(five_cameras, (two_people[:, None] + beside[:, None]).reshape(-1, 25, 3))
    seen = replace(seen, pairs=np.zeros((0, 2), dtype=np.intp), affinity=np.zeros(0))
    config, book = PipelineConfig(), Notebook()
    fitter = make_fitter(config.body, BodyModel.default().with_keypoints(BODY_25.joints))
    tracker = Setup(five_cameras, BODY_25, config, fitter).engine(book).tracker
    finish(
        tracker, FollowState(tracker.nobody(), pending=(Input(7, np.zeros(5), seen, five_cameras),))
    )
    assert book.flush().thinned_frames == {"points": [7], "candidates": [7]}


def test_the_surest_of_many_people_are_taken_and_that_is_said(
    five_cameras, two_people, seen_exactly
):
    """Of two people, where one may be found, the one whom all views see: the other one is seen by
    two.
    """
    config, book = PipelineConfig(), Notebook()
    xy, _ = five_cameras.project(two_people)
    seen = seen_exactly(five_cameras, two_people)
    second = np.linalg.norm(xy[seen.view, 1, seen.joint] - seen.xy, axis=1) < 1e-6
    seen = seen.only(~second | (seen.view < 2))
    book.search(7)
    every = StageOne(BODY_25, config.candidates, config.proposals, book)
    assert len(every(seen, five_cameras)) == 2
    one = replace(every, proposals=replace(config.proposals, most_people=1))(seen, five_cameras)
    np.testing.assert_allclose(one.initial, two_people[:1], atol=1e-6)
    assert book.flush().thinned_frames == {"people": [7]}
