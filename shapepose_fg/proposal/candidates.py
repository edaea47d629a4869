"""Points where the rays of two detections of a joint meet.

Stage I (b) of the paper (section 3.1, "3D Joint Candidates Reconstruction").
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Interval

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.bounds import Metres, Settings
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.kernel_geometry import project, solved


@dataclass(frozen=True)
class CandidateConfig(Settings):
    """Settings for points from pairs of detections."""

    gate_m: Metres = 0.07
    """Maximum reprojection error of a pair's point, as a length at the point's depth, m. Each of
    the two rays gets half of the gap: the error is 0.7 of a detection's sigma, 2 cm if the detector
    is half certain."""
    min_angle_deg: Annotated[float, Interval(gt=0, le=90)] = 3.0
    """Minimum angle between the two rays; below it the depth is poorly observed."""
    most_pairs: Annotated[int, Interval(ge=1000, le=1_000_000)] = 150_000
    """Maximum number of pairs of detections per joint and frame; each view keeps its most confident
    detections."""
    most_points: Annotated[int, Interval(ge=100, le=100_000)] = 8000
    """Maximum number of points per joint; the most confident are kept. Twelve people before 30
    cameras have 5000."""

    @classmethod
    def paper(cls) -> "CandidateConfig":
        """The settings of section 3.1: every pair is triangulated without a gate."""
        # Gate that any pair of rays in a room passes, m.
        return cls(gate_m=10.0, min_angle_deg=1e-3)


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
