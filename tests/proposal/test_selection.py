"""Who is there by evidence: people of few views, halves, crossings of rays, and what may not
matter.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs
from shapepose_fg.proposal.people_2d import without_repeats
from shapepose_fg.proposal.possible_people import (
    Frame,
    PossiblePeople,
    connected,
    settled,
    triangulated,
)
from shapepose_fg.proposal.selection import Evidence, choose, existence
from shapepose_fg.simulation import built_in_scene, simulate

HIPS = [8, 9, 12]
UPPER_BODY = [0, 1, 2, 3, 4, 5, 6, 7, 15, 16, 17, 18]


def frame_of(detections: Detections, rig: Rig) -> Frame:
    return Frame(detections, rig, BODY_25, longest_bones(BODY_25))


def chosen(detections: Detections, rig: Rig, least: float = 0.5):
    points = triangulate_pairs(detections, rig, CandidateConfig())
    return choose(points, frame_of(detections, rig), least)


def three(rig: Rig) -> Rig:
    return replace(rig, cameras=rig.cameras[:3])


def every_detection(detections: Detections, views: int) -> np.ndarray:
    """(1, 25, V) all of them as one person's."""
    own = np.full((1, 25, views), -1)
    own[0, detections.joint, detections.view] = np.arange(len(detections))
    return own


@pytest.mark.parametrize("joints", [list(range(25)), UPPER_BODY])
def test_two_of_three_cameras_are_enough(five_cameras, two_people, seen_exactly, joints):
    """Cameras 0 and 1 see one, 1 and 2 the other, whole or from the hips up: no joint has three
    votes.
    """
    rig = three(five_cameras)
    parts = [
        (seen := seen_exactly(rig, two_people[[who]])).only(
            np.isin(seen.view, views) & np.isin(seen.joint, joints)
        )
        for who, views in ((0, (0, 1)), (1, (1, 2)))
    ]
    view, joint, confidence = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("view", "joint", "confidence")
    )
    xy, affinity = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("xy", "affinity")
    )
    pairs = np.concatenate([parts[0].pairs, parts[1].pairs + len(parts[0])])
    both = Detections(view, joint, xy, confidence, pairs, affinity)
    people, sure = chosen(both, rig)
    assert len(people) == 2 and (sure > 0.8).all()
    order = np.argsort(people.places[:, 1, 0])
    np.testing.assert_allclose(people.places[order][:, joints], two_people[:, joints], atol=1e-6)
    assert np.isnan(np.delete(people.places, joints, axis=1)).all()


def test_rays_of_two_people_cross_where_nobody_is(five_cameras, two_people, seen_exactly):
    """Two cameras at one height: heads, hands and feet of different people meet."""
    rig = replace(five_cameras, cameras=five_cameras.cameras[:2])
    people, _ = chosen(seen_exactly(rig, two_people), rig, least=0.1)
    assert len(people) == 2
    order = np.argsort(people.places[:, 1, 0])
    np.testing.assert_allclose(people.places[order], two_people, atol=1e-6)


def test_legs_without_hips_are_the_same_person(five_cameras, two_people, seen_exactly):
    """Nobody sees the hips, and so no affinity leads from the trunk to the legs; bones do."""
    detections = seen_exactly(five_cameras, two_people)
    detections = detections.only(~np.isin(detections.joint, HIPS))
    people, _ = chosen(detections, five_cameras)
    assert len(people) == 2 and (people.chosen >= 0).sum() == 2 * 22 * 5


def test_neither_cameras_nor_detections_have_an_order():
    """Six people before three cameras, as a detector sees them: the same joints, however all is
    listed.
    """
    scene = built_in_scene(3, people=6, cameras=3, frames=2)
    rng = np.random.default_rng(0)
    for seen in simulate(scene, seed=3):
        cameras, rows = rng.permutation(3), rng.permutation(len(seen))
        edges = rng.permutation(len(seen.affinity))
        listed = Detections(
            np.argsort(cameras)[seen.view[rows]], seen.joint[rows], seen.xy[rows],
            seen.confidence[rows], np.argsort(rows)[seen.pairs][edges], seen.affinity[edges],
        )  # fmt: skip
        turned = replace(scene.rig, cameras=tuple(scene.rig.cameras[camera] for camera in cameras))
        found = [find_people(seen, scene.rig, BODY_25, PipelineConfig()).initial]
        found.append(find_people(listed, turned, BODY_25, PipelineConfig()).initial)
        one, other = (each[np.argsort(np.nanmean(each[..., 0], axis=1))] for each in found)
        assert len(one) >= 4
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_who_is_listed_twice_is_there_once(five_cameras, two_people, seen_exactly):
    seen = seen_exactly(five_cameras, two_people)
    count = len(seen)
    twice = Detections(
        np.tile(seen.view, 2), np.tile(seen.joint, 2), np.tile(seen.xy, (2, 1)),
        np.concatenate([seen.confidence, seen.confidence / 2]),
        np.concatenate([seen.pairs, seen.pairs + count]), np.tile(seen.affinity, 2),
    )  # fmt: skip
    once, index = without_repeats(twice)
    assert len(once) == count and (index < count).all()
    people = find_people(twice, five_cameras, BODY_25, PipelineConfig())
    assert len(people) == 2 and (people.candidate < count).all()
    np.testing.assert_array_equal(
        people.confidence, find_people(seen, five_cameras, BODY_25, PipelineConfig()).confidence
    )


def test_a_ray_that_misses_hardly_moves_the_joint(five_cameras, two_people, seen_exactly):
    """One of five views is 30 px off, 10 cm at the joint: a detector's error at most is left of
    it.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    frame = frame_of(detections, five_cameras)
    hypothesis = settled(two_people[:1], every_detection(detections, 5), frame, 1)
    assert (hypothesis.chosen >= 0).all()
    assert np.nanmax(hypothesis.gap_m) < 1e-6
    xy = detections.xy.copy()
    xy[hypothesis.chosen[0, 4, 0]] += [30.0, 0.0]
    places, gap_m = triangulated(
        hypothesis.chosen, frame_of(replace(detections, xy=xy), five_cameras)
    )
    off_m = np.linalg.norm(places[0] - two_people[0], axis=1)
    assert 0 < off_m[4] < 0.03 and np.delete(off_m, 4).max() < 1e-6
    assert gap_m[0, 4, 0] > 3 * np.delete(gap_m[0, 4], 0).max()


def test_joints_hang_together_as_far_as_bones_reach(five_cameras, two_people, seen_exactly):
    places = two_people[:1].copy()
    places[0, [10, 11]] += [2.0, 0.0, 0.0]  # a knee and its ankle
    places[0, 9] = np.nan  # the hip above them
    part = connected(places, frame_of(seen_exactly(five_cameras, two_people), five_cameras))
    assert part[0, 9] == -1 and part[0, 10] == part[0, 11] == 10
    others = np.delete(np.arange(25), [9, 10, 11, 22, 23, 24])
    assert (part[0, others] == 0).all()


def test_what_others_explain_is_no_evidence(five_cameras, two_people, seen_exactly):
    """All detections agree: confidence times affinity each, and what bones count. A double has
    nothing.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    frame = frame_of(detections, five_cameras)
    one = settled(two_people[:1], every_detection(detections, 5), frame, 1)
    evidence = Evidence.of(one, frame)
    nobody_else = np.zeros(len(detections), dtype=bool)
    expected = (detections.confidence * detections.affinity[0]).sum() + evidence.bones[0]
    np.testing.assert_allclose(evidence.score(nobody_else), expected, rtol=1e-6)
    # 125 places without a detection of one's own, in views that see nothing else of the person:
    # 0.07 each.
    np.testing.assert_allclose(
        evidence.score(~nobody_else), -125 * 0.07 + evidence.bones[0], rtol=1e-9
    )
    assert existence(one, frame)[0] > 0.99
    assert existence(type(one).concatenate([one, one]), frame).max() < 0.05


def test_bones_of_usual_length_speak_for_a_person(five_cameras, two_people, seen_exactly):
    """The same pose half again as large, or two thirds as large, is nobody's, though all detections
    agree.
    """

    def bones(size, keep=lambda detections: detections.view >= 0):
        places = two_people[:1] * size
        detections = seen_exactly(five_cameras, places)
        detections = detections.only(keep(detections))
        frame = frame_of(detections, five_cameras)
        return Evidence.of(settled(places, every_detection(detections, 5), frame, 1), frame).bones[
            0
        ]

    assert bones(1.0) - bones(1.5) > 2
    assert bones(1.0) - bones(2 / 3) > 1
    # A wrist that one view sees may be anywhere: its bone says nothing, whatever its length.
    one_view = bones(1.0, lambda detections: (detections.joint != 4) | (detections.view == 0))
    assert 0 < bones(1.0) - one_view < 0.3


def test_a_view_that_misses_a_joint_and_sees_the_rest_speaks_against_it(
    five_cameras, two_people, seen_exactly
):
    """Six joints that one view misses cost more than the same view missing altogether costs for
    them.
    """
    every = seen_exactly(five_cameras, two_people[:1])

    def score(keep):
        detections = every.only(keep)
        frame = frame_of(detections, five_cameras)
        people = settled(two_people[:1], every_detection(detections, 5), frame, 1)
        return Evidence.of(people, frame).score(np.zeros(len(detections), dtype=bool))[0]

    arms = np.isin(every.joint, [2, 3, 4, 5, 6, 7]) & (every.view == 0)
    worth = 0.8 * 0.9  # confidence and affinity of the scene
    lost = score(every.view >= 0) - score(~arms)
    seen = 19 / 25
    assert lost == pytest.approx(6 * (worth + 0.2 * seen + 0.07 * (1 - seen)), rel=0.05)
    hidden = score(every.view >= 0) - score(every.view > 0)
    assert hidden == pytest.approx(25 * (worth + 0.07), rel=0.05)


def test_nobody_is_there_where_nothing_is_seen(five_cameras, nothing=Detections.empty()):
    people, sure = chosen(nothing, five_cameras)
    assert (
        len(people) == len(sure) == 0 == len(PossiblePeople.none(frame_of(nothing, five_cameras)))
    )
