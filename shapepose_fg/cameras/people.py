"""People used for adjusting cameras: seen by several cameras, in frames separated in time."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.cameras.sightings import GATE, MOST_FRAMES, Pairs, Sightings, size_of
from shapepose_fg.cameras.tracks import OneClock, seen_at
from shapepose_fg.cameras.triangulation import left_out, observed, triangulate
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Camera, Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.gated_views import MIN_DEPTH_M, ObservationConfig, observation_sigmas
from shapepose_fg.estimation.trajectory_graph import WEAKEST_M

LEAST_PEOPLE = 10
"""Minimum number of people, one per frame, from which a camera is adjusted."""
_LEAST_STEP_S = 0.1
"""Minimum time between used frames, s: errors of nearer ones are correlated (0.8)."""
_MOST_SIGHTINGS = 5_000
"""Maximum number of sightings; more of them, or of frames, cost time and add little information,
because errors within a second are correlated."""


@dataclass(frozen=True)
class People(Rows):
    """P people of single frames, J joints, V cameras."""

    frame: Index
    """(P,) frame of each person."""
    xy: Array
    """(P, J, V, 2) detections, undistorted pixels; NaN where there is none."""
    sigma_px: Array
    """(P, J, V) standard deviation of each detection per axis, pixels, as measured for the
    detector; NaN without a detection."""
    points: Array
    """(P, J, 3) triangulated joints, metres; NaN with fewer than two views."""

    @property
    def seen(self) -> Mask:
        """(P, J, V) mask of the detections of triangulated joints."""
        return np.asarray(np.isfinite(self.sigma_px) & np.isfinite(self.points[..., :1]))


@dataclass(frozen=True)
class Footage:
    """The sightings of the cameras in the used frames."""

    sightings: Sightings
    """The people of single cameras, in distorted pixels."""
    joints: tuple[str, ...]
    """(J,) names of the joints."""

    @classmethod
    def of(
        cls, detections: DetectionSequence | OneClock, rig: Rig, times: FrameTimes, frames: range
    ) -> "Footage":
        """Sightings in frames spread over the recording; more frames would add cost but hardly any
        information.
        """
        taken = times.frame_s[frames.start : frames.stop]
        lasts = float(taken[-1] - taken[0])
        count = max(2, min(MOST_FRAMES, len(taken), 1 + int(lasts / _LEAST_STEP_S)))
        wanted = np.searchsorted(taken, taken[0] + np.linspace(0.0, lasts, count)).clip(
            0, len(taken) - 1
        )
        chosen = frames.start + np.unique(wanted)
        sightings = seen_at(detections, chosen.tolist())
        thin = -(-len(sightings) // _MOST_SIGHTINGS)
        sightings = sightings.rows(np.isin(sightings.frame, chosen[::thin]))
        return cls.taken(sightings, rig, detections.skeleton)

    @classmethod
    def taken(cls, sightings: Sightings, rig: Rig, skeleton: Skeleton) -> "Footage":
        """Sightings that were undistorted by the lenses of `rig`."""
        names = tuple(skeleton.joints[joint] for joint in skeleton.core)
        return cls(_through_lenses(sightings, rig, Camera.distort), names)

    def at(self, frames: Index) -> "Footage":
        """The sightings in some of the frames."""
        return replace(self, sightings=self.sightings.rows(np.isin(self.sightings.frame, frames)))

    def undistorted(self, rig: Rig) -> Sightings:
        """The sightings undistorted by the lenses of `rig`."""
        return _through_lenses(self.sightings, rig, Camera.undistort)

    def people(self, rig: Rig) -> People:
        """Associate people between the cameras `rig`, and triangulate them."""
        sightings, views = self.undistorted(rig), Views.of(rig)
        groups = Pairs.of(sightings, views).groups(len(sightings), tuple(range(len(rig))))
        xy, confidence, size = observed(groups, sightings)
        placed = triangulate(xy, confidence, size, views)
        near = (placed.depth > MIN_DEPTH_M) & (placed.miss_px < GATE * size[:, None])
        rows = Observations(np.nan_to_num(xy), confidence, placed.points)
        sigma = observation_sigmas(rows, placed.points, views, ObservationConfig(), self.joints)
        sigma = np.where(near, sigma, np.nan)
        placeable = _well_placed(placed.points, sigma * placed.depth / rig.focal_px, rig)
        points = np.where(placeable[..., None], placed.points, np.nan)
        return People(groups.frame, xy, np.where(placeable[..., None], sigma, np.nan), points)


def _through_lenses(
    sightings: Sightings, rig: Rig, change: Callable[[Camera, Array], Array]
) -> Sightings:
    """The sightings with their pixels distorted, or undistorted."""
    xy = sightings.xy.copy()
    for view, camera in enumerate(rig.cameras):
        of_view = sightings.view == view
        xy[of_view] = change(camera, xy[of_view].reshape(-1, 2)).reshape(xy[of_view].shape)
    return replace(sightings, xy=xy)


def _well_placed(points: Array, sigma_m: Array, rig: Rig) -> Mask:
    """(P, J) mask of points that are well determined in all directions, given standard deviations
    `sigma_m` across the views' rays.
    """
    rays = points[:, :, None] - rig.centres
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    information = np.nansum(across / sigma_m[..., None, None] ** 2, axis=2)
    return np.asarray(np.linalg.eigvalsh(information)[..., 0] > 1 / WEAKEST_M**2)


def missed_px(people: People, rig: Rig) -> Array:
    """(P, J, V) distance of each detection from the joint predicted by the *other* cameras only,
    pixels.

    NaN if fewer than two others see it. With only two cameras, from the prediction by both.
    """
    seen, size = np.isfinite(people.sigma_px), size_of(np.moveaxis(people.xy, 2, 1))
    given = people.xy, seen.astype(float), size, Views.of(rig)
    missed = triangulate(*given).miss_px if len(rig) == 2 else left_out(*given, seen)[0]
    return np.where(seen, missed, np.nan)
