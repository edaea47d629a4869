"""Stage I on a crowded frame, against what it is defined to be, worked out one thing at a time."""

import math
from collections import Counter, defaultdict
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.proposal.association import mean_affinity
from shapepose_fg.proposal.candidates import CandidateConfig, Candidates, PairPoints, triangulate_pairs, vote
from shapepose_fg.proposal.growth import GrowthConfig, Links, grow, link
from shapepose_fg.skeleton import BODY_25

CONFIG = CandidateConfig()


@pytest.fixture(scope="module")
def points(crowded, five_cameras) -> PairPoints:
    return triangulate_pairs(crowded, five_cameras, CONFIG)


@pytest.fixture(scope="module")
def candidates(points, crowded) -> Candidates:
    return vote(points, crowded, 5, CONFIG)


@pytest.fixture(scope="module")
def links(candidates, crowded) -> Links:
    return link(candidates, crowded, GrowthConfig())


def test_points_are_the_pairs_whose_rays_meet(points, crowded, five_cameras):
    """Least squares of x P_3 - P_1 and y P_3 - P_2; kept within 7 cm of both, in front, 3 degrees apart."""
    normalised = five_cameras.normalise(crowded.view, crowded.xy)
    found = {tuple(sorted(pair)): n for n, pair in enumerate(points.pair.tolist())}
    assert len(found) == len(points.xyz)
    kept = 0
    for first, second in combinations(range(len(crowded)), 2):
        if crowded.joint[first] != crowded.joint[second] or crowded.view[first] == crowded.view[second]:
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
        rays = np.einsum("vji,vj->vi", P[:, :, :3], np.column_stack([normalised[[first, second]], np.ones(2)]))
        cosine = rays[0] @ rays[1] / np.prod(np.linalg.norm(rays, axis=1))
        angle = math.degrees(math.acos(min(1.0, abs(cosine))))
        fits = error < CONFIG.gate_m and (at[:, 2] > 0).all() and angle > CONFIG.min_angle_deg
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
    """The paper's loop; centre, score, votes, strong, and the detections of each cluster that is kept."""
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
            if rival is None or (count[row], crowded.confidence[row]) > (count[rival], crowded.confidence[rival]):
                best[int(crowded.view[row])] = row
        support = sorted(best.values(), key=lambda row: int(crowded.view[row]))
        centre = (weight[:, None] * points.xyz[members]).sum(axis=0) / weight.sum()
        score = crowded.confidence[support].mean()
        clusters.append((centre, points.joint[each], score, len(members), len(members) >= needed, support))
    explained = {row for *_, strong, support in clusters if strong for row in support}
    return [each for each in clusters if each[4] or not set(each[5]) <= explained]


@pytest.mark.parametrize(
    ("weighted", "views", "needed"), [(True, 5, 3), (False, 5, 3), (True, 2, 1), (True, 30, 10)]
)
def test_candidates_are_the_clusters_of_the_papers_loop(points, crowded, weighted, views, needed):
    """Before 2 cameras 1 vote makes a candidate strong, before 30 the 10 pairs of 5 views do."""
    candidates = vote(points, crowded, views, CandidateConfig(weighted_centre=weighted))
    expected = voted(points, crowded, CONFIG.vote_radius_m, needed, 2 if weighted else 0)
    assert len(candidates) == len(expected) > 100
    for n, (centre, joint, score, votes, strong, support) in enumerate(expected):
        np.testing.assert_allclose(candidates.xyz[n], centre, atol=1e-9)
        assert (candidates.joint[n], candidates.votes[n], candidates.strong[n]) == (joint, votes, strong)
        assert candidates.score[n] == pytest.approx(score)
        rows = candidates.support[candidates.support[:, 0] == n, 1]
        assert sorted(rows.tolist(), key=lambda row: int(crowded.view[row])) == support
    if views == 5:
        assert 10 < (~candidates.strong).sum() < len(candidates) - 10
    strong_only = vote(points, crowded, views, CandidateConfig(weighted_centre=weighted, weak=False))
    np.testing.assert_allclose(strong_only.xyz, candidates.xyz[candidates.strong])


def test_links_are_the_affinities_of_all_pairs_of_supporting_detections(links, candidates, crowded):
    made_of: dict[int, list[int]] = defaultdict(list)
    for candidate, row in candidates.support.tolist():
        made_of[row].append(candidate)
    views = [
        set(crowded.view[candidates.support[candidates.support[:, 0] == n, 1]]) for n in range(len(candidates))
    ]
    total: dict[tuple[int, int], float] = defaultdict(float)
    for (head, tail), affinity in zip(crowded.pairs.tolist(), crowded.affinity.tolist(), strict=True):
        for first in made_of[head]:
            for second in made_of[tail]:
                total[first, second] += affinity
    expected = {
        ends: value - 0.2 * len(views[ends[0]] & views[ends[1]])
        for ends, value in total.items()
        if np.linalg.norm(candidates.xyz[ends[0]] - candidates.xyz[ends[1]]) < 0.75
    }
    found = {tuple(ends): score for ends, score in zip(links.ends.tolist(), links.score.tolist(), strict=True)}
    assert len(found) == len(links.ends) > 500
    assert found == pytest.approx(expected)


def grown(anchors, candidates: Candidates, links: Links, config: GrowthConfig) -> NDArray[np.intp]:
    """Outwards from the hip joint by joint level, then all joints again `sweeps` times, then beyond gaps."""
    depth, parent = {BODY_25.root: 0}, dict(enumerate(BODY_25.parents))
    for level in range(1, 25):
        depth |= {
            joint: level for joint, up in parent.items() if depth.get(up) == level - 1 and joint not in depth
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
        """Give candidates to people: the best offer first, each candidate to one and each joint once."""
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
                    config.bridge_m > 0 and candidates.strong[n] and all(each.get(n, 0.0) <= 0 for each in linked)
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
    "config",
    [
        GrowthConfig(),
        GrowthConfig(sweeps=0, bridge_m=0.0),
        GrowthConfig(sweeps=1, view_weight=0.0, bridge_m=0.0),
        GrowthConfig(sweeps=3, view_weight=2.0, bridge_m=1.5),
    ],
)
def test_people_are_grown_level_by_level_then_all_at_once(config, candidates, links):
    hips = np.flatnonzero((candidates.joint == BODY_25.root) & candidates.strong)
    assert len(hips) >= 4
    expected = grown(hips, candidates, links, config)
    np.testing.assert_array_equal(grow(hips, candidates, links, BODY_25, config), expected)


def test_the_settings_of_growth_make_a_difference_here(candidates, links):
    """Or the test above would say little: views, sweeps and bridges each change somebody's joints."""
    hips = np.flatnonzero((candidates.joint == BODY_25.root) & candidates.strong)
    plain = grow(hips, candidates, links, BODY_25, GrowthConfig())
    for other in (GrowthConfig(sweeps=0), GrowthConfig(view_weight=0.0), GrowthConfig(bridge_m=0.0)):
        assert (grow(hips, candidates, links, BODY_25, other) != plain).any(), other


def test_mean_affinity_is_over_the_neighbours_that_the_person_owns_in_that_view(crowded):
    """A pair that is not listed counts 0; without a neighbour there is none, and the mean is 0."""
    rng = np.random.default_rng(0)
    owns = rng.random((3, len(crowded))) < 0.3
    affinity, neighbours = mean_affinity(owns, crowded, BODY_25, 5)
    listed = {tuple(pair): value for pair, value in zip(crowded.pairs.tolist(), crowded.affinity, strict=True)}
    for person, row in zip(*(index.ravel() for index in np.indices(owns.shape)), strict=True):
        total, there = 0.0, set()
        for other in np.flatnonzero(owns[person] & (crowded.view == crowded.view[row])).tolist():
            joined = tuple(sorted((crowded.joint[row], crowded.joint[other])))
            if joined in {tuple(sorted(limb)) for limb in BODY_25.limbs}:
                there.add(int(crowded.joint[other]))
                total += listed.get((row, other), listed.get((other, row), 0.0))
        assert neighbours[person, row] == len(there)
        assert affinity[person, row] == pytest.approx(total / max(len(there), 1))
