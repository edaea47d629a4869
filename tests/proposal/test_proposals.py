"""Stage I (d): anchors at hips, affinities between candidates, people grown along the skeleton."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.greedy_matching import match_best_first
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.association import associate
from shapepose_fg.proposal.candidates import CandidateConfig, Candidates, triangulate_pairs, vote
from shapepose_fg.proposal.growth import GrowthConfig, Links, grow, link
from shapepose_fg.proposal.proposals import ProposalConfig, Proposals, propose
from shapepose_fg.simulation.scene import ring_of_cameras

UP = np.array([0.0, 0.0, 1.0])
NECK, ELBOW, WRIST, HIP = (BODY_25.index(name) for name in ("Neck", "RElbow", "RWrist", "MidHip"))


def candidates_of(detections: Detections, rig: Rig) -> Candidates:
    config = CandidateConfig()
    return vote(triangulate_pairs(detections, rig, config), detections, len(rig), config)


def find(detections: Detections, rig: Rig, **settings) -> tuple[Proposals, Candidates]:
    candidates = candidates_of(detections, rig)
    return propose(candidates, detections, BODY_25, UP, ProposalConfig(**settings)), candidates


def made(joint: list[int], xyz: NDArray[np.float64] | None = None, support=()) -> Candidates:
    """Candidates as if from many views, all strong and of one confidence."""
    count = len(joint)
    return Candidates(
        xyz=np.zeros((count, 3)) if xyz is None else xyz,
        joint=np.array(joint),
        score=np.full(count, 0.8),
        votes=np.full(count, 10),
        strong=np.ones(count, dtype=bool),
        support=np.array(support, dtype=np.intp).reshape(-1, 2),
    )


def with_hip(
    candidates: Candidates, xyz: NDArray[np.float64], votes: int, support: list[int]
) -> Candidates:
    """One more hip candidate, at `xyz`, made from the detections `support`."""
    rows = np.array([[len(candidates), detection] for detection in support])
    return Candidates(
        np.vstack([candidates.xyz, xyz]),
        np.append(candidates.joint, HIP),
        np.append(candidates.score, 0.8),
        np.append(candidates.votes, votes),
        np.append(candidates.strong, True),
        np.vstack([candidates.support, rows]),
    )


def assert_joints(
    proposals: Proposals,
    candidates: Candidates,
    people: NDArray[np.float64],
    within_m: float = 0.005,
) -> None:
    """Everybody is found once, each joint where it is: exact detections leave millimetres of
    clustering.
    """
    assert len(proposals) == len(people)
    assert (proposals.candidate >= 0).all()
    found = candidates.xyz[proposals.candidate]
    distance = np.linalg.norm(found[:, None] - people[None], axis=-1).max(axis=-1)
    assert sorted(distance.argmin(axis=1)) == list(range(len(people)))
    assert distance.min(axis=1).max() < within_m
    np.testing.assert_array_equal(
        candidates.joint[proposals.candidate], np.tile(np.arange(25), (len(people), 1))
    )


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


def test_links_are_the_sums_of_affinity_less_doubt_over_the_views_that_see_both():
    """Candidates: neck A; hips B (with A in views 0 1 2), C (views 0 2) and D (view 1).

    A-B: 0.9 + 0.8 and view 2 silent: 1.7 - 3 x 0.2. A-C: 0.1 and view 2 silent: 0.1 - 2 x 0.2. A-D:
    D is made from the same detection in view 1 as B: 0.8 - 0.2. B and D are two hips, which no limb
    joins.
    """
    view = np.array([0, 1, 2, 0, 1, 2, 0, 2])
    joint = np.array([NECK] * 3 + [HIP] * 5)
    pairs, affinity = np.array([[0, 3], [1, 4], [0, 6]]), np.array([0.9, 0.8, 0.1])
    detections = Detections(view, joint, np.zeros((8, 2)), np.full(8, 0.8), pairs, affinity)
    A, B, C, D = range(4)
    support = [[A, 0], [A, 1], [A, 2], [B, 3], [B, 4], [B, 5], [C, 6], [C, 7], [D, 4]]
    candidates = made([NECK, HIP, HIP, HIP], support=support)
    links = link(candidates, detections, GrowthConfig(doubt=0.2))
    found = {
        tuple(ends): score
        for ends, score in zip(links.ends.tolist(), links.score.tolist(), strict=True)
    }
    assert found == pytest.approx({(A, B): 1.1, (A, C): -0.3, (A, D): 0.6})
    far = replace(candidates, xyz=np.array([[0, 0, 0], [0, 0, 0.8], [0, 0, 0.5], [0, 0, 0.5]]))
    assert [A, B] not in link(far, detections, GrowthConfig(max_limb_m=0.75)).ends.tolist()
    assert [A, C] in link(far, detections, GrowthConfig(max_limb_m=0.75)).ends.tolist()


def arms(wrist_links: list[float]) -> tuple[Candidates, Links]:
    """Two people's hip, neck, shoulder, elbow, and two wrists; scores elbow-wrist as 00 01 10
    11.
    """
    chain = [HIP, NECK, BODY_25.index("RShoulder"), ELBOW]
    candidates = made([*chain, *chain, WRIST, WRIST])
    ends = [[1, 0], [1, 2], [2, 3], [5, 4], [5, 6], [6, 7], [3, 8], [3, 9], [7, 8], [7, 9]]
    return candidates, Links(np.array(ends), np.array([3.0] * 6 + wrist_links))


def grown(candidates: Candidates, links: Links) -> NDArray[np.intp]:
    return grow(np.array([0, 4]), candidates, links, BODY_25, GrowthConfig())


def test_each_person_grows_along_its_own_links():
    chosen = grown(*arms([2.0, -0.5, -0.5, 2.0]))
    joints = [HIP, NECK, BODY_25.index("RShoulder"), ELBOW, WRIST]
    np.testing.assert_array_equal(chosen[:, joints], [[0, 1, 2, 3, 8], [4, 5, 6, 7, 9]])
    assert (np.delete(chosen, joints, axis=1) == -1).all(), "nothing else was there to be chosen"


def test_affinities_decide_whose_wrist_it_is():
    np.testing.assert_array_equal(grown(*arms([2.0, 0.1, 0.1, 2.0]))[:, WRIST], [8, 9])
    np.testing.assert_array_equal(grown(*arms([0.1, 2.0, 2.0, 0.1]))[:, WRIST], [9, 8])


def test_one_candidate_serves_one_person():
    # Both want wrist 8; the first is linked better. The second has no other, or takes the other.
    np.testing.assert_array_equal(grown(*arms([2.0, -1.0, 1.5, -1.0]))[:, WRIST], [8, -1])
    np.testing.assert_array_equal(grown(*arms([2.0, -1.0, 1.5, 0.5]))[:, WRIST], [8, 9])


def test_what_the_views_speak_against_is_not_chosen():
    np.testing.assert_array_equal(grown(*arms([-0.1, -0.2, 0.0, -0.3]))[:, WRIST], [-1, -1])


def test_two_people_are_found_once_each(five_cameras, two_people, seen_exactly):
    proposals, candidates = find(seen_exactly(five_cameras, two_people), five_cameras)
    assert_joints(proposals, candidates, two_people)
    np.testing.assert_allclose(proposals.score, 0.8)


def test_crossed_arms_do_not_change_hands(five_cameras, two_people, seen_exactly):
    """Each one's right wrist is at the other's right elbow, 7 cm from it and 24 cm from its own."""
    people = two_people + np.array([[0.2, 0.0, 0.0], [-0.2, 0.0, 0.0]])[:, None]
    people[:, ELBOW] = [[-0.1, -0.3, 1.2], [0.1, -0.35, 1.25]]
    people[:, WRIST] = [[0.12, -0.4, 1.2], [-0.12, -0.3, 1.15]]
    reach = np.linalg.norm(people[:, None, WRIST] - people[None, :, ELBOW], axis=-1)
    assert (np.diag(reach) > 2 * np.diag(reach[::-1])).all()
    proposals, candidates = find(seen_exactly(five_cameras, people), five_cameras)
    # Points from one's ray and the other's lie in the clusters too; a wrist of the other is 24 cm
    # away, the own one less than half as far.
    assert_joints(proposals, candidates, people, within_m=0.12)


def test_an_embrace_is_two_people(five_cameras, two_people, seen_exactly):
    """Hips 30 cm apart: more than the suppression of near-duplicates may swallow."""
    facing = np.stack([two_people[0], two_people[0] * [-1, -1, 1] + [-0.9, 0.3, 0]])
    assert np.linalg.norm(facing[0, HIP] - facing[1, HIP]) == pytest.approx(0.3)
    proposals, candidates = find(seen_exactly(five_cameras, facing), five_cameras)
    assert len(proposals) == 2
    places = candidates.xyz[proposals.candidate]
    distance = np.linalg.norm(places[:, None] - facing[None], axis=-1)
    own = distance.mean(axis=-1).argmin(axis=1)
    assert sorted(own) == [0, 1]
    # A cluster is dragged by points where rays of both cross, at most by about its radius of 12 cm.
    assert np.median(distance[[0, 1], own]) < 0.02 and distance[[0, 1], own].max() < 0.15


@pytest.mark.parametrize(
    ("unseen", "beyond"), [("LKnee", "LAnkle"), ("RElbow", "RWrist"), ("RShoulder", "RWrist")]
)
def test_a_limb_goes_on_beyond_a_joint_that_nobody_saw(
    five_cameras, two_people, seen_exactly, unseen, beyond
):
    detections = without(seen_exactly(five_cameras, two_people), BODY_25.index(unseen))
    proposals, candidates = find(detections, five_cameras)
    far = BODY_25.index(beyond)
    found = candidates.xyz[proposals.candidate[:, far]]
    distance = np.linalg.norm(found[:, None] - two_people[None, :, far], axis=-1)
    assert (proposals.candidate[:, far] >= 0).all() and (distance.min(axis=0) < 0.005).all()
    hips = candidates.xyz[proposals.candidate[:, HIP]]
    own = np.linalg.norm(hips[:, None] - two_people[None, :, HIP], axis=-1).argmin(axis=1)
    assert (distance.argmin(axis=1) == own).all(), "each got the own one"
    assert (proposals.candidate[:, BODY_25.index(unseen)] == -1).all()


def test_a_hidden_forearm_does_not_hide_the_person(five_cameras, two_people, seen_exactly):
    detections = without(seen_exactly(five_cameras, two_people[:1]), ELBOW, WRIST)
    assert len(find(detections, five_cameras)[0]) == 1
    assert len(find(detections, five_cameras, min_parts=0.9)[0]) == 0, "the paper's 90 % would"


def test_a_person_whose_hip_nobody_saw_is_anchored_between_the_hips(
    five_cameras, two_people, seen_exactly
):
    xy, _ = five_cameras.project(two_people[1, HIP])
    everything = seen_exactly(five_cameras, two_people)
    of_second = np.linalg.norm(everything.xy - xy[everything.view], axis=1) < 1e-6
    for views in (0, 1, 2):
        hidden = of_second & (everything.joint == HIP) & (everything.view >= views)
        proposals, candidates = find(everything.only(~hidden), five_cameras)
        assert len(proposals) == 2, f"MidHip seen by {views} views"
        places = proposals.places[
            np.linalg.norm(proposals.places[:, HIP] - two_people[1, HIP], axis=1).argmin()
        ]
        np.testing.assert_allclose(places, two_people[1], atol=0.01)
        assert candidates.joint[proposals.candidate[proposals.candidate >= 0]].shape == (
            50 - (views < 2),
        )


def without(detections: Detections, *joints: int) -> Detections:
    """The same detections, of some joints none."""
    return detections.only(~np.isin(detections.joint, joints))


def test_a_person_whom_the_detector_doubts_is_dropped_with_a_reason(
    five_cameras, two_people, seen_exactly
):
    apart = two_people + np.array([[-0.8, 0.0, 0.0], [0.8, 0.0, 0.0]])[:, None]
    detections = seen_exactly(five_cameras, apart)
    xy, _ = five_cameras.project(apart[1])
    doubted = np.linalg.norm(detections.xy - xy[detections.view, detections.joint], axis=1) < 1e-6
    detections = replace(detections, confidence=np.where(doubted, 0.15, detections.confidence))
    proposals, candidates = find(detections, five_cameras, min_confidence=0.3)
    assert_joints(proposals, candidates, apart[:1])
    assert {reason for reason, count in proposals.dropped.items() if count > 0} == {
        "low confidence"
    }
    assert_joints(*find(detections, five_cameras, min_confidence=0.1), apart)


def test_a_hip_without_a_body_is_nobody(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(
        five_cameras, np.stack([two_people[0], two_people[1] + [2.0, 0.0, 0.0]])
    )
    candidates = candidates_of(detections, five_cameras)
    of_second = candidates.xyz[:, 0] > 1.2
    joint = np.where(of_second & (candidates.joint != HIP), BODY_25.index("Nose"), candidates.joint)
    proposals = propose(replace(candidates, joint=joint), detections, BODY_25, UP, ProposalConfig())
    assert_joints(proposals, candidates, two_people[:1])
    assert sum(proposals.dropped.values()) >= 1


@pytest.mark.parametrize("beside_m", [0.05, 0.15])
def test_the_same_hip_twice_is_one_person(five_cameras, two_people, seen_exactly, beside_m):
    detections = seen_exactly(five_cameras, two_people)
    candidates = candidates_of(detections, five_cameras)
    hips = np.flatnonzero((detections.joint == HIP) & (detections.view < 3))
    twice = with_hip(
        candidates, two_people[0, HIP] + [0, beside_m, 0], votes=3, support=hips.tolist()
    )
    proposals = propose(twice, detections, BODY_25, UP, ProposalConfig())
    assert_joints(proposals, twice, two_people)
    assert sum(proposals.dropped.values()) >= 1


def test_a_phantom_where_rays_of_different_people_cross_is_dropped(
    five_cameras, two_people, seen_exactly
):
    """A hip between the two, made from one's detection in two views and the other's in a third: its
    box is full of their joints, and the affinities link it to both.
    """
    detections = seen_exactly(five_cameras, two_people)
    candidates = candidates_of(detections, five_cameras)
    xy, _ = five_cameras.project(two_people[:, HIP])
    rows = [
        int(np.linalg.norm(detections.xy - xy[view, person], axis=1).argmin())
        for view, person in ((0, 0), (1, 1), (2, 0))
    ]
    assert (detections.joint[rows] == HIP).all()
    ghost = with_hip(candidates, two_people[:, HIP].mean(axis=0), votes=3, support=rows)
    proposals = propose(ghost, detections, BODY_25, UP, ProposalConfig())
    people, unclaimed = associate(
        proposals, ghost, detections, five_cameras, BODY_25, ProposalConfig()
    )
    hips = people.initial[:, HIP]
    np.testing.assert_allclose(hips[hips[:, 0].argsort()], two_people[:, HIP], atol=0.005)
    assert unclaimed + sum(proposals.dropped.values()) >= 1


def test_the_order_of_the_detections_does_not_matter(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people)
    order = np.random.default_rng(1).permutation(len(detections))
    place = np.argsort(order)
    shuffled = Detections(
        detections.view[order],
        detections.joint[order],
        detections.xy[order],
        detections.confidence[order],
        place[detections.pairs],
        detections.affinity,
    )
    proposals, candidates = find(shuffled, five_cameras)
    assert_joints(proposals, candidates, two_people)


def test_nobody_is_an_empty_answer(five_cameras, two_people, seen_exactly):
    proposals, _ = find(Detections.empty(), five_cameras)
    assert len(proposals) == 0 and proposals.candidate.shape == (0, 25)
    assert sum(proposals.dropped.values()) == 0
    one_view = seen_exactly(five_cameras, two_people)
    only = np.flatnonzero(one_view.view == 0)
    alone = Detections(
        one_view.view[only],
        one_view.joint[only],
        one_view.xy[only],
        one_view.confidence[only],
        np.zeros((0, 2), dtype=np.intp),
        np.zeros(0),
    )
    assert len(find(alone, five_cameras)[0]) == 0


def crowd(people: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(count, 25, 3) copies of the first on a grid of 0.7 m by 0.6 m."""
    x, y = np.divmod(np.arange(count), 3)
    shift = np.stack([(x - x.mean()) * 0.7, (y - 1) * 0.6, np.zeros(count)], axis=1)
    return people[0] - people[0, HIP] * [1, 1, 0] + shift[:, None]


@pytest.mark.parametrize(
    ("cameras", "people", "found", "most"),
    [(2, 4, 3, 10), (2, 12, 1, 60), (3, 12, 11, 20), (6, 12, 12, 20), (30, 2, 2, 4)],
)
def test_from_two_cameras_to_thirty_and_up_to_a_dozen_people(
    two_people, seen_exactly, cameras, people, found, most
):
    """Many views make chance crossings, most of which end as nobody. A dozen people before two
    views cross in many more places than they stand: nobody shares a joint, and somebody is
    right.
    """
    rig = ring_of_cameras(cameras, np.random.default_rng(0))
    truth = crowd(two_people, people)
    detections = seen_exactly(rig, truth)
    proposals, candidates = find(detections, rig)
    used = proposals.candidate[proposals.candidate >= 0]
    assert len(np.unique(used)) == len(used), "a candidate serves one person"
    observations, _ = associate(proposals, candidates, detections, rig, BODY_25, ProposalConfig())
    assert found <= len(observations) <= most
    distance = np.linalg.norm(observations.initial[:, None, HIP] - truth[None, :, HIP], axis=-1)
    # Points that cross by chance near a hip join its cluster and move its centre a little.
    assert (distance.min(axis=0) < 0.03).sum() >= found


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"separation_m": 0.0}, "separation_m must be positive"),
        ({"min_parts": 1.1}, "min_parts must be between"),
    ],
)
def test_refuses_settings_that_make_no_sense(settings, message):
    with pytest.raises(ValueError, match=message):
        ProposalConfig(**settings)
