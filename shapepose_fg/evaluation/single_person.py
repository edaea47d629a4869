"""Pose2Sim's demo recording: a man's arms against marks made by hand.

He exercises in the middle of four cameras; a bystander stands still where only two of them look.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factors import project_with_jacobian
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import ObservationConfig, triangulate

SINGLE_FPS = 60.0
MIDDLE_M = 1.5
"""Whoever is within this of the middle of the cameras, on the floor, is the man; metres."""
ANNOTATION = Path(__file__).with_name("pose2sim_single_arms.csv")
"""The marks; its head says how they were made. Part of the repository, not of what is installed."""
ARMS = ("RElbow", "RWrist", "LElbow", "LWrist")
"""The annotated joints."""
_ARM_JOINTS = np.array([BODY_25.index(name) for name in ARMS])
SIGMA_PX = 10.0
"""Of a mark: the median distance of the marks from their own triangulation is 9 px; 4 px if each camera may shift,
as the rig does not match these videos."""
AGREE_M, WRONG_M = 0.1, 0.2
"""A mark further than the first from where the marks meet, as a length at the joint's depth, is left out; a joint
further than the second from its annotation is wrong."""
INSIDE_50, INSIDE_95 = 2.366, 7.815
"""A chi-squared variable with 3 degrees of freedom is under these in 50 and 95 of 100 cases."""


def man_of(people: Reconstruction, rig: Rig) -> Index:
    """(M,) the row of the man in each frame that has one, in the order of frames: the nearest to the middle."""
    floor = np.eye(3)[np.abs(rig.up_vector) < 0.5]
    known = np.isfinite(people.joints.sum(axis=2))[..., None]
    count = known.sum(axis=1)
    mean = np.where(known, people.joints, 0.0).sum(axis=1) / np.maximum(count, 1)
    away = np.linalg.norm((mean - rig.centres.mean(axis=0)) @ floor.T, axis=1)
    distance = np.where(count[:, 0] > 0, away, np.inf)
    order = np.lexsort((distance, people.frame))
    rows = order[np.unique(people.frame[order], return_index=True)[1]]
    return rows[distance[rows] < MIDDLE_M]


@dataclass(frozen=True)
class AnnotatedArms:
    """A annotated joints in space."""

    frame: Index
    """(A,) frame of the recording."""
    joint: Index
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
    """What `measure_arms` found, joint by joint; a joint that has no place is infinitely far away."""

    joint: Index
    """(A,) index into `ARMS`."""
    error_m: Array
    """(A,) distance from the annotation, metres."""
    squared: Array
    """(A,) squared Mahalanobis distance under both covariances together."""

    def as_dict(self) -> dict[str, Any]:
        """Medians in millimetres, shares in per cent; None where there is nothing to measure."""
        medians = {}
        for number, name in enumerate(ARMS):
            mine = self.error_m[self.joint == number]
            middle = 1e3 * float(np.median(mine)) if len(mine) > 0 else np.inf
            medians[f"{name}_mm"] = middle if np.isfinite(middle) else None
        shares = {"arms_wrong": self.error_m > WRONG_M, "arms_inside_50": self.squared <= INSIDE_50}
        shares["arms_inside_95"] = self.squared <= INSIDE_95
        some = len(self.joint) > 0
        per_cent = {name: 100 * float(each.mean()) if some else None for name, each in shares.items()}
        return {"arms": len(self.joint)} | medians | per_cent


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
    xy, seen = np.zeros((len(key), len(rig), 2)), np.zeros((len(key), len(rig)))
    for index, camera in enumerate(rig.cameras):
        xy[place[view == index], index] = camera.undistort(raw[view == index])
        seen[place[view == index], index] = 1.0
    for _ in range(2):  # of all marks, and of those that agree
        marks = Observations(xy[:, None], seen[:, None], np.full((len(key), 1, 3), np.nan))
        xyz = triangulate(marks, Views.of(rig), ObservationConfig())[:, 0]
        projected, depth, J = project_with_jacobian(xyz[:, None], rig.K, rig.cTw)
        residual = np.linalg.norm(xy - projected, axis=-1)
        seen = np.where(residual * depth / rig.focal_px < AGREE_M, seen, 0.0)
    # Of points: the inverse of their information in the views that are used, each mark with `SIGMA_PX`.
    placed = seen.sum(axis=1) >= 2
    J = np.where(seen[..., None, None] > 0, J, 0.0)[placed] / SIGMA_PX
    covariance = np.linalg.inv(np.einsum("avki,avkj->aij", J, J))
    residual = np.where(seen > 0, residual, np.nan)[placed]
    return AnnotatedArms(key[placed, 0], key[placed, 1], xyz[placed], covariance, residual)


def measure_arms(his: Reconstruction, arms: AnnotatedArms) -> ArmErrors:
    """Compare one man's rows, at most one a frame, with his annotated joints."""
    row_of = dict(zip(his.frame.tolist(), range(len(his)), strict=True))
    row = np.array([row_of.get(frame, -1) for frame in arms.frame.tolist()], dtype=np.intp)
    joint, placed = _ARM_JOINTS[arms.joint], row >= 0
    placed[placed] = np.isfinite(his.joints[row[placed], joint[placed]]).all(axis=-1)
    off = his.joints[row[placed], joint[placed]] - arms.xyz[placed]
    both = his.covariance[row[placed], joint[placed]] + arms.covariance[placed]
    error_m, squared = np.full(len(arms), np.inf), np.full(len(arms), np.inf)
    error_m[placed] = np.linalg.norm(off, axis=-1)
    squared[placed] = np.einsum("ai,ai->a", off, np.linalg.solve(both, off[..., None])[..., 0])
    return ArmErrors(arms.joint, error_m, squared)
