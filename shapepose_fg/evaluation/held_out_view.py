"""Tests covariances without ground truth: a view is left out, and its detections are compared with the rest."""

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
"""Distance from the joint, as a length, within which a candidate that the gate refused is compared, m."""
INSIDE_95 = 5.991
"""A chi-squared variable with 2 degrees of freedom is under this in 95 of 100 cases."""

Solve = Callable[[DetectionSequence, Rig], Reconstruction]
"""Function that reconstructs a recording: `reconstruct`, with its settings."""


@dataclass(frozen=True)
class HeldOut:
    """Result of `held_out` for one view."""

    squared: Array
    """(M,) squared Mahalanobis distance of each candidate from where the other views put the joint."""
    unmatched: int
    """Number of candidates of rows that the other views alone do not find, or of joints that they do not place."""

    @property
    def inside(self) -> float:
        """Share inside the 95 % region; NaN where there is none."""
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
    """Solve without a camera, and compare with its detections of the `people` of the whole run.

    ValueError where `people` come without their observations.
    """
    others = Rig(tuple(camera for n, camera in enumerate(rig.cameras) if n != view), rig.up)
    return compare_view(rig.cameras[view], view, people, solve(without_view(recording, view), others), config)


def compare_view(
    camera: Camera, view: int, people: Reconstruction, without: Reconstruction, config: ObservationConfig
) -> HeldOut:
    """Compare the detections of `people` in `camera`, which is `view`, with the same people solved `without` it.

    Rows are matched frame by frame (Hungarian, mean joint distance under 0.5 m). Compared are detections that were
    assigned to a joint, unused ones only if they are near it.
    """
    if people.observations is None:
        raise ValueError("the people have no observations: give the result of `reconstruct`, or load its folder")
    table = people.observations
    xy, confidence = (values[:, :, view].astype(np.float64) for values in (table.xy, table.confidence))
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
    """(M,) squared Mahalanobis distances of detections `xy` (M, 2), undistorted pixels, from projected `points`.

    `points` (M, 3) in metres with `covariance` (M, 3, 3), m², were found without them. S = J C J^T + sigma² I
    has the joint's uncertainty in the image and the noise that the graph gives a detection of that `confidence`
    (M,) and of a joint with that `scatter` (M,). NaN behind the camera.
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
