"""3D joint candidates: triangulation of pairs of views, clustered by confidence-weighted voting.

Stage I (b) and (c) of the paper (section 3.1, "3D Joint Candidates Reconstruction" and "Candidates
Association").
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Interval

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Count, Metres, Settings
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.kernel_geometry import project, solved


@dataclass(frozen=True)
class CandidateConfig(Settings):
    """Settings for 3D joint candidates from pairs of detections."""

    gate_m: Metres = 0.07
    """Maximum reprojection error of a pair's point, as a length at the point's depth, m. Each of
    the two rays gets half of the gap: the error is 0.7 of a detection's sigma, 2 cm if the detector
    is half certain."""
    min_angle_deg: Annotated[float, Interval(gt=0, le=90)] = 3.0
    """Minimum angle between the two rays; below it the depth is poorly observed."""
    vote_radius_m: Metres = 0.12
    """Radius rho of a cluster, m: points of one joint this close to the most confident one vote for
    it."""
    min_votes: Count = 3
    """Minimum number of points of a strong candidate, three in the paper; one with fewer is *weak*
    and cannot anchor a person. Two cameras give a single pair, so the limit is min(min_votes, pairs
    of views)."""
    min_view_fraction: Annotated[float, Interval(gt=0, le=1)] = 1 / 6
    """Fraction of the views whose pairs must all vote for a strong candidate: with very many views,
    chance crossings of rays also get three votes (30 cameras: 5 views, 10 votes; 18 and fewer:
    3)."""
    weak: bool = True
    """Whether clusters with fewer votes are kept as weak candidates. The paper drops them, and
    loses joints seen by only two views."""
    weighted_centre: bool = True
    """Whether the centre of a cluster is weighted by the squared confidence of its points. In the
    paper it is their mean."""

    most_pairs: Annotated[int, Interval(ge=1000, le=1_000_000)] = 150_000
    """Maximum number of pairs of detections per joint and frame; each view keeps its most confident
    detections."""
    most_points: Annotated[int, Interval(ge=100, le=100_000)] = 8000
    """Maximum number of points per joint; the most confident are kept. Twelve people with 30
    cameras have 5000."""
    most_candidates: Annotated[int, Interval(ge=10, le=10_000)] = 250
    """Maximum number of candidates per joint; those with most votes are kept. Twelve people with
    30 cameras have 220, half of them chance crossings of rays."""

    @classmethod
    def paper(cls) -> "CandidateConfig":
        """The settings of section 3.1: every pair is triangulated without a gate; at least three
        points.

        The paper does not give rho: 6 cm is the best of 5 to 12 on `tune`.
        """
        # Gate that any pair of rays in a room passes, m.
        return cls(
            gate_m=10.0,
            min_angle_deg=1e-3,
            vote_radius_m=0.06,
            min_view_fraction=1e-3,
            weak=False,
            weighted_centre=False,
        )


@dataclass(frozen=True)
class PairPoints:
    """Points triangulated from two detections of the same joint in different views."""

    xyz: Array
    """(M, 3) position in the world, metres."""
    joint: Index
    """(M,) index of the joint in the skeleton."""
    pair: Index
    """(M, 2) indices of the two detections."""
    score: Array
    """(M,) confidence of the point: the geometric mean of the two detections' confidences."""


@dataclass(frozen=True)
class Candidates:
    """3D joint candidates: clusters of pair points."""

    xyz: Array
    """(C, 3) position in the world, metres."""
    joint: Index
    """(C,) index of the joint in the skeleton."""
    score: Array
    """(C,) mean confidence of the supporting detections."""
    votes: Index
    """(C,) number of pair points in the cluster."""
    strong: Mask
    """(C,) whether the cluster has the votes that the paper requires."""
    support: Index
    """(S, 2) rows (candidate, detection): the supporting detections, at most one per
    view, sorted."""

    def __len__(self) -> int:
        return len(self.xyz)


def triangulate_pairs(detections: Detections, rig: Rig, config: CandidateConfig) -> PairPoints:
    """Triangulate all pairs of same-joint detections of different views (A y = 0 with C = 2 in the
    paper).

    The linear system is in normalised image coordinates and solved for the inhomogeneous point.
    Points behind a camera, above the reprojection error `gate_m`, or from almost parallel rays are
    dropped.
    """
    view, joint, *_ = detections.columns
    by_joint = np.argsort(joint, kind="stable")
    stop = np.searchsorted(joint[by_joint], joint[by_joint], side="right")
    xy = rig.normalise(view, detections.xy)
    P = rig.cTw[view]
    rows = xy[:, :, None] * P[:, 2:3] - P[:, :2]
    rays = np.einsum(
        "dji,dj->di", P[:, :, :3], np.concatenate([xy, np.ones((len(view), 1))], axis=1)
    )
    seen = _Rays(view, xy, rays, np.linalg.norm(rays, axis=1), rows[..., :3].swapaxes(1, 2) @ rows)
    limits = 2.0 * config.gate_m, float(np.sin(np.deg2rad(config.min_angle_deg))), config.gate_m
    pair, xyz, count = np.empty((0, 2), dtype=np.intp), np.empty((0, 3)), 4 * len(view)
    while count > len(pair):
        pair, xyz = np.empty((count, 2), dtype=np.intp), np.empty((count, 3))
        count = _triangulate(by_joint, stop, seen, rig.cTw, rig.centres, *limits, pair, xyz)
    pair = pair[:count]
    score = np.sqrt(detections.confidence[pair].prod(axis=1))
    return PairPoints(xyz[:count], detections.joint[pair[:, 0]], pair, score)


class _Rays(NamedTuple):
    """Detections in the form that triangulation takes."""

    of_view: Index
    """(D,) index of the camera."""
    xy: Array
    """(D, 2) normalised image coordinates."""
    ray: Array
    """(D, 3) direction of the ray in the world, not normalised."""
    length: Array
    """(D,) length of the ray's direction."""
    normal: Array
    """(D, 3, 4) B^T (B, c), where (B, c) are the view's two rows of A: x P_3 - P_1 and y P_3 -
    P_2."""

    kinds = "i1 f2 f2 f1 f3"


def vote(
    points: PairPoints, detections: Detections, views: int, config: CandidateConfig
) -> Candidates:
    """Cluster the points of each joint around the most confident ones (the paper's set S_i).

    As in the paper: pick the most confident point, add all neighbours within rho, remove them, and
    repeat.
    """
    if len(points.xyz) == 0:
        none = np.zeros(0, dtype=np.intp)
        return Candidates(
            np.zeros((0, 3)), none, np.zeros(0), none, none > 0, np.zeros((0, 2), dtype=np.intp)
        )
    seed = greedy_seeds(points, config.vote_radius_m)
    _, cluster = np.unique(seed, return_inverse=True)
    count = cluster.max() + 1
    votes = np.bincount(cluster, minlength=count)
    # Confidence weights: one bad view must not move a point that four good views agree on.
    weight = points.score**2 if config.weighted_centre else np.ones(len(points.score))
    total = np.bincount(cluster, weight, count)
    xyz = np.stack([np.bincount(cluster, weight * x, count) / total for x in points.xyz.T], axis=1)
    joint = np.zeros(count, dtype=np.intp)
    joint[cluster] = points.joint
    support = _support(np.repeat(cluster, 2), points.pair.ravel(), detections)
    confidence = np.bincount(support[:, 0], detections.confidence[support[:, 1]], count)
    score = confidence / np.bincount(support[:, 0], minlength=count)
    strong = votes >= _needed_votes(views, config)
    # Detections of strong candidates are explained: their other points are chance crossings of
    # rays.
    explained = np.zeros(len(detections), dtype=bool)
    explained[support[strong[support[:, 0]], 1]] = True
    unexplained = np.bincount(support[:, 0], ~explained[support[:, 1]], count) > 0
    keep = strong | (unexplained & config.weak)
    support = support[keep[support[:, 0]]]
    support[:, 0] = (np.cumsum(keep) - 1)[support[:, 0]]
    return Candidates(xyz[keep], joint[keep], score[keep], votes[keep], strong[keep], support)


def _needed_votes(views: int, config: CandidateConfig) -> int:
    """Votes for a strong candidate: `min_votes`, fewer if there are fewer pairs, more with very
    many views.
    """
    seen_by = int(views * config.min_view_fraction)
    return min(max(config.min_votes, seen_by * (seen_by - 1) // 2), views * (views - 1) // 2)


def _support(cluster: Index, detection: Index, detections: Detections) -> Index:
    """Rows (candidate, detection), sorted: per view the detection with most of the candidate's
    points.
    """
    key, points = np.unique(cluster * len(detections) + detection, return_counts=True)
    cluster, detection = np.divmod(key, len(detections))
    view = detections.view[detection]
    order = np.lexsort((-detections.confidence[detection], -points, view, cluster))
    cluster, detection, view = cluster[order], detection[order], view[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (cluster[1:] != cluster[:-1]) | (view[1:] != view[:-1])
    return np.stack([cluster[first], detection[first]], axis=1)


@kernel("i1 i1", _Rays, "f3 f2 f0 f0 f0 i2 f2")
def _triangulate(order, stop, rays, cameras, centres, gap_m, least_sine, gate_m, pair, xyz):
    """Fill in `pair` and `xyz`, as far as the arrays reach; returns the number of points. `order`
    (D,) sorts detections by joint, `stop` (D,) ends each one's joint. Rays must pass each other at
    less than `gap_m`.
    """
    count, x = 0, np.empty(3)
    for n in range(len(order)):
        for m in range(n + 1, stop[n]):
            i, j = order[n], order[m]
            one, other, a, b = rays.of_view[i], rays.of_view[j], rays.ray[i], rays.ray[j]
            if one == other:
                continue
            across = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            sine, gap = math.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2), 0.0
            for axis in range(3):
                gap += across[axis] * (centres[other, axis] - centres[one, axis])
            if abs(gap) >= gap_m * sine or sine <= least_sine * rays.length[i] * rays.length[j]:
                continue
            A, B = rays.normal[i], rays.normal[j]
            solved(
                A[0, 0] + B[0, 0], A[0, 1] + B[0, 1], A[0, 2] + B[0, 2], A[1, 1] + B[1, 1],
                A[1, 2] + B[1, 2], A[2, 2] + B[2, 2], -A[0, 3] - B[0, 3], -A[1, 3] - B[1, 3],
                -A[2, 3] - B[2, 3], x,
            )  # fmt: skip
            if (
                _off_m(cameras[one], rays.xy[i], x) < gate_m
                and _off_m(cameras[other], rays.xy[j], x) < gate_m
            ):
                if count < len(pair):
                    pair[count, 0], pair[count, 1] = i, j
                    xyz[count, 0], xyz[count, 1], xyz[count, 2] = (
                        x[0],
                        x[1],
                        x[2],
                    )  # slicing compiles slowly
                count += 1
    return count


@part
def _off_m(camera, xy, x):
    """Reprojection error as a length at the point's depth, metres; infinite behind the camera."""
    u, v, depth = project(camera, x)
    return math.hypot(u - xy[0], v - xy[1]) * depth if depth > 0 else math.inf


def greedy_seeds(points: PairPoints, radius_m: float) -> Index:
    """Index of the seed (M,) of each point's cluster; points are picked by descending
    confidence.
    """
    order = np.argsort(-points.score, kind="stable")
    along = np.lexsort((points.xyz[:, 0], points.joint))
    place, seed = np.empty_like(along), np.full(len(along), -1, dtype=np.intp)
    place[along] = np.arange(len(along))
    _pick_seeds(order, along, place, np.ascontiguousarray(points.xyz), points.joint, radius_m, seed)
    return seed


@kernel("i1 i1 i1 f2 i1 f0 i1")
def _pick_seeds(order, along, place, xyz, joint, radius_m, seed):
    """Fill in `seed` (M,). Points are picked in `order`; `along` sorts them by joint and first
    coordinate, and `place` is the rank of each in it, so that only near points are compared.
    """
    for i in order:
        if seed[i] >= 0:
            continue
        seed[i] = i
        for step in (-1, 1):
            k = place[i] + step
            while 0 <= k < len(along):
                j = along[k]
                x = xyz[j, 0] - xyz[i, 0]
                if joint[j] != joint[i] or abs(x) > radius_m:
                    break
                y, z = xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
                if seed[j] < 0 and x * x + y * y + z * z <= radius_m * radius_m:
                    seed[j] = i
                k += step
