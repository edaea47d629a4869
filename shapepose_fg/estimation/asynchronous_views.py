"""Asynchronous views: joints have moved when they are exposed before or after the others of their
frame.

Detections are shifted to the frame's time by the current estimate of the joint's velocity, in each
step of a window's solution.
"""

from dataclasses import replace

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.frame_sets import AT_ONCE_S
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.in_time import velocities


def leads(observations: Observations, views: Views) -> Array:
    """(N, J, V) exposure time of each observation relative to its frame, the mean of the views'
    times, seconds.

    0 if the views of a frame are within a millisecond; a rolling shutter exposes the rows one after
    the other.
    """
    time_s = observations.time_s
    asynchronous = np.ptp(time_s, axis=1, keepdims=True) > AT_ONCE_S
    of_view = np.where(asynchronous, time_s - time_s.mean(axis=1, keepdims=True), 0.0)
    lead_s = np.repeat(of_view[:, None], observations.xy.shape[1], axis=1)
    if np.any(views.readout_s):
        height = np.broadcast_to(views.image_sizes, (len(views), 2))[:, 1]
        down = np.clip(observations.xy[..., 1] / height, 0.0, 1.0)
        lead_s += np.where(observations.seen, (down - 0.5) * views.readout_s, 0.0)
    return lead_s


def velocities_of(observations: Observations, points: Array) -> Array:
    """(N, J, 3) velocities of the joints `points` (N, J, 3) of each track, m/s; 0 if unknown."""
    velocity, time_s = np.zeros(points.shape), observations.time_s.mean(axis=1)
    order = np.lexsort((time_s, observations.track))
    for rows in np.split(order, np.flatnonzero(np.diff(observations.track[order])) + 1):
        velocity[rows] = velocities(points[rows], time_s[rows])
    return np.nan_to_num(velocity)


def carried_to_frames(
    observations: Observations, points: Array, velocity: Array, views: Views
) -> Observations:
    """The observations shifted to their frames' time, for joints at `points` (N, J, 3), metres,
    with `velocity` (N, J, 3), m/s.
    """
    lead_s = leads(observations, views)
    if not lead_s.any():
        return observations
    exposed = points[:, :, None] + lead_s[..., None] * velocity[:, :, None]
    shift_px = views.project_apart(exposed)[0] - views.project(points)[0]
    return replace(
        observations, xy=observations.xy - np.where(np.isfinite(shift_px), shift_px, 0.0)
    )


def widened(covariance: Array, observations: Observations, points: Array, views: Views) -> Array:
    """`covariance` (N, J, 3, 3) plus the largest displacement, in any view, of the joints `points`
    (N, J, 3) from the frame's time, m².
    """
    lead_s = leads(observations, views)
    if not lead_s.any():
        return covariance
    most = np.abs(lead_s).max(axis=2)[..., None] * velocities_of(observations, points)
    return covariance + most[..., None] * most[..., None, :]
