"""A network's heat maps and part affinity fields as joint candidates with affinities.

Cao et al., "OpenPose: Realtime Multi-Person 2D Pose Estimation using Part Affinity Fields", PAMI 2021, section 3.
All joints, and all pairs of candidates of all limbs, are decoded at once.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from shapepose_fg.detection2d.networks import NetworkLayout

_MIN_SCORE = 0.1
"""Heights of peaks below this are noise."""
_LINE_SAMPLES = 10
"""Places along a limb at which the affinity field is read, as in OpenPose."""
_MIN_ALONG = 0.05
"""A place supports a limb where the field has at least this component along it, as in OpenPose."""
_MIN_SUPPORTED = 0.7
"""The share of places that must support a limb for it to have an affinity."""


@dataclass(frozen=True)
class Candidates:
    """Joint candidates of one picture, sorted by joint, and affinities between them."""

    joint: NDArray[np.intp]
    """(D,) joint of each candidate, in the layout's order."""
    xy: NDArray[np.float64]
    """(D, 2) position."""
    score: NDArray[np.float64]
    """(D,) height of the peak, 0 to 1."""
    pairs: NDArray[np.intp]
    """(E, 2) candidates that a limb joins, the limb's first joint first."""
    limb: NDArray[np.intp]
    """(E,) the limb that joins each pair."""
    affinity: NDArray[np.float64]
    """(E,) mean of the field's component along the limb, 0 to 1; pairs without support are not listed."""

    def __len__(self) -> int:
        return len(self.joint)

    @classmethod
    def none(cls) -> "Candidates":
        """Those of a picture in which nothing is."""
        index, number = np.zeros(0, dtype=np.intp), np.zeros(0)
        return cls(index, number.reshape(0, 2), number, index.reshape(0, 2), index, number)

    def only(self, keep: NDArray[np.bool_]) -> "Candidates":
        """The candidates of the mask `keep` (D,), and the affinities between them."""
        place = np.cumsum(keep) - 1
        both = keep[self.pairs].all(axis=1)
        return Candidates(
            self.joint[keep],
            self.xy[keep],
            self.score[keep],
            place[self.pairs[both]],
            self.limb[both],
            self.affinity[both],
        )


def decode(output: NDArray[np.float32], layout: NetworkLayout) -> Candidates:
    """Candidates of one picture from the network's `output` (C, H, W).

    Positions are in cells of the output; (0, 0) is the centre of the first. What is not finite in
    the output is taken for 0.
    """
    output = np.nan_to_num(output, nan=0.0, posinf=0.0, neginf=0.0)
    heat = output[layout.first_heat_map : layout.first_heat_map + len(layout.joints)]
    joint, xy, score = peaks(heat)
    first, second, limb = _all_pairs(joint, layout)
    fields = output[layout.first_affinity : layout.first_affinity + 2 * len(layout.limbs)]
    affinity = line_integrals(fields, xy[first], xy[second], limb)
    there = affinity > 0
    pairs = np.column_stack([first, second])[there]
    return Candidates(joint, xy, score, pairs, limb[there], affinity[there])


def peaks(
    heat: NDArray[np.float32], min_score: float = _MIN_SCORE
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Joint (D,), position (D, 2) in cells, and height (D,) of the local maxima of heat maps (J, H, W).

    A maximum is no lower than its eight neighbours. Between cells its place and height are those of a Gaussian
    through it and its neighbours, along each axis.
    """
    padded = np.pad(heat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    stack = padded.transpose(1, 2, 0)  # OpenCV filters all channels of a picture at once
    largest = cv2.dilate(np.ascontiguousarray(stack), np.ones((3, 3), np.uint8)).reshape(stack.shape)
    is_peak = (stack >= largest) & (stack >= min_score)
    row, column, joint = np.nonzero(is_peak)
    order = np.lexsort((column, row, joint))
    joint, row, column = joint[order], row[order], column[order]
    # Of a plateau of equal cells only the first is kept.
    equal_before = np.zeros(len(joint), dtype=bool)
    for dr, dc in ((-1, -1), (-1, 0), (-1, 1), (0, -1)):
        equal_before |= padded[joint, row + dr, column + dc] == padded[joint, row, column]
    joint, row, column = joint[~equal_before], row[~equal_before], column[~equal_before]
    centre = padded[joint, row, column].astype(np.float64)
    x, rise_x = _vertex(padded[joint, row, column - 1], centre, padded[joint, row, column + 1])
    y, rise_y = _vertex(padded[joint, row - 1, column], centre, padded[joint, row + 1, column])
    xy = np.column_stack([column - 1 + x, row - 1 + y])
    return joint, xy, np.minimum(centre * np.exp(rise_x + rise_y), 1.0)


def _vertex(
    before: NDArray[np.floating], centre: NDArray[np.float64], after: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where a Gaussian through three neighbours is highest, -0.5 to 0.5 cells, and the logarithm of its rise.

    0 and 0 at the edge of the map.
    """
    floor = 1e-3  # logarithms of what is near 0 or below would bend the curve
    low, mid, high = (np.log(np.maximum(each.astype(np.float64), floor)) for each in (before, centre, after))
    bend = low - 2 * mid + high
    safe = np.where(bend < -1e-9, bend, -np.inf)
    shift = np.clip(0.5 * (low - high) / safe, -0.5, 0.5)
    shift = np.where(np.isinf(before) | np.isinf(after), 0.0, shift)
    return shift, -0.25 * (low - high) * shift


def line_integrals(
    fields: NDArray[np.float32], start: NDArray[np.float64], end: NDArray[np.float64], limb: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(E,) the mean component of the affinity `fields` (2 L, H, W) along the lines from `start` to `end` (E, 2).

    `limb` (E,) says whose field each line is read from. 0 where too few places along the line support it.
    """
    height, width = fields.shape[1:]
    along = end - start
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-9)[:, None]
    part = np.linspace(0.0, 1.0, _LINE_SAMPLES)
    x = np.clip(start[:, :1] + along[:, :1] * part, 0, width - 1)
    y = np.clip(start[:, 1:] + along[:, 1:] * part, 0, height - 1)
    component = np.zeros(x.shape)
    for axis in range(2):
        places = np.stack([np.broadcast_to(2.0 * limb[:, None] + axis, x.shape), y, x])
        component += map_coordinates(fields, places, np.float64, order=1) * direction[:, axis, None]
    supported = (component >= _MIN_ALONG).mean(axis=1) >= _MIN_SUPPORTED
    return np.where(supported & (length > 0), np.clip(component.mean(axis=1), 0.0, 1.0), 0.0)


def _all_pairs(
    joint: NDArray[np.intp], layout: NetworkLayout
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First candidate, second candidate, and limb, each (E,), of all pairs that any limb could join.

    `joint` (D,) is sorted.
    """
    count = np.bincount(joint, minlength=len(layout.joints))
    start = np.cumsum(count) - count
    ends = layout.limb_ends
    sizes = count[ends[:, 0]] * count[ends[:, 1]]
    limb = np.repeat(np.arange(len(ends)), sizes)
    within = np.arange(len(limb)) - (np.cumsum(sizes) - sizes)[limb]
    row, column = np.divmod(within, np.maximum(count[ends[limb, 1]], 1))
    return start[ends[limb, 0]] + row, start[ends[limb, 1]] + column, limb
