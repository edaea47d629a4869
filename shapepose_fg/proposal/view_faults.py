"""Faulty detections that a single view reveals: duplicated people, joints clipped to the image
border.
"""

import numpy as np

from shapepose_fg.core.arrays import Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.people_2d import LEAST_COMMON, group_people

_SAME = 0.03
"""Median distance of the common joints of duplicates, as a share of the person's size in the image:
two boxes around one person differ by 1 to 2 %, two people on one viewing ray by more."""
_SAME_OF_PICTURE = 0.005
"""Minimum of this limit as a share of the image width: small people differ by a few pixels."""
_BORDER_PX = 1.0
"""Distance from the edge of the image within which a joint is on the edge, px."""
_LINE_PX = 0.01
"""Difference below which coordinates are equal, px: the inverse of the distortion is more exact."""
_DISTINCT = 0.9
"""Share of distinct coordinates above which the detector does not round to a grid."""


def without_faults(found: Detections, rig: Rig) -> Detections:
    """The detections of a frame without clipped joints and duplicated people."""
    for wrong in (clipped, doubled):
        faulty = wrong(found, rig)
        found = found.only(~faulty) if faulty.any() else found
    return found


def clipped(found: Detections, rig: Rig) -> Mask:
    """(D,) mask of detections of joints outside the image that were clipped to its border.

    The border is the edge of the calibrated image. For a detector run on a crop, it is a line that
    bounds all joints of a view, with two or more of them exactly on it while the other coordinates
    are distinct.
    """
    measured = found.xy.copy()
    for view, camera in enumerate(rig.cameras):
        if np.any(camera.distortion):
            in_view = found.view == view
            measured[in_view] = camera.distort(measured[in_view])
    edge = np.array([camera.image_size for camera in rig.cameras]) - 1 - _BORDER_PX
    wrong = np.asarray(((measured <= _BORDER_PX) | (measured >= edge[found.view])).any(axis=1))
    for along in (*measured.T, *-measured.T):
        highest = np.full(len(rig), -np.inf)
        np.maximum.at(highest, found.view, along)
        end = along > highest[found.view] - _LINE_PX
        for view in np.flatnonzero(np.bincount(found.view[end], minlength=len(rig)) > 1).tolist():
            rest = np.round(along[(found.view == view) & ~end] / _LINE_PX)
            if len(np.unique(rest)) >= max(1, _DISTINCT * len(rest)):
                wrong |= end & (found.view == view)
    return wrong


def doubled(found: Detections, rig: Rig) -> Mask:
    """(D,) mask of the detections of duplicated 2D people: of two at the same place, the less
    confident.
    """
    again = np.zeros(len(found), dtype=bool)
    groups = [group for group in group_people(found) if len(group) >= LEAST_COMMON]
    # Most confident first; ties keep the order of detections.
    groups.sort(key=lambda group: -float(found.confidence[group].sum()))
    view = found.view[[group[0] for group in groups]]
    if len(groups) == len(np.unique(view)):
        return again
    xy = np.full((len(groups), int(found.joint.max()) + 1, 2), np.nan)
    for number, group in enumerate(groups):
        xy[number, found.joint[group]] = found.xy[group]
    lowest, highest = np.nanmin(xy, axis=1), np.nanmax(xy, axis=1)
    size = np.linalg.norm(highest - lowest, axis=1)
    least = _SAME_OF_PICTURE * np.array([camera.image_size[0] for camera in rig.cameras])
    one, other = np.triu_indices(len(groups), 1)
    near = np.abs(lowest[one] - lowest[other]).max(axis=1) < size[one]
    one, other = (each[near & (view[one] == view[other])] for each in (one, other))
    distance_px = np.sort(np.linalg.norm(xy[one] - xy[other], axis=2), axis=1)
    common = np.isfinite(distance_px).sum(axis=1)
    has = np.isfinite(xy[..., 0]).sum(axis=1)
    enough = common >= np.maximum(LEAST_COMMON, np.minimum(has[one], has[other]) / 2)
    median = distance_px[np.arange(len(one)), np.maximum(common - 1, 0) // 2]
    same = enough & (
        median < np.maximum(_SAME * np.minimum(size[one], size[other]), least[view[one]])
    )
    removed = np.zeros(len(groups), dtype=bool)
    for kept, twin in zip(one[same].tolist(), other[same].tolist(), strict=True):
        removed[twin] |= not removed[kept]
    for number in np.flatnonzero(removed).tolist():
        again[groups[number]] = True
    return again
