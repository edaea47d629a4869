"""Tests covariances without ground truth: the detections of a held-out view are compared with the
result of the other views.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factors import project_with_jacobian, sigma_px
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import DetectionSequence, Recording
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.linearisation import MIN_DEPTH_M, ObservationConfig
from shapepose_fg.evaluation.metrics import match_people

NEAR_M = 0.3
"""Maximum distance of a gated candidate from the joint, m (a length at the joint's depth), up to
which it is compared."""
INSIDE_95 = 5.991
"""95 % quantile of chi-squared with 2 degrees of freedom."""

Solve = Callable[[DetectionSequence, Rig], Reconstruction]
"""Function that reconstructs a recording: `reconstruct`, with its settings."""


@dataclass(frozen=True)
class HeldOut:
    """Result of `held_out` for one view."""

    squared: Array
    """(M,) squared Mahalanobis distance of each candidate from the joint's position by the other
    views."""
    unmatched: int
    """Number of candidates of rows that are missing in the result of the other views, or of joints
    that have no position there."""

    @property
    def inside(self) -> float:
        """Share of candidates inside the 95 % region; NaN if there are none."""
        return float((self.squared <= INSIDE_95).mean()) if len(self.squared) > 0 else float("nan")


def without_view(sequence: DetectionSequence, view: int) -> Recording:
    """A recording without one camera; the numbers of the cameras after it decrease by one."""
    frames = []
    for frame in range(len(sequence)):
        kept = sequence[frame].only(sequence[frame].view != view)
        frames.append(replace(kept, view=kept.view - (kept.view > view)))
    return Recording(sequence.skeleton, frames)


def held_out(
    recording: DetectionSequence,
    rig: Rig,
    view: int,
    people: Reconstruction,
    solve: Solve,
    config: ObservationConfig,
) -> HeldOut:
    """Solve without one camera, and compare the result with the detections of this camera that were
    assigned to `people`, the result of all cameras.

    ValueError if `people` have no observations.
    """
    others = Rig(tuple(camera for n, camera in enumerate(rig.cameras) if n != view), rig.up)
    return compare_view(
        rig.cameras[view], view, people, solve(without_view(recording, view), others), config
    )


def compare_view(
    camera: Camera,
    view: int,
    people: Reconstruction,
    without: Reconstruction,
    config: ObservationConfig,
) -> HeldOut:
    """Compare the detections of `people` in `camera`, which is `view`, with the same people solved
    `without` it.

    Rows are matched frame by frame (Hungarian, mean joint distance under 0.5 m). Compared are the
    detections that were assigned to a joint; gated ones only within `NEAR_M` of it.
    """
    if people.observations is None:
        raise ValueError(
            "the people have no observations: give the result of `reconstruct`, or load its folder"
        )
    table = people.observations
    xy, confidence = (
        values[:, :, view].astype(np.float64) for values in (table.xy, table.confidence)
    )
    projected, depth = camera.project(people.joints)
    near = np.linalg.norm(projected - xy, axis=-1) * depth / _focal(camera) < NEAR_M
    there = np.isfinite(xy).all(axis=-1) & (table.used[:, :, view] | near)
    pairs = [np.zeros((0, 2), dtype=np.intp)]
    for frame in np.unique(people.frame).tolist():
        ours, theirs = np.flatnonzero(people.frame == frame), np.flatnonzero(without.frame == frame)
        none = np.zeros(len(theirs), dtype=np.intp)
        matches = match_people(none, without.joints[theirs], people.joints[ours][None])
        pairs.append(np.stack([ours[matches.person], theirs[matches.row]], axis=1))
    ours, theirs = np.concatenate(pairs).T
    pair, joint = np.nonzero(there[ours] & np.isfinite(without.joints[theirs]).all(axis=-1))
    ours, theirs = ours[pair], theirs[pair]
    found = squared_distances(
        camera,
        xy[ours, joint],
        confidence[ours, joint],
        without.joints[theirs, joint],
        without.covariance[theirs, joint],
        config.scatter(people.joint_names.tolist())[joint],
        config,
    )
    known = found[np.isfinite(found)]
    return HeldOut(known, int(there.sum()) - len(known))


def squared_distances(
    camera: Camera,
    xy: Array,
    confidence: Array,
    points: Array,
    covariance: Array,
    scatter: Array,
    config: ObservationConfig,
) -> Array:
    """(M,) squared Mahalanobis distances of detections `xy` (M, 2), undistorted pixels, from
    projected `points`.

    `points` (M, 3) in metres with `covariance` (M, 3, 3), m², were estimated without them. S = J C
    J^T + sigma² I has the joint's uncertainty in the image and the noise variance that the graph
    assigns to a detection with this `confidence` (M,) and this `scatter` (M,) of the joint. NaN
    behind the camera.
    """
    projected, depth, J = project_with_jacobian(points, camera.K, camera.cTw)
    ahead, focal = depth >= MIN_DEPTH_M, _focal(camera)
    sigma = sigma_px(
        config.weight(confidence) / scatter**2,
        np.where(ahead, depth, 1.0),
        np.full(len(points), focal),
        sigma_m=config.sigma_m,
        floor_px=config.floor_rad * focal,
    )
    S = J @ covariance @ J.transpose(0, 2, 1) + sigma[:, None, None] ** 2 * np.eye(2)
    apart = np.where(ahead[:, None], projected - xy, np.nan)
    safe = np.where(ahead[:, None, None], S, np.eye(2))
    return np.einsum("mi,mi->m", apart, np.linalg.solve(safe, apart[..., None])[..., 0])


def _focal(camera: Camera) -> float:
    return float(camera.K[[0, 1], [0, 1]].mean())
