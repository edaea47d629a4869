"""Kalman update of people's joints by their assigned detections in a frame, with iterated
linearisation.
"""

from typing import NamedTuple

import numpy as np

from factors import DEFAULT_WIDTH_SIGMA
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.kernel_geometry import ROBUST, project, triangulated
from shapepose_fg.estimation.gated_views import MIN_DEPTH_M, ObservationConfig
from shapepose_fg.estimation.in_time import KNOWN_M
from shapepose_fg.estimation.kernels import add_detection
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking.motion_filter import Bones, JointStates, sigma
from shapepose_fg.tracking.plausibility import find_implausible
from shapepose_fg.tracking.view_assignment import FARTHEST_M

_ITERATIONS = 3
"""Number of linearisations (and gatings) per frame."""
MIN_IN_A_VIEW = 9
"""Core joints that a single view must see for a frame to count as evidence of the person, if two
views do not see `LEAST_JOINTS`: over half a body is no coincidence."""


class MeasurementNoise(NamedTuple):
    """Noise of detections in the form that kernels take (from `ObservationConfig`)."""

    kinds = "f1 f0 f0 f0 f0 i0 f0"
    scatter: Array
    """(J,) factor of the standard deviation for each joint."""
    sigma_m: float
    floor_rad: float
    rho_2d_m: float
    fixed_depth_m: float
    robust: int
    width: float
    """Robust kernel and its width, in standard deviations."""

    @classmethod
    def of(cls, config: ObservationConfig, joints: tuple[str, ...]) -> "MeasurementNoise":
        """The noise for these settings and the named `joints`."""
        return cls(
            scatter=config.scatter(joints),
            sigma_m=float(config.sigma_m),
            floor_rad=float(config.floor_rad),
            rho_2d_m=float(config.rho_2d_m),
            fixed_depth_m=float(config.fixed_depth_m),
            robust=ROBUST[config.kernel],
            width=DEFAULT_WIDTH_SIGMA.get(config.kernel, 1.0),
        )


def measured(
    joints: JointStates,
    lost: Mask,
    candidate: Index,
    weight: Array,
    arrays: FrameArrays,
    trust: MeasurementNoise,
    bones: Bones,
) -> tuple[JointStates, Index, Mask]:
    """Update people's joints with the detections `candidate` (A, J, V) of a frame, -1 for none.

    Returns the updated joints; the detections (A, J, V) that passed the gate and a check of bone
    lengths; and whether the frame is evidence of each person (A,): two views, or one, see enough
    core joints. It is a Kalman update with the noise of `observation_sigmas` and the Jacobians of
    `linearise`; `weight` (D,) weights each detection, 0 to ignore it. Joints that are `lost` (A, J)
    start at the triangulated position, if two or more views see them.
    """
    mean, covariance, kept = joints.mean.copy(), joints.covariance.copy(), candidate.copy()
    evident = np.empty(len(mean), dtype=bool)
    _measure(mean, covariance, lost, kept, weight, arrays, trust, bones, evident)
    return JointStates(mean, covariance), kept, evident


@kernel("f3 f4 b2 i3 f1", FrameArrays, MeasurementNoise, Bones, "b1")
def _measure(mean, covariance, lost, candidate, confident, arrays, trust, bones, evident):
    """Update `mean` (A, J, S) and `covariance` (A, J, S, S) in place, set rejected detections in
    `candidate` to -1, and fill in `evident` (A,).
    """
    people, joints, views = candidate.shape
    sigma_px, depths, confidence, room = (
        np.empty(views),
        np.empty(views),
        np.empty(views),
        np.empty(views),
    )
    at, uv, inlier = np.empty(3), np.empty((views, 2)), np.empty((joints, views), dtype=np.bool_)
    L, g, M, gain = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, mean.shape[2], 3))
    trusted, implausible = np.empty(joints, dtype=np.bool_), np.empty(joints, dtype=np.bool_)
    seen_by, above = np.empty(joints, dtype=np.intp), np.empty(joints, dtype=np.intp)
    way_m, count, too_long = np.empty(joints), np.empty(joints), np.empty(joints)
    cameras, focal, xy, core, scatter = (
        arrays.cameras,
        arrays.focal,
        arrays.xy,
        bones.core,
        trust.scatter,
    )
    numbers, fixed_m = trust[1:], trust.fixed_depth_m
    longest_m, parents = bones.longest_m, bones.parents
    for a in range(people):
        for v in range(views):
            depths[v] = _mean_depth(mean[a], cameras[v])
        trunk = 0
        for j in range(joints):
            for v in range(views if not arrays.swings[j] else 0):
                d = candidate[a, j, v]
                trunk += (
                    d >= 0 and _apart_m(mean[a, j], cameras[v], focal[v], xy[d]) < trust.rho_2d_m
                )
        for j in range(joints):
            seen, near, at[0], at[1], at[2] = 0, 0, mean[a, j, 0], mean[a, j, 1], mean[a, j, 2]
            for v in range(views):
                d, sigma_px[v], inlier[j, v] = candidate[a, j, v], 0.0, False
                if d >= 0 and confident[d] > 0:
                    near += _apart_m(mean[a, j], cameras[v], focal[v], xy[d]) < trust.rho_2d_m
                    depth = project(cameras[v], mean[a, j])[2]
                    depth = depth if depth >= MIN_DEPTH_M else depths[v]
                    depth = fixed_m if fixed_m > 0 else depth
                    px = focal[v] * np.sqrt(trust.floor_rad**2 + (trust.sigma_m / depth) ** 2)
                    sigma_px[v], seen = px * scatter[j] / np.sqrt(confident[d]), seen + 1
            swings = near == 0 and arrays.swings[j] and trunk >= LEAST_JOINTS
            if seen >= 2 and (lost[a, j] or swings):
                for v in range(views):
                    d = candidate[a, j, v]
                    confidence[v] = arrays.confidence[d] if d >= 0 else 0.0
                    uv[v, 0], uv[v, 1] = xy[d, 0], xy[d, 1]
                scale_m, reach_m = 2.0 * trust.sigma_m, trust.rho_2d_m
                if (
                    triangulated(
                        cameras, focal, uv, confidence, scale_m, reach_m, MIN_DEPTH_M, room, at
                    )
                    < 2
                ):
                    at[0], at[1], at[2] = mean[a, j, 0], mean[a, j, 1], mean[a, j, 2]
            if seen > 0:
                for _ in range(_ITERATIONS):
                    _linearise(
                        at, candidate[a, j], sigma_px, cameras, focal, xy, numbers, L, g, inlier[j]
                    )
                    _move(mean[a, j], covariance[a, j], at, L, g, M, gain)
                _update(mean[a, j], covariance[a, j], L, M, gain)
            trusted[j], seen_by[j] = sigma(covariance[a, j]) < KNOWN_M, inlier[j].sum()
        find_implausible(
            mean[a],
            trusted,
            seen_by,
            longest_m,
            parents,
            FARTHEST_M,
            above,
            way_m,
            count,
            too_long,
            implausible,
        )
        twice, most = 0, 0
        for j in range(joints):
            for v in range(views):
                if implausible[j] or not inlier[j, v]:
                    candidate[a, j, v] = -1
            if implausible[j]:
                for x in range(3):
                    covariance[a, j, x, x] += FARTHEST_M**2
            elif core[j] and seen_by[j] >= 2:
                twice += 1
        for v in range(views):
            most = max(most, (core & (candidate[a, :, v] >= 0)).sum())
        evident[a] = twice >= LEAST_JOINTS or most >= MIN_IN_A_VIEW


@part
def _apart_m(place, camera, focal, xy):
    """Reprojection distance of a detection from a 3D position, as a length at its depth, m."""
    x, y, depth = project(camera, place)
    return np.sqrt((x - xy[0]) ** 2 + (y - xy[1]) ** 2) * depth / focal


@part
def _mean_depth(mean, camera):
    """Mean depth of the joints in front of the camera, m."""
    total, count = 0.0, 0
    for j in range(len(mean)):
        depth = project(camera, mean[j])[2]
        if depth >= MIN_DEPTH_M:
            total += depth
            count += 1
    return total / count if count > 0 else MIN_DEPTH_M


@part
def _linearise(place, candidate, sigma_px, cameras, focal, xy, numbers, L, g, inlier):
    """Accumulate the detections of a joint, linearised at `place`: information L (3, 3), gradient g
    (3,).
    """
    rho_m, fixed_m, robust, width = numbers[2], numbers[3], numbers[4], numbers[5]
    for i in range(3):
        g[i] = L[i, 0] = L[i, 1] = L[i, 2] = 0.0
    for v in range(len(sigma_px)):
        inlier[v] = False
        if sigma_px[v] > 0:
            of_view = place, cameras[v], focal[v], xy[candidate[v]], sigma_px[v]
            inlier[v] = add_detection(
                *of_view, fixed_m, MIN_DEPTH_M, rho_m, False, robust, width, L, g
            )[0]


@part
def _move(mean, P, place, L, g, M, gain):
    """Set `place` to the joint's updated position, with gain P (1 + L P)^-1.

    This needs no inverse of L, which is singular if a single view sees the joint. The innovation
    remains in `M[0]`.
    """
    for i in range(3):
        for k in range(3):
            M[i, k] = (
                L[i, 0] * P[0, k] + L[i, 1] * P[1, k] + L[i, 2] * P[2, k] + (1.0 if i == k else 0.0)
            )
    _invert(M)
    for i in range(len(mean)):
        for k in range(3):
            gain[0, i, k] = P[i, 0] * M[0, k] + P[i, 1] * M[1, k] + P[i, 2] * M[2, k]
    x, y, z = place[0] - mean[0], place[1] - mean[1], place[2] - mean[2]
    for i in range(3):
        M[0, i] = L[i, 0] * x + L[i, 1] * y + L[i, 2] * z - g[i]
    for i in range(3):
        place[i] = (
            mean[i] + gain[0, i, 0] * M[0, 0] + gain[0, i, 1] * M[0, 1] + gain[0, i, 2] * M[0, 2]
        )


@part
def _update(mean, P, L, M, gain):
    """Update a joint's mean and covariance after `_move`: P - (gain L) P, kept symmetric."""
    for i in range(len(mean)):
        mean[i] += gain[0, i, 0] * M[0, 0] + gain[0, i, 1] * M[0, 1] + gain[0, i, 2] * M[0, 2]
        for k in range(3):
            gain[1, i, k] = (
                gain[0, i, 0] * L[0, k] + gain[0, i, 1] * L[1, k] + gain[0, i, 2] * L[2, k]
            )
            gain[2, i, k] = P[i, k]
    for i in range(len(mean)):
        for k in range(i + 1):
            less = 0.0
            for m in range(3):
                less += gain[1, i, m] * gain[2, k, m] + gain[1, k, m] * gain[2, i, m]
            P[i, k] -= less / 2
            P[k, i] = P[i, k]


@part
def _invert(M):
    """Invert a matrix (3, 3) in place."""
    a, b, c, d, e, f, g, h, i = (
        M[0, 0],
        M[0, 1],
        M[0, 2],
        M[1, 0],
        M[1, 1],
        M[1, 2],
        M[2, 0],
        M[2, 1],
        M[2, 2],
    )
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    over = 1.0 / (a * first + b * second + c * third)
    M[0, 0], M[0, 1], M[0, 2] = first * over, (c * h - b * i) * over, (b * f - c * e) * over
    M[1, 0], M[1, 1], M[1, 2] = second * over, (a * i - c * g) * over, (c * d - a * f) * over
    M[2, 0], M[2, 1], M[2, 2] = third * over, (b * g - a * h) * over, (a * e - b * d) * over
