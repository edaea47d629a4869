"""The paper's search for people: candidates by votes, hips as anchors, growth by affinities."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.proposal.candidates import CandidateConfig, PairPoints, triangulate_pairs
from shapepose_fg.proposal.hips import Candidates, anchors, grown, people_by_hips, vote
from shapepose_fg.proposal.possible_people import Frame

NECK, WRIST, HIP = (BODY_25.index(name) for name in ("Neck", "RWrist", "MidHip"))


def frame_of(detections: Detections, rig: Rig) -> Frame:
    return Frame(detections, rig, BODY_25, longest_bones(BODY_25))


def points_of(detections: Detections, rig: Rig) -> PairPoints:
    return triangulate_pairs(detections, rig, CandidateConfig.paper())


def one_edge_at_a_time(left, right, score) -> list[int]:
    picked, used_left, used_right = [], set(), set()
    for edge in np.argsort(-score, kind="stable").tolist():
        if left[edge] not in used_left and right[edge] not in used_right:
            picked.append(edge)
            used_left.add(left[edge])
            used_right.add(right[edge])
    return sorted(picked)


@pytest.mark.parametrize(
    ("edges", "ends", "levels"), [(0, 5, 9), (1, 1, 9), (60, 8, 10**6), (400, 30, 4)]
)
def test_matching_equals_picking_one_edge_at_a_time(edges, ends, levels):
    """With 4 levels most scores are equal: ties go to the edge that comes first."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        left, right = rng.integers(ends, size=(2, edges))
        score = rng.integers(levels, size=edges) / levels
        picked = match_best_first(left, right, score)
        assert sorted(picked.tolist()) == one_edge_at_a_time(left, right, score)


def test_candidates_are_the_clusters_of_the_papers_loop(crowded, five_cameras):
    """The most confident point and all within 6 cm, again and again; three votes; the mean."""
    points, frame = points_of(crowded, five_cameras), frame_of(crowded, five_cameras)
    found, left, expected = vote(points, frame), np.ones(len(points.xyz), dtype=bool), []
    for pick in np.argsort(-points.score, kind="stable"):
        if left[pick]:
            near = np.linalg.norm(points.xyz - points.xyz[pick], axis=1) <= 0.06
            members = np.flatnonzero(near & left & (points.joint == points.joint[pick]))
            left[members] = False
            if len(members) >= 3:
                expected.append((points.joint[pick], *points.xyz[members].mean(axis=0)))
    assert len(expected) > 50
    mine = np.column_stack([found.joint, found.xyz])
    np.testing.assert_allclose(sorted(mine.tolist()), sorted(map(list, expected)), atol=1e-9)
    candidate, detection = found.support.T
    assert (found.joint[candidate] == crowded.joint[detection]).all()
    views = candidate * 5 + crowded.view[detection]
    assert len(np.unique(views)) == len(views), "one detection a view"


def test_three_votes_but_two_cameras_have_one(five_cameras, two_people, seen_exactly):
    for cameras, count in ((2, 25), (3, 0)):
        rig = Rig(five_cameras.cameras[:cameras], "z")
        seen = seen_exactly(rig, two_people[:1])
        of_two = seen.only(seen.view < 2)
        assert len(vote(points_of(of_two, rig), frame_of(of_two, rig)).joint) == count
    empty = Detections.empty()
    found = people_by_hips(points_of(empty, five_cameras), frame_of(empty, five_cameras))
    assert len(found) == 0


def test_two_people_are_found_once_each_joint_where_it_is(five_cameras, two_people, seen_exactly):
    seen = seen_exactly(five_cameras, two_people)
    found = people_by_hips(points_of(seen, five_cameras), frame_of(seen, five_cameras))
    apart = np.linalg.norm(found.places[:, None] - two_people, axis=-1).max(axis=-1)
    assert sorted(apart.argmin(axis=1)) == [0, 1] and apart.min(axis=1).max() < 0.01
    assert (found.chosen >= 0).all() and (seen.joint[found.chosen] == np.arange(25)[:, None]).all()


def test_a_hip_needs_nine_parts_of_ten_in_its_box_and_stands_apart(
    five_cameras, two_people, seen_exactly
):
    """Of 15 core joints two may be out of the box: 1 m to the side, 1.2 m up."""
    seen = seen_exactly(five_cameras, two_people[:1])
    frame = frame_of(seen, five_cameras)
    core = np.array(BODY_25.core)
    at = np.zeros((25, 3))
    joint = np.arange(25)
    for far, count in ((1, 1), (2, 0)):
        for away in ([1.1, 0, 0], [0, 0, 1.3]):
            moved = at.copy()
            moved[core[core != HIP][:far]] = away
            made = Candidates(moved, joint, np.full(25, 0.8), np.zeros((0, 2), dtype=np.intp))
            assert len(anchors(made, frame)) == count
    for apart_m, hips in ((0.5, [HIP]), (0.7, [HIP, HIP + 25])):
        xyz = np.concatenate([at, at + np.array([apart_m, 0, 0])])
        made = Candidates(xyz, np.tile(joint, 2), np.full(50, 0.8), np.zeros((0, 2), dtype=np.intp))
        assert anchors(made, frame).tolist() == hips


def test_a_limb_needs_the_affinity_of_the_views_that_see_both_ends(
    five_cameras, two_people, seen_exactly
):
    """A view without an affinity counts against the limb, and so does a length of 0.8 m."""
    seen = seen_exactly(five_cameras, two_people[:1])
    frame = frame_of(seen, five_cameras)
    found = vote(points_of(seen, five_cameras), frame)
    hip, neck = (int(np.flatnonzero(found.joint == joint)[0]) for joint in (HIP, NECK))
    assert grown(np.array([hip]), found, frame)[0, NECK] == neck
    trunk = np.isin(seen.joint[seen.pairs], (HIP, NECK)).all(axis=1)
    weak = replace(seen, affinity=np.where(trunk, 0.19, seen.affinity))
    assert grown(np.array([hip]), found, frame_of(weak, five_cameras))[0, NECK] == -1
    xyz = found.xyz.copy()
    xyz[neck] = xyz[hip] + [0, 0, 0.8]
    assert grown(np.array([hip]), replace(found, xyz=xyz), frame)[0, NECK] == -1


def test_settings_of_the_paper():
    paper = PipelineConfig.paper()
    assert paper.candidates.gate_m >= 10 and paper.candidates.min_angle_deg < 0.01
    assert not paper.proposals.evidence
