"""Error statistics of a real detector, as tables measured on the Shelf recording
(docs/simulation.md).

The measurement code is `simulation/measurement` of commit 77ab725.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import read_json

_FILE = Path(__file__).parent / "data" / "detector.json"
_MIRROR = np.array(BODY_25.mirror)

_, JOINT_GROUP = np.unique(np.minimum(np.arange(len(_MIRROR)), _MIRROR), return_inverse=True)
"""(25,) the row of each joint in tables by joint: left and right share one, G = 14 rows."""
_LIMBS = np.array(BODY_25.limbs)
_LIMB_NAMES = [min(tuple(limb), tuple(_MIRROR[limb].tolist())) for limb in _LIMBS.tolist()]
LIMB_GROUP = np.array([sorted(set(_LIMB_NAMES)).index(name) for name in _LIMB_NAMES])
"""(26,) the row of each limb in tables by limb: left and right share one, 14 rows."""


@dataclass(frozen=True, eq=False)
class DetectorStatistics:
    """Tables by joint (G rows), state (visible, hidden by itself, hidden by another) and quantile
    (K levels).
    """

    levels: Array
    """(K,) probabilities at which quantiles are given, 0 to 1."""
    miss: Array
    """(G, 3) share of missed joints, for people neither occluded nor lost."""
    buried_share: Array
    """(B,) shares of a person's joints in a view that are occluded by other people."""
    buried: Array
    """(B,) increase of the probit of a miss, and decrease of that of the confidence, at the shares
    `buried_share`."""
    lost: Array
    """(2,) share of people in a view with half, or four fifths, of the joints missed without
    occlusion."""
    lost_memory: Array
    """(2, 2) share and time constant, s, of a fast and a slow component of the losses in `lost`."""
    lost_correlation: Array
    """(25, 25) correlation of losses between a person's joints."""
    confidence: Array
    """(G, 3, K) quantiles of the confidence of reported joints."""
    knots: Array
    """(N,) confidences at which sigma and tail are given."""
    sigma_m: Array
    """(3, N) sigma of each image coordinate, as a length on a person of median size, from the
    error's median."""
    tail: Array
    """(3, N) standard deviation of log-sigma, which makes the tails heavier than Gaussian."""
    joint_scale: Array
    """(G, 2) factors on sigma along x and y of the image."""
    floor_px: float
    """Contribution of the detector's grid to `sigma_m` at any size, pixels."""
    size_px_a_metre: float
    """Median size of a person in the image, pixels per metre."""
    facing: Array
    """(5, 2) cosines between which nose, eyes and ears become visible."""
    error_memory: Array
    """(2, 2) share and time constant in seconds of a fast and a slow part of the errors; the rest
    is white."""
    confidence_memory: Array
    """(2, 2) share and time constant in seconds of a fast and a slow part of the variation of
    confidences and misses."""
    error_correlation: Array
    """(25, 25) correlation between the errors of a person's joints in one view."""
    confidence_correlation: Array
    """(25, 25) correlation between the confidences of a person's joints in one view."""
    swap: float
    """Share of joints, distant from their mirrored joint, that are reported as the mirrored one."""
    double: float
    """Share of the swapped joints that are reported under both names."""
    double_m: float
    """Standard deviation of each coordinate of the distance between the two detections, m."""
    double_confidence: Array
    """(K,) quantiles of the confidence of the wrongly named detection."""
    capture_gap_m: Array
    """(B,) distances from an occluded joint to the same joint of the occluding person, m."""
    capture: Array
    """(B,) share of the missed joints that are captured, at the distances `capture_gap_m`."""
    merge_px: float
    """Distance, px at `merge_height_px`, at which the same joint of two people is merged in half
    the cases."""
    merge_width_px: float
    """Width of the transition from separate to merged people, pixels."""
    merge_height_px: float
    """Height of the pictures in which merging was measured, pixels."""
    false_near: float
    """Number of false candidates near each person per view, without duplicates of joints."""
    false_far: float
    """Number of false candidates elsewhere, per view."""
    false_near_m: Array
    """(K,) quantiles of the distance of those near a person from the nearest joint, m."""
    false_joints: Array
    """(G,) share of the false candidates reported as each joint."""
    false_near_confidence: Array
    """(K,) quantiles of the confidence of false candidates near a person."""
    false_far_confidence: Array
    """(K,) quantiles of the confidence of false candidates elsewhere."""
    false_memory: Array
    """(2, 2) share and time constant, s, of short-lived and long-lived false candidates."""
    affinity_right: Array
    """(14, K) quantiles of the affinity of correct pairs, by limb."""
    affinity_right_confidence: Array
    """(14, K) quantiles of the lower confidence of correct pairs."""
    affinity_correlation: float
    """Rank correlation of affinity and lower confidence of correct pairs."""
    detours: Array
    """(B,) lower edges of classes of wrong pairs: distance of the wrong end, in limb lengths."""
    affinity_wrong_share: Array
    """(B,) share of the pairs of two people that get an affinity."""
    affinity_wrong: Array
    """(B, K) quantiles of the affinity of pairs of two people."""
    affinity_nobody_share: Array
    """(B,) share of the pairs of a person and a false candidate that get an affinity."""
    affinity_nobody: Array
    """(B, K) quantiles of the affinity of pairs of a person and a false candidate."""
    provenance: str = "not known"
    """Origin of the tables."""

    @classmethod
    def read(cls, path: Path) -> "DetectorStatistics":
        """Read a file in the format of the package's, with an entry for each field."""
        content = read_json(path)
        tables: dict[str, Any] = {name: content[name] for name in cls.__dataclass_fields__}
        for name, table in tables.items():
            tables[name] = np.array(table, dtype=np.float64) if isinstance(table, list) else table
        return cls(**tables)

    def quantile(self, table: Array, probability: Array) -> Array:
        """Values (...,) at `probability` (...,) of quantile tables (..., K), or of one table
        (K,).
        """
        table = np.broadcast_to(table, (*probability.shape, len(self.levels)))
        at = np.clip(
            np.searchsorted(self.levels, probability, side="right") - 1, 0, len(self.levels) - 2
        )
        low, high = self.levels[at], self.levels[at + 1]
        part = np.clip((probability - low) / (high - low), 0.0, 1.0)
        first = np.take_along_axis(table, at[..., None], axis=-1)[..., 0]
        second = np.take_along_axis(table, at[..., None] + 1, axis=-1)[..., 0]
        return first + (second - first) * part

    def probability(self, table: Array, value: Array) -> Array:
        """Inverse of `quantile`: probability of values below `value` (...,), tables (..., K)."""
        at = np.clip((value[..., None] >= table).sum(axis=-1) - 1, 0, len(self.levels) - 2)
        low = np.take_along_axis(table, at[..., None], axis=-1)[..., 0]
        high = np.take_along_axis(table, at[..., None] + 1, axis=-1)[..., 0]
        part = np.clip((value - low) / np.maximum(high - low, 1e-9), 0.0, 1.0)
        return self.levels[at] + (self.levels[at + 1] - self.levels[at]) * part


@cache
def measured() -> DetectorStatistics:
    """The statistics of the package, read once."""
    return DetectorStatistics.read(_FILE)
