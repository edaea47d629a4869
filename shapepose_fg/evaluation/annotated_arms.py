"""Elbows and wrists of the man in Pose2Sim's demo recording against marks made by hand in its pictures."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors import project_with_jacobian
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.baseline.triangulation import triangulate_robustly

Array = NDArray[np.float64]

ANNOTATION = Path(__file__).with_name("pose2sim_single_arms.csv")
"""The marks; its head says how they were made. Part of the repository, not of what is installed."""
ARMS = ("RElbow", "RWrist", "LElbow", "LWrist")
"""The annotated joints."""
SIGMA_PX = 10.0
"""Of a mark: the median distance of the marks from their own triangulation is 9 px; 4 px if each camera may shift,
as the rig does not match these videos."""
AGREE_M = 0.1
"""A mark further than this from where the other views' marks meet is left out, metres at the joint's depth."""
WRONG_M = 0.2
"""A joint further than this from its annotation is wrong."""
INSIDE_50, INSIDE_95 = 2.366, 7.815
"""A chi-squared variable with 3 degrees of freedom is under these in 50 and 95 of 100 cases."""


@dataclass(frozen=True)
class AnnotatedArms:
    """A annotated joints in space."""

    frame: NDArray[np.intp]
    """(A,) frame of the recording."""
    joint: NDArray[np.intp]
    """(A,) index into `ARMS`."""
    xyz: Array
    """(A, 3) position, metres, where the marks of two views or more meet."""
    covariance: Array
    """(A, 3, 3) its covariance, m²."""
    residual_px: Array
    """(A, V) distance of each view's mark from the projected position; NaN where none is used."""

    def __len__(self) -> int:
        return len(self.frame)

    def only(self, frames: range) -> "AnnotatedArms":
        """Those of `frames`."""
        there = np.isin(self.frame, frames)
        return AnnotatedArms(*(values[there] for values in vars(self).values()))


@dataclass(frozen=True)
class ArmErrors:
    """What `measure_arms` found, joint by joint of `arms`; a joint that has no place is infinitely far away."""

    arms: AnnotatedArms
    """The annotation."""
    error_m: Array
    """(A,) distance from the annotation, metres."""
    squared: Array
    """(A,) squared Mahalanobis distance under both covariances together."""

    def of(self, joint: str) -> "ArmErrors":
        """Those of one of `ARMS`."""
        there = self.arms.joint == ARMS.index(joint)
        arms = AnnotatedArms(*(values[there] for values in vars(self.arms).values()))
        return ArmErrors(arms, self.error_m[there], self.squared[there])

    def as_dict(self) -> dict[str, Any]:
        """Medians in millimetres, shares in per cent; None where there is nothing to measure."""
        figures = {"arms": len(self.arms)} | {f"{joint}_mm": _median_mm(self.of(joint).error_m) for joint in ARMS}
        shares = {"arms_wrong": self.error_m > WRONG_M, "arms_inside_50": self.squared <= INSIDE_50}
        shares["arms_inside_95"] = self.squared <= INSIDE_95
        return figures | {
            name: 100 * float(each.mean()) if len(each) > 0 else None for name, each in shares.items()
        }


def read_annotated_arms(file: Path, rig: Rig) -> AnnotatedArms:
    """Read marks, in raw pixels, and triangulate the clear ones. InputError where the file has no such marks."""
    try:
        lines = [line for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
        rows = [row for row in csv.DictReader(lines) if row["flag"] == "clear"]
        keys = [(int(row["frame"]), ARMS.index(row["joint"])) for row in rows]
        view = np.array([rig.names.index(row["view"]) for row in rows], dtype=np.intp)
        raw = np.array([(row["x"], row["y"]) for row in rows], dtype=np.float64).reshape(-1, 2)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{file}: no annotation of arms in views {' '.join(rig.names)}: {error}") from error
    key, place = np.unique(np.array(keys, dtype=np.intp).reshape(-1, 2), axis=0, return_inverse=True)
    xy = np.zeros((len(key), len(rig), 2))
    seen = np.zeros((len(key), len(rig)))
    for index, camera in enumerate(rig.cameras):
        xy[place[view == index], index] = camera.undistort(raw[view == index])
        seen[place[view == index], index] = 1.0
    points, agree = triangulate_robustly(xy[:, None], seen[:, None], rig, AGREE_M, min_views=2)
    xyz, used = points[:, 0], agree[:, 0]
    placed = used.any(axis=1)
    return _with_covariance(key[placed], xyz[placed], xy[placed], used[placed], rig)


def measure_arms(his: Reconstruction, arms: AnnotatedArms) -> ArmErrors:
    """Compare one man's rows, at most one a frame, with his annotated joints."""
    row_of = dict(zip(his.frame.tolist(), range(len(his)), strict=True))
    row = np.array([row_of.get(frame, -1) for frame in arms.frame.tolist()], dtype=np.intp)
    joint = np.array([BODY_25.index(name) for name in ARMS])[arms.joint]
    placed = row >= 0
    placed[placed] = np.isfinite(his.joints[row[placed], joint[placed]]).all(axis=-1)
    off = his.joints[row[placed], joint[placed]] - arms.xyz[placed]
    both = his.covariance[row[placed], joint[placed]] + arms.covariance[placed]
    error_m, squared = np.full(len(arms), np.inf), np.full(len(arms), np.inf)
    error_m[placed] = np.linalg.norm(off, axis=-1)
    squared[placed] = np.einsum("ai,ai->a", off, np.linalg.solve(both, off[..., None])[..., 0])
    return ArmErrors(arms, error_m, squared)


def _with_covariance(
    key: NDArray[np.intp], xyz: Array, xy: Array, used: NDArray[np.bool_], rig: Rig
) -> AnnotatedArms:
    """Of points (A, 3): the inverse of their information in the `used` views (A, V), each mark with `SIGMA_PX`."""
    projected, _, J = project_with_jacobian(xyz[:, None], rig.K, rig.cTw)
    J = np.where(used[..., None, None], J, 0.0) / SIGMA_PX
    covariance = np.linalg.inv(np.einsum("avki,avkj->aij", J, J))
    residual = np.where(used, np.linalg.norm(xy - projected, axis=-1), np.nan)
    return AnnotatedArms(key[:, 0], key[:, 1], xyz, covariance, residual)


def _median_mm(errors: Array) -> float | None:
    middle = 1e3 * float(np.median(errors)) if len(errors) > 0 else np.inf
    return middle if np.isfinite(middle) else None
