"""Converts a network's heat maps and part affinity fields to joint candidates with affinities.

Cao et al., "OpenPose: Realtime Multi-Person 2D Pose Estimation using Part Affinity Fields", PAMI
2021, section 3.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from shapepose_fg.core.arrays import Array, Index, Mask, Real
from shapepose_fg.io.detections.association_text import TextSkeleton


@dataclass(frozen=True)
class PictureCandidates:
    """Joint candidates of one picture, sorted by joint, and affinities between them."""

    joint: Index
    """(D,) joint of each candidate, in the network's order."""
    xy: Array
    """(D, 2) position of each candidate; in cells of the heat map, or in pixels after `moved`."""
    score: Array
    """(D,) height of the peak, 0 to 1."""
    pairs: Index
    """(E, 2) candidates connected by a limb; the candidate of the limb's first joint first."""
    limb: Index
    """(E,) limb of each pair."""
    affinity: Array
    """(E,) mean component of the field along the limb, 0 to 1; pairs without support are not
    listed."""

    def __len__(self) -> int:
        return len(self.joint)

    def moved(self, xy: Array, inside: Mask) -> "PictureCandidates":
        """Return the candidates at other positions; those that are not `inside` (D,) are left
        out.
        """
        place = np.cumsum(inside) - 1
        both = inside[self.pairs].all(axis=1)
        joint, score, pairs = self.joint[inside], self.score[inside], place[self.pairs[both]]
        return PictureCandidates(
            joint, xy[inside], score, pairs, self.limb[both], self.affinity[both]
        )


def decode(output: NDArray[np.float32], skeleton: TextSkeleton) -> PictureCandidates:
    """Candidates of one picture from the network's `output` (C, H, W).

    The output has one map for each of the `skeleton`'s J joints, one for the background, and two
    (x, y) for each limb. Positions are in cells; (0, 0) is the centre of the first cell. Values
    that are not finite count as 0.
    """
    output = np.nan_to_num(output, nan=0.0, posinf=0.0, neginf=0.0)
    joint, xy, score = peaks(output[: len(skeleton.joints)])
    of = [np.flatnonzero(joint == each) for each in range(len(skeleton.joints))]
    joined = [
        np.stack(np.meshgrid(of[a], of[b], indexing="ij"), axis=-1).reshape(-1, 2)
        for a, b in skeleton.limbs
    ]
    pairs, limb = (
        np.concatenate(joined),
        np.repeat(np.arange(len(joined)), [len(each) for each in joined]),
    )
    affinity = line_integrals(
        output[len(skeleton.joints) + 1 :], xy[pairs[:, 0]], xy[pairs[:, 1]], limb
    )
    positive = affinity > 0
    return PictureCandidates(joint, xy, score, pairs[positive], limb[positive], affinity[positive])


def peaks(heat: NDArray[np.float32], min_score: float = 0.1) -> tuple[Index, Array, Array]:
    """Joint (D,), position (D, 2) in cells, and height (D,) of the local maxima of heat maps (J, H,
    W).

    A local maximum is at least as high as its eight neighbours. Its position and height between
    cells are those of a Gaussian through it and its neighbours, along each axis.
    """
    padded = np.pad(heat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    rows, columns = heat.shape[1:]
    is_peak = heat >= min_score
    for down, right in np.ndindex(3, 3):
        other = padded[:, down : down + rows, right : right + columns]
        # Only the first cell of a plateau of equal values is kept.
        is_peak &= heat > other if (down, right) < (1, 1) else heat >= other
    joint, row, column = np.nonzero(is_peak)
    xy, height = between_cells(padded, joint, row + 1, column + 1)
    return joint, xy - 1, np.minimum(height, 1.0)


def between_cells(maps: Real, which: Index, row: Index, column: Index) -> tuple[Array, Array]:
    """Sub-cell positions (N, 2) and heights (N,) of maxima of `maps` (M, H, W) at the cells
    `which`, `row`, `column` (N,). None of these cells is at an edge.
    """
    centre = maps[which, row, column].astype(np.float64)
    x, rise_x = _vertex(maps[which, row, column - 1], centre, maps[which, row, column + 1])
    y, rise_y = _vertex(maps[which, row - 1, column], centre, maps[which, row + 1, column])
    return np.column_stack([column + x, row + y]), centre * np.exp(rise_x + rise_y)


def _vertex(before: Real, centre: Array, after: Real) -> tuple[Array, Array]:
    """Sub-cell position of the maximum of a Gaussian through three neighbours, -0.5 to 0.5 cells,
    and the increase of the logarithm there. Both are 0 at the edge of the map.
    """
    floor = 1e-3  # logarithms of values near 0 or below would distort the fit
    low, mid, high = (
        np.log(np.maximum(each.astype(np.float64), floor)) for each in (before, centre, after)
    )
    bend = low - 2 * mid + high
    safe = np.where(bend < -1e-9, bend, -np.inf)
    shift = np.clip(0.5 * (low - high) / safe, -0.5, 0.5)
    shift = np.where(np.isinf(before) | np.isinf(after), 0.0, shift)
    return shift, -0.25 * (low - high) * shift


def line_integrals(fields: NDArray[np.float32], start: Array, end: Array, limb: Index) -> Array:
    """(E,) mean component of the affinity `fields` (2 L, H, W) along the lines from `start` to
    `end` (E, 2).

    `limb` (E,) is the field of each line. 0 if too few points along the line support the limb.
    """
    height, width = fields.shape[1:]
    along = end - start
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-9)[:, None]
    # Number of points along a limb at which the affinity field is sampled, as in OpenPose.
    part = np.linspace(0.0, 1.0, 10)
    x = np.clip(start[:, :1] + along[:, :1] * part, 0, width - 1)
    y = np.clip(start[:, 1:] + along[:, 1:] * part, 0, height - 1)
    component = np.zeros(x.shape)
    for axis in range(2):
        places = np.stack([np.broadcast_to(2.0 * limb[:, None] + axis, x.shape), y, x])
        component += map_coordinates(fields, places, np.float64, order=1) * direction[:, axis, None]
    # Minimum component of the field along the limb at a point that supports it, as in OpenPose.
    # Minimum share of supporting points of a limb with an affinity.
    supported = (component >= 0.05).mean(axis=1) >= 0.7
    return np.where(supported & (length > 0), np.clip(component.mean(axis=1), 0.0, 1.0), 0.0)
