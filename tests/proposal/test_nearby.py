"""Lists of what is near, against tables of everybody and everything (`Claims`): the same rule, the same result."""

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.proposal.claims import Claims, mean_affinity, owned, projected_distances
from shapepose_fg.proposal.nearby import nearby, own_affinity
from shapepose_fg.proposal.possible_people import Frame, _claimed
from shapepose_fg.proposal.stage_one import StageOne


@pytest.fixture(scope="module")
def people(two_people, crowded, five_cameras):
    """Four people around those of a crowded frame, a fifth of whose joints are not placed, and what they have."""
    rng = np.random.default_rng(5)
    places = np.concatenate([two_people, two_people[::-1] + np.array([0.02, 0.03, 0.0])])
    places = np.where(rng.random((4, 25, 1)) < 0.2, np.nan, places + rng.normal(0, 0.02, places.shape))
    frame = Frame(crowded, five_cameras, BODY_25, longest_bones(BODY_25))
    own = _claimed(np.tile(two_people, (2, 1, 1)), np.full((4, 25, 5), -1), frame, exclusive=False)
    return places, own, frame


@pytest.mark.parametrize("exclusive", [False, True])
def test_lists_give_what_tables_give(people, crowded, five_cameras, exclusive):
    places, own, frame = people
    distance_m = projected_distances(five_cameras.project(places), crowded.joint, crowded, five_cameras)
    unplaced = np.isnan(places[:, crowded.joint, 0])
    claims = Claims(crowded, BODY_25, 5, distance_m, 0.06**2, distance_m < 0.15, unplaced, 0.5)
    scored = claims.scored(owned(own, len(crowded)))
    expected = claims.matched(scored, None if exclusive else np.arange(4))
    if exclusive:
        claims.share(expected, scored.affinity)
    found = _claimed(places, own, frame, exclusive=exclusive)
    np.testing.assert_array_equal(found, expected)
    lost = np.isnan(places[..., 0])
    assert (found >= 0).mean() > 0.4 and (found[lost] >= 0).any() and (found[lost] < 0).any()


def test_what_is_near_and_how_it_is_tied(people, crowded, five_cameras):
    places, own, _ = people
    table_m = projected_distances(five_cameras.project(places), crowded.joint, crowded, five_cameras)
    near = nearby(places, np.full((4, 25), 0.3), np.array([1, 0, 1, 0]), five_cameras, BODY_25, crowded)
    inside = np.zeros(table_m.shape, dtype=bool)
    inside[near.person, near.detection] = True
    np.testing.assert_array_equal(inside, table_m < 0.3)
    np.testing.assert_allclose(near.distance_m, table_m[near.person, near.detection])
    tied, neighbours = own_affinity(near.person, near.detection, own, crowded, BODY_25)
    mean, count = mean_affinity(owned(own, len(crowded)), crowded, BODY_25, 5)
    np.testing.assert_allclose(tied, mean[near.person, near.detection])
    np.testing.assert_array_equal(neighbours, count[near.person, near.detection])


def test_without_hips_nobody_is_sought_by_hips(five_cameras, two_people, seen_exactly, monkeypatch):
    """No pair of rays meets at a mid-hip, nor at both hips: whatever else is there, nobody is found, and fast."""
    every = seen_exactly(five_cameras, two_people)
    hips = [BODY_25.root, BODY_25.hips[0]]
    config = PipelineConfig()
    search = StageOne(BODY_25, config.candidates, config.proposals, Notebook()).of_the_rest()
    assert len(search(every, five_cameras)) == 2
    without = every.only(~np.isin(every.joint, hips) | (every.view == 0))
    assert len(search(without, five_cameras)) == 0
    monkeypatch.setattr("shapepose_fg.proposal.stage_one.vote", None)
    assert len(search(without, five_cameras)) == 0, "not even asked"
