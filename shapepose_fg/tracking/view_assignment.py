"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from shapepose_fg.bounds import Metres, Repeats, Settings, Share
from shapepose_fg.camera import Rig
from shapepose_fg.detections import Detections
from shapepose_fg.proposal.association import (
    match_views,
    mean_affinity,
    owned,
    projected_distances,
    share_overlaps,
)
from shapepose_fg.skeleton import Skeleton


@dataclass(frozen=True)
class AssignmentConfig(Settings):
    """When a detection is taken for a joint whose place is predicted."""

    near_m: Metres = 0.06
    """How closeness to the predicted joint falls off where the prediction is exact: sigma of a Gaussian, as a
    length at the joint's depth. A detector is 2 cm off on a visible joint and several on a hidden one."""
    far_m: Metres = 0.12
    """No detection farther than this, and twice the prediction's sigma, is taken."""
    farthest_m: Metres = 0.5
    """No detection farther than this is taken, however uncertain the prediction."""
    least_affinity: Share = 0.3
    """Mean affinity to the person's other detections that takes a detection for a joint whose place is lost; half
    of the least score of all others. Unrelated pairs are mostly 0, true ones above 0.4."""
    reach_m: Metres = 0.8
    """A lost joint is sought this far around its neighbour on the skeleton."""
    overlap_px: Annotated[float, Interval(gt=0, le=1000)] = 6.0
    """Two people's predicted joints closer than this overlap: the one detection there serves both."""
    passes: Repeats = 2
    """How often the choice is made again with the affinities to what the last one chose."""


def assign(
    places: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    lost: NDArray[np.bool_],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssignmentConfig,
    world: NDArray[np.intp] | None = None,
) -> NDArray[np.intp]:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none.

    `places` (A, J, 3) are predictions known to `sigma_m` (A, J). A detection's score is its nearness and its mean
    affinity to what the same person has at the limbs' other ends; the best score is taken first, each detection
    once. A joint that is `lost` (A, J) is found by affinity alone; its place is that of its neighbour. People of
    different worlds (A,) do not compete for detections.
    """
    people, count = len(places), len(detections)
    shape = (people, len(skeleton), len(rig))
    if people == 0 or count == 0:
        return np.full(shape, -1, dtype=np.intp)
    distance_px, distance_m = projected_distances(rig.project(places), detections.joint, detections, rig)
    sigma, astray = sigma_m[:, detections.joint], lost[:, detections.joint]
    nearness = np.exp(-0.5 * distance_m**2 / (config.near_m**2 + sigma**2))
    gate_m = np.minimum(config.far_m + 2 * sigma, config.farthest_m)
    inside = (distance_m < gate_m) & ~astray
    reachable = (distance_m < config.reach_m) & astray
    owns = np.zeros((people, count), dtype=bool)
    chosen = np.full(shape, -1, dtype=np.intp)
    affinity = np.zeros((people, count))
    for _ in range(1 + config.passes):
        affinity, neighbours = mean_affinity(owns, detections, skeleton, len(rig))
        # Where no neighbour is seen, the affinities say nothing: neither for nor against.
        spoken = np.where(neighbours > 0, affinity, config.least_affinity)
        score = nearness + spoken
        likely = inside & (score >= 2 * config.least_affinity)
        likely |= reachable & (neighbours > 0) & (affinity >= config.least_affinity)
        chosen = match_views(likely, score, detections, shape, world)
        owns = owned(chosen, count)
    overlap = (distance_px < config.overlap_px) & (affinity >= config.least_affinity)
    share_overlaps(chosen, overlap, distance_px, detections)
    return chosen
