"""Stage I on a crowded frame, against what it is defined to be, worked out one thing at a time."""

import math
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.proposal.candidates import (
    CandidateConfig,
    Candidates,
    PairPoints,
    triangulate_pairs,
    vote,
)
from shapepose_fg.proposal.growth import GrowthConfig, Links, grow, link
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, FrameArrays, Nearby, own_affinity
from shapepose_fg.proposal.proposals import ProposalConfig, Search, standing_apart

CONFIG = CandidateConfig()
GATE_M, ANGLE_DEG, RHO_M = 0.07, 3.0, 0.12
GROWTH = {"view_weight": 0.5, "sweeps": 2, "bridge_m": 0.55}
PROPOSALS = {"box_horizontal_m": 1.0, "box_vertical_m": 1.2, "separation_m": 0.2}
"""What is documented, so that another default is noticed."""


@pytest.fixture(scope="module")
def points(crowded, five_cameras) -> PairPoints:
    return triangulate_pairs(crowded, five_cameras, CONFIG)


@pytest.fixture(scope="module")
def candidates(points, crowded) -> Candidates:
    return vote(points, crowded, 5, CONFIG)


@pytest.fixture(scope="module")
def links(candidates, crowded) -> Links:
    return link(candidates, crowded, GrowthConfig())


@pytest.mark.slow
def test_points_are_the_pairs_whose_rays_meet(points, crowded, five_cameras):
    """Least squares of x P_3 - P_1 and y P_3 - P_2; kept within 7 cm of both, in front, 3 degrees
    apart.
    """
    normalised = five_cameras.normalise(crowded.view, crowded.xy)
    found = {tuple(sorted(pair)): n for n, pair in enumerate(points.pair.tolist())}
    assert len(found) == len(points.xyz)
    kept = 0
    for first, second in combinations(range(len(crowded)), 2):
        if (
            crowded.joint[first] != crowded.joint[second]
            or crowded.view[first] == crowded.view[second]
        ):
            continue
        P = five_cameras.cTw[crowded.view[[first, second]]]
        rows = [
            n * camera[2] - camera[k]
            for camera, xy in zip(P, normalised[[first, second]], strict=True)
            for k, n in enumerate(xy)
        ]
        A = np.array(rows)
        xyz = np.linalg.lstsq(A[:, :3], -A[:, 3], rcond=None)[0]
        at = P[:, :, :3] @ xyz + P[:, :, 3]
        error = np.linalg.norm(at[:, :2] - normalised[[first, second]] * at[:, 2:], axis=1).max()
        rays = np.einsum(
            "vji,vj->vi", P[:, :, :3], np.column_stack([normalised[[first, second]], np.ones(2)])
        )
        cosine = rays[0] @ rays[1] / np.prod(np.linalg.norm(rays, axis=1))
        angle = math.degrees(math.acos(min(1.0, abs(cosine))))
        fits = error < GATE_M and (at[:, 2] > 0).all() and angle > ANGLE_DEG
        assert ((first, second) in found) == fits, (error, angle)
        if fits:
            n = found[first, second]
            np.testing.assert_allclose(points.xyz[n], xyz, atol=1e-9)
            assert points.joint[n] == crowded.joint[first]
            assert points.score[n] == pytest.approx(
                math.sqrt(crowded.confidence[first] * crowded.confidence[second])
            )
            kept += 1
    assert kept > 1000  # not about nothing


def voted(points: PairPoints, crowded, radius_m: float, needed: int, power: int) -> list[tuple]:
    """The paper's loop; centre, score, votes, strong, and the detections of each cluster that is
    kept.
    """
    seed = np.full(len(points.xyz), -1)
    for pick in np.argsort(-points.score, kind="stable"):
        if seed[pick] < 0:
            near = np.linalg.norm(points.xyz - points.xyz[pick], axis=1) <= radius_m
            seed[near & (points.joint == points.joint[pick]) & (seed < 0)] = pick
    clusters = []
    for each in np.unique(seed):
        members = np.flatnonzero(seed == each)
        weight = points.score[members] ** power
        count = Counter(points.pair[members].ravel().tolist())
        best: dict[int, int] = {}
        for row in count:
            rival = best.get(int(crowded.view[row]))
            if rival is None or (count[row], crowded.confidence[row]) > (
                count[rival],
                crowded.confidence[rival],
            ):
                best[int(crowded.view[row])] = row
        support = sorted(best.values(), key=lambda row: int(crowded.view[row]))
        centre = (weight[:, None] * points.xyz[members]).sum(axis=0) / weight.sum()
        score = crowded.confidence[support].mean()
        clusters.append(
            (centre, points.joint[each], score, len(members), len(members) >= needed, support)
        )
    explained = {row for *_, strong, support in clusters if strong for row in support}
    return [each for each in clusters if each[4] or not set(each[5]) <= explained]


@pytest.mark.parametrize(
    ("weighted", "views", "needed"), [(True, 5, 3), (False, 5, 3), (True, 2, 1), (True, 30, 10)]
)
def test_candidates_are_the_clusters_of_the_papers_loop(points, crowded, weighted, views, needed):
    """Before 2 cameras 1 vote makes a candidate strong, before 30 the 10 pairs of 5 views do."""
    candidates = vote(points, crowded, views, CandidateConfig(weighted_centre=weighted))
    expected = voted(points, crowded, RHO_M, needed, 2 if weighted else 0)
    assert len(candidates) == len(expected) > 100
    for n, (centre, joint, score, votes, strong, support) in enumerate(expected):
        np.testing.assert_allclose(candidates.xyz[n], centre, atol=1e-9)
        assert (candidates.joint[n], candidates.votes[n], candidates.strong[n]) == (
            joint,
            votes,
            strong,
        )
        assert candidates.score[n] == pytest.approx(score)
        rows = candidates.support[candidates.support[:, 0] == n, 1]
        assert sorted(rows.tolist(), key=lambda row: int(crowded.view[row])) == support
    if views == 5:
        assert 10 < (~candidates.strong).sum() < len(candidates) - 10
    strong_only = vote(
        points, crowded, views, CandidateConfig(weighted_centre=weighted, weak=False)
    )
    np.testing.assert_allclose(strong_only.xyz, candidates.xyz[candidates.strong])


def test_links_are_the_affinities_of_all_pairs_of_supporting_detections(links, candidates, crowded):
    made_of: dict[int, list[int]] = defaultdict(list)
    for candidate, row in candidates.support.tolist():
        made_of[row].append(candidate)
    views = [
        set(crowded.view[candidates.support[candidates.support[:, 0] == n, 1]])
        for n in range(len(candidates))
    ]
    total: dict[tuple[int, int], float] = defaultdict(float)
    for (head, tail), affinity in zip(
        crowded.pairs.tolist(), crowded.affinity.tolist(), strict=True
    ):
        for first in made_of[head]:
            for second in made_of[tail]:
                total[first, second] += affinity
    expected = {
        ends: value - 0.2 * len(views[ends[0]] & views[ends[1]])
        for ends, value in total.items()
        if np.linalg.norm(candidates.xyz[ends[0]] - candidates.xyz[ends[1]]) < 0.75
    }
    found = {
        tuple(ends): score
        for ends, score in zip(links.ends.tolist(), links.score.tolist(), strict=True)
    }
    assert len(found) == len(links.ends) > 500
    assert found == pytest.approx(expected)


def grown(
    anchors, candidates: Candidates, links: Links, config: SimpleNamespace
) -> NDArray[np.intp]:
    """Outwards from the hip joint by joint level, then all joints again `sweeps` times, then beyond
    gaps.
    """
    depth, parent = {BODY_25.root: 0}, dict(enumerate(BODY_25.parents))
    for level in range(1, 25):
        depth |= {
            joint: level
            for joint, up in parent.items()
            if depth.get(up) == level - 1 and joint not in depth
        }
    evidence = [
        config.view_weight * candidates.score[n] * (candidates.support[:, 0] == n).sum()
        for n in range(len(candidates))
    ]
    edges = [(a, b, s) for (a, b), s in zip(links.ends.tolist(), links.score.tolist(), strict=True)]
    chosen = [{BODY_25.root: int(anchor)} for anchor in anchors]

    def support(person: dict[int, int], downward: bool) -> dict[int, float]:
        has, found = set(person.values()), defaultdict(float)
        for a, b, score in edges:
            for start, end in ((a, b), (b, a)):
                down = parent[int(candidates.joint[end])] == candidates.joint[start]
                if start in has and (down or not downward):
                    found[end] += score
        return found

    def best_first(offers: list[tuple[float, int, int]]) -> bool:
        """Give candidates to people: the best offer first, each candidate to one and each joint
        once.
        """
        taken, filled = set(), set()
        for _, who, n in sorted(offers, key=lambda offer: -offer[0]):
            joint = int(candidates.joint[n])
            if n not in taken and (who, joint) not in filled:
                taken.add(n)
                filled.add((who, joint))
                chosen[who][joint] = n
        return len(filled) > 0

    def choose(joints: set[int], downward: bool) -> None:
        offers = [
            (score + evidence[n], who, n)
            for who, person in enumerate(chosen)
            for n, score in support(person, downward).items()
            if score > 0 and int(candidates.joint[n]) in joints
        ]
        for person in chosen:
            for joint in joints:
                person.pop(joint, None)
        best_first(offers)

    for level in range(1, max(depth.values()) + 1):
        choose({joint for joint, at in depth.items() if at == level}, True)
    for _ in range(config.sweeps):
        choose(set(range(25)) - {BODY_25.root}, False)
    for _ in range(25):
        used = {n for person in chosen for n in person.values()}
        linked = [support(person, False) for person in chosen]
        offers = []
        for who, person in enumerate(chosen):
            for n in sorted(set(range(len(candidates))) - used):
                joint = int(candidates.joint[n])
                if joint in person:
                    continue
                if linked[who].get(n, 0.0) > 0:
                    offers.append((linked[who][n] + evidence[n], who, n))
                elif (
                    config.bridge_m > 0
                    and candidates.strong[n]
                    and all(each.get(n, 0.0) <= 0 for each in linked)
                ):
                    bones, up = 1, parent[joint]
                    while up not in person:
                        bones, up = bones + 1, parent[up]
                    distance = np.linalg.norm(candidates.xyz[person[up]] - candidates.xyz[n])
                    near = 1 - distance / (config.bridge_m * bones)
                    if bones > 1 and near > 0:
                        offers.append((near + evidence[n], who, n))
        if not best_first(offers):
            break
    return np.array([[person.get(joint, -1) for joint in range(25)] for person in chosen])


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"sweeps": 0, "bridge_m": 0.0},
        {"sweeps": 1, "view_weight": 0.0, "bridge_m": 0.0},
        {"sweeps": 3, "view_weight": 2.0, "bridge_m": 1.5},
    ],
)
def test_people_are_grown_level_by_level_then_all_at_once(settings, candidates, links):
    hips = np.flatnonzero((candidates.joint == BODY_25.root) & candidates.strong)
    assert len(hips) >= 4
    expected = grown(hips, candidates, links, SimpleNamespace(**GROWTH | settings))
    np.testing.assert_array_equal(
        grow(hips, candidates, links, BODY_25, GrowthConfig(**settings)), expected
    )


def test_only_what_hangs_on_the_person_is_grown():
    """A wrist that hangs on an elbow, the last candidate of all, that hangs on nobody."""
    hip, elbow, wrist = (BODY_25.index(name) for name in ("MidHip", "RElbow", "RWrist"))
    none = np.zeros((0, 2), dtype=np.intp)
    three = Candidates(
        np.zeros((3, 3)),
        np.array([hip, wrist, elbow]),
        np.ones(3),
        np.full(3, 9),
        np.ones(3, dtype=bool),
        none,
    )
    forearm = Links(np.array([[2, 1]]), np.array([3.0]))
    chosen = grow(np.array([0]), three, forearm, BODY_25, GrowthConfig(bridge_m=0.0))
    assert np.flatnonzero(chosen[0] >= 0).tolist() == [hip]


@pytest.mark.parametrize(("height_m", "taken"), [(0.6, True), (0.2, False)])
def test_a_bridge_begins_at_the_nearest_joint_that_is_known_the_first_candidate_too(
    height_m, taken
):
    """From the neck, the first of all candidates, an elbow is two bones of 0.55 m away; from the
    hip it would be three.
    """
    neck, hip, elbow = (BODY_25.index(name) for name in ("Neck", "MidHip", "RElbow"))
    places = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, 1.0], [0.0, 0.0, height_m]])
    none = np.zeros((0, 2), dtype=np.intp)
    three = Candidates(
        places,
        np.array([neck, hip, elbow]),
        np.ones(3),
        np.full(3, 9),
        np.ones(3, dtype=bool),
        none,
    )
    chosen = grow(
        np.array([1]), three, Links(np.array([[1, 0]]), np.array([3.0])), BODY_25, GrowthConfig()
    )
    assert chosen[0, [neck, hip]].tolist() == [0, 1] and (chosen[0, elbow] == 2) == taken


def test_the_settings_of_growth_make_a_difference_here(candidates, links):
    """Or the test above would say little: views, sweeps and bridges each change somebody's
    joints.
    """
    hips = np.flatnonzero(candidates.joint == BODY_25.root)
    plain = grow(hips, candidates, links, BODY_25, GrowthConfig())
    for other in (
        GrowthConfig(sweeps=0),
        GrowthConfig(view_weight=0.0),
        GrowthConfig(bridge_m=0.0),
    ):
        assert (grow(hips, candidates, links, BODY_25, other) != plain).any(), other


def test_an_overlap_serves_only_joints_that_have_nothing_of_their_own():
    """Two noses in one view: who has the first of all detections keeps it, who has none gets the
    nearer one.
    """
    nose = BODY_25.index("Nose")
    chosen = np.full((2, 25, 1), -1, dtype=np.intp)
    chosen[0, nose, 0] = 0
    first = np.where(np.arange(26) > nose, 4, 0)
    near = Nearby(
        first, np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0.03, 0.01, 0.02, 0.024])
    )
    near.share(np.full(4, LEAST_AFFINITY), chosen)
    assert chosen[:, nose, 0].tolist() == [0, 0]
    chosen[1] = -1
    near = replace(near, distance_m=np.array([0.03, 0.01, 0.024, 0.02]))
    near.share(np.full(4, LEAST_AFFINITY), chosen)
    assert chosen[:, nose, 0].tolist() == [0, 1] and (np.delete(chosen, nose, axis=1) == -1).all()


def test_mean_affinity_is_over_the_neighbours_that_the_person_owns_in_that_view(
    crowded, five_cameras
):
    """A pair that is not listed counts 0; without a neighbour there is none, and the mean is 0."""
    rng = np.random.default_rng(0)
    own, owns = np.full((3, 25, 5), -1), np.zeros((3, len(crowded)), dtype=bool)
    for person, row in np.argwhere(rng.random(owns.shape) < 0.3).tolist():
        own[person, crowded.joint[row], crowded.view[row]] = row  # the last of a joint in a view
    owns[np.nonzero(own >= 0)[0], own[own >= 0]] = True
    arrays = FrameArrays.of(crowded, five_cameras, BODY_25)
    every = [np.ascontiguousarray(index.ravel()) for index in np.indices(owns.shape)]
    affinity, neighbours = (each.reshape(owns.shape) for each in own_affinity(*every, own, arrays))
    listed = {
        tuple(pair): value
        for pair, value in zip(crowded.pairs.tolist(), crowded.affinity, strict=True)
    }
    for person, row in zip(*(index.ravel() for index in np.indices(owns.shape)), strict=True):
        total, there = 0.0, set()
        for other in np.flatnonzero(owns[person] & (crowded.view == crowded.view[row])).tolist():
            joined = tuple(sorted((crowded.joint[row], crowded.joint[other])))
            if joined in {tuple(sorted(limb)) for limb in BODY_25.limbs}:
                there.add(int(crowded.joint[other]))
                total += listed.get((row, other), listed.get((other, row), 0.0))
        assert neighbours[person, row] == len(there)
        assert affinity[person, row] == pytest.approx(total / max(len(there), 1))


def boxes(roots, candidates: Candidates, config: SimpleNamespace) -> list[tuple[float, float]]:
    """Share of core joints with a candidate in each root's box, and the mean confidence of the best
    of each.
    """
    found = []
    for root in roots:
        best: dict[int, float] = {}
        for xyz, joint, score in zip(
            candidates.xyz, candidates.joint.tolist(), candidates.score, strict=True
        ):
            x, y, z = np.abs(xyz - candidates.xyz[root])
            if (
                math.hypot(x, y) < config.box_horizontal_m
                and z < config.box_vertical_m
                and joint in BODY_25.core
            ):
                best[joint] = max(best.get(joint, 0.0), score)
        found.append((len(best) / len(BODY_25.core), sum(best.values()) / max(len(best), 1)))
    return found


def apart(anchors, taken, candidates: Candidates, crowded, config: SimpleNamespace) -> list[int]:
    """Anchors by falling confidence of their own detections, without those near a better one."""
    made_of = {
        n: set(candidates.support[candidates.support[:, 0] == n, 1].tolist())
        for n in [*taken, *anchors]
    }
    kept, waiting, first = [], list(anchors), list(taken)
    while True:
        if first:
            best = first.pop(0)
        elif waiting:
            best = max(waiting, key=lambda n: sum(crowded.confidence[row] for row in made_of[n]))
            kept.append(best)
        else:
            return kept
        used = set(made_of[best])
        made_of = {n: each - used for n, each in made_of.items()}
        far = np.linalg.norm(candidates.xyz - candidates.xyz[best], axis=1) >= config.separation_m
        waiting = [n for n in waiting if n != best and far[n]]


def test_anchors_stand_apart_in_space_and_by_their_detections(candidates, crowded):
    config, stated = ProposalConfig(), SimpleNamespace(**PROPOSALS)
    hips = np.flatnonzero(candidates.joint == BODY_25.root)
    assert len(hips) > 3
    expected = apart(hips.tolist(), [], candidates, crowded, stated)
    assert standing_apart(hips, hips[:0], candidates, crowded, config).tolist() == expected
    taken = expected[1:2]
    others = [n for n in hips.tolist() if n not in taken]
    beside = apart(others, taken, candidates, crowded, stated)
    assert (
        standing_apart(np.array(others), np.array(taken), candidates, crowded, config).tolist()
        == beside
    )
    assert 1 <= len(expected) <= len(hips)


def search(candidates: Candidates, links: Links, crowded, **settings) -> Search:
    up = np.array([0.0, 0.0, 1.0])
    return Search(candidates, links, crowded, BODY_25, up, ProposalConfig(**settings), Counter())


@pytest.mark.parametrize("settings", [{}, {"box_horizontal_m": 0.3, "box_vertical_m": 0.5}])
def test_boxes_are_as_wide_and_as_high_as_is_said(candidates, links, crowded, settings):
    roots = np.flatnonzero(candidates.joint == BODY_25.root)
    parts, score = search(candidates, links, crowded, **settings).boxes(roots)
    expected = boxes(roots, candidates, SimpleNamespace(**PROPOSALS | settings))
    np.testing.assert_allclose(np.column_stack([parts, score]), expected)
    assert len(set(score.tolist())) > 1


def test_reasons_are_counted_once_for_each_anchor(candidates, links, crowded):
    """Two bounds that some of the hips miss; 1 of those that are left is looked for."""
    roots = np.flatnonzero(candidates.joint == BODY_25.root)
    parts, score = np.array(
        boxes(roots, candidates, SimpleNamespace(**PROPOSALS | {"box_horizontal_m": 0.3}))
    ).T
    least, doubt = np.median(parts), np.median(score)
    here = search(
        candidates,
        links,
        crowded,
        box_horizontal_m=0.3,
        min_parts=least,
        min_confidence=doubt,
        most_people=1,
    )
    kept = here.anchors(roots, roots[:0])
    good = roots[(parts >= least) & (score >= doubt)]
    stand = apart(good.tolist(), [], candidates, crowded, SimpleNamespace(**PROPOSALS))
    assert kept.tolist() == stand[:1] and len(stand) > 1
    assert +here.dropped == +Counter(
        {
            "too few parts in the box": int((parts < least).sum()),
            "low confidence": int(((parts >= least) & (score < doubt)).sum()),
            "hip seen as a better one's": len(good) - len(stand),
            "more people than are looked for": len(stand) - 1,
        }
    )


def test_middles_of_two_hips_are_roots_of_last_resort(candidates, links, crowded):
    """Between a free right and a free left hip at most 40 cm apart, one of them strong; of too many
    the best.
    """
    free = np.random.default_rng(0).random(len(candidates)) < 0.8
    right, left = BODY_25.hips
    pairs = [
        (first, second)
        for first in np.flatnonzero(free & (candidates.joint == right)).tolist()
        for second in np.flatnonzero(free & (candidates.joint == left)).tolist()
        if np.linalg.norm(candidates.xyz[first] - candidates.xyz[second]) < 0.4
        and (candidates.strong[first] or candidates.strong[second])
    ]
    score = np.array([candidates.score[list(pair)].mean() for pair in pairs])
    for most in (64, 1):
        more = search(candidates, links, crowded, most_people=most).with_middles(free)
        chosen = sorted(np.argsort(-score, kind="stable")[: 4 * most].tolist())
        assert len(pairs) > 4 and len(chosen) == min(4 * most, len(pairs))
        count, added = len(candidates), more.candidates
        assert len(added) == count + len(chosen)
        ends = []
        for n, (first, second) in enumerate((pairs[k] for k in chosen), count):
            np.testing.assert_allclose(
                added.xyz[n], (candidates.xyz[first] + candidates.xyz[second]) / 2
            )
            assert added.score[n] == pytest.approx(candidates.score[[first, second]].mean())
            assert added.votes[n] == candidates.votes[[first, second]].min()
            assert (added.joint[n], added.strong[n]) == (BODY_25.root, False)
            rows = [
                candidates.support[candidates.support[:, 0] == each, 1].tolist()
                for each in (n, first)
            ]
            assert added.support[added.support[:, 0] == n, 1].tolist() == rows[1]
            ends += [(n, first), (n, second)]
        new = more.links.ends[len(links.ends) :]
        assert sorted(map(tuple, new.tolist())) == sorted(ends)
        assert (more.links.score[len(links.ends) :] == 1.0).all()


def test_unclaimed_are_candidates_with_detections_of_their_own(candidates, links, crowded):
    """Two views' worth of detections that nobody's chosen candidate is made of."""
    hips = np.flatnonzero((candidates.joint == BODY_25.root) & candidates.strong)[:2]
    chosen = grow(hips, candidates, links, BODY_25, GrowthConfig())
    claimed = set(chosen[chosen >= 0].tolist())
    used = {row for n, row in candidates.support.tolist() if n in claimed}
    own = Counter(n for n, row in candidates.support.tolist() if row not in used)
    free = search(candidates, links, crowded).unclaimed(chosen)
    assert free is not None and free.tolist() == [own[n] >= 2 for n in range(len(candidates))]
    joints = {
        int(candidates.joint[n])
        for n in range(len(candidates))
        if free[n] and candidates.strong[n] and candidates.joint[n] in BODY_25.core
    }
    share = len(joints) / len(BODY_25.core)
    assert search(candidates, links, crowded, min_grown_parts=share).unclaimed(chosen) is not None
    assert (
        search(candidates, links, crowded, min_grown_parts=min(1.0, share + 0.01)).unclaimed(chosen)
        is None
        or share == 1
    )


def test_the_least_share_of_grown_joints_counts_every_candidate(crowded):
    """Six of the 15 core joints are linked to the hip, 40 %: one fewer, and nobody is there."""
    names = ("RHip", "LHip", "Neck", "RKnee", "LKnee", "MidHip")
    joint = np.array([BODY_25.index(name) for name in names])
    assert set(joint.tolist()) <= set(BODY_25.core) and len(BODY_25.core) == 15
    none = np.zeros((0, 2), dtype=np.intp)
    six = Candidates(
        np.zeros((6, 3)), joint, np.full(6, 0.8), np.full(6, 3), np.ones(6, dtype=bool), none
    )
    limbs = Links(np.array([[5, 0], [5, 1], [5, 2], [0, 3], [1, 4]]), np.full(5, 2.0))
    here = search(six, limbs, crowded)
    anchors, chosen = here.linked(np.array([5]))
    assert anchors.tolist() == [5] and chosen[0, joint].tolist() == list(range(6))
    weak = replace(six, strong=np.arange(6) != 0)
    assert len(search(weak, limbs, crowded).linked(np.array([5]))[0]) == 0


def backwards(skeleton: Skeleton) -> Skeleton:
    """The same with its joints in the other order: the nose, a core joint, is the last of
    BODY_25's.
    """
    last = len(skeleton) - 1
    return replace(
        skeleton,
        joints=skeleton.joints[::-1],
        limbs=tuple((last - a, last - b) for a, b in skeleton.limbs),
        parents=tuple(last - up if up >= 0 else -1 for up in skeleton.parents[::-1]),
        mirror=tuple(last - other for other in skeleton.mirror[::-1]),
        core=tuple(sorted(last - joint for joint in skeleton.core)),
    )


@pytest.mark.parametrize("skeleton", [BODY_25, backwards(BODY_25)])
def test_among_the_free_only_these_count(candidates, links, crowded, skeleton):
    """Boxes, roots, links and who is grown are as if there were no other candidates at all."""
    joint = candidates.joint if skeleton == BODY_25 else 24 - candidates.joint
    candidates = replace(candidates, joint=joint)
    free = np.random.default_rng(1).random(len(candidates)) < 0.5
    whole = replace(search(candidates, links, crowded), skeleton=skeleton)
    whole.dropped["low confidence"] = 1
    here = whole.among(free)
    left, place = np.flatnonzero(free), np.cumsum(free) - 1
    rows = candidates.support[free[candidates.support[:, 0]]]
    columns = {
        name: getattr(candidates, name)[left]
        for name in ("xyz", "joint", "score", "votes", "strong")
    }
    only = Candidates(**columns, support=np.stack([place[rows[:, 0]], rows[:, 1]], axis=1))
    both = free[links.ends].all(axis=1)
    alone = replace(whole, candidates=only, links=Links(place[links.ends[both]], links.score[both]))
    roots = np.flatnonzero(only.joint == skeleton.root)
    assert len(roots) >= 1
    np.testing.assert_array_equal(here.boxes(left[roots]), alone.boxes(roots))
    grown_here, grown_alone = (
        grow(anchors, each.candidates, each.links, skeleton, GrowthConfig())
        for each, anchors in ((here, left[roots]), (alone, roots))
    )
    np.testing.assert_array_equal(grown_here, np.where(grown_alone >= 0, left[grown_alone], -1))
    none = np.zeros(0, dtype=int)
    np.testing.assert_array_equal(here.people(none), left[alone.people(none)])
    assert whole.among(free).dropped == Counter(), "what it drops is counted by itself"
