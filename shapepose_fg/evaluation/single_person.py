"""Footage without a truth: what a man on a treadmill and a bystander must look like (Pose2Sim's demo recording).

One man exercises in the middle of four cameras; a bystander stands still where only two of them look.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.evaluation.bodies import body_joints, bone_joints
from shapepose_fg.evaluation.footage import SINGLE_FPS
from shapepose_fg.evaluation.trajectories import FOREARMS, WRISTS, limb_lengths
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs

Array = NDArray[np.float64]

MIDDLE_M = 1.5
"""Whoever is within this of the middle of the cameras, on the floor, is the man; metres."""
BYSTANDER_M = np.array([-4.4, 0.4])
"""Where the bystander stands on the floor: the middle of what views 1 and 2 see there, over all frames."""
AROUND_M = 1.0
"""How far from there a point or a person may be."""
FIVE_JOINTS = 5
"""So many of a person's joints in two views are enough to be found."""
ARM_UP = range(16, 31)
"""Frames in which the man raises his right arm: from 0.16 m below the shoulder to 0.1 m above."""
LIMB_LIMIT = 1.25
"""A limb longer than this times its own median is counted as torn."""
_RIGHT = (BODY_25.index("RWrist"), BODY_25.index("RShoulder"))


@dataclass(frozen=True)
class SinglePerson:
    """What `measure_single_person` found."""

    frames: int
    """Frames of the recording."""
    man_found: int
    """Frames with a row of the man."""
    torn_limbs: int
    """Limbs of his joints longer than 1.25 times their own median, over all frames."""
    forearm_spread: float
    """Standard deviation over mean of the length of his forearms, the mean of the two."""
    body_forearm_spread: float
    """The same of his bodies, between the points where the detector puts elbow and wrist: on the skin, which moves
    as the elbow bends."""
    bone_forearm_spread: float
    """The same of his bodies' bones."""
    wrist_acceleration: float
    """Mean length of the acceleration of his wrists, m/s²."""
    largest_wrist_acceleration: float
    """The greatest, m/s²."""
    wrist_below_shoulder_m: Array
    """(15,) right shoulder's height minus right wrist's in frames 16 to 30, metres; NaN where unknown."""
    residual_px: float
    """Median distance of his projected arms' joints from the nearest detection of that joint in the same view."""
    bystander_seen: int
    """Frames in which two views have five of the bystander's joints."""
    bystander_found: int
    """Those of them with a row that is the bystander."""

    def as_dict(self) -> dict[str, Any]:
        """The figures under plain names; None where there is nothing to measure."""
        below = self.wrist_below_shoulder_m[np.isfinite(self.wrist_below_shoulder_m)]
        figures = {
            "forearm_spread": 100 * self.forearm_spread,
            "body_forearm_spread": 100 * self.body_forearm_spread,
            "bone_forearm_spread": 100 * self.bone_forearm_spread,
            "wrist_acceleration": self.wrist_acceleration,
            "largest_wrist_acceleration": self.largest_wrist_acceleration,
            "lowest_wrist_m": float(below.max()) if len(below) > 0 else np.nan,
            "residual_px": self.residual_px,
            "bystander_found": 100 * self.bystander_found / max(self.bystander_seen, 1),
        }
        counts = {"frames": self.frames, "man_found": self.man_found, "torn_limbs": self.torn_limbs}
        counts |= {"wrist_low": int((below > 0.2).sum()), "bystander_seen": self.bystander_seen}
        return counts | {name: float(value) if np.isfinite(value) else None for name, value in figures.items()}


def measure_single_person(
    people: Reconstruction,
    recording: DetectionSequence,
    rig: Rig,
    *,
    fps: float = SINGLE_FPS,
    model: BodyModel | None = None,
) -> SinglePerson:
    """Measure a reconstruction of the recording; the man is whoever is in the middle of the cameras."""
    his = people.rows(man_of(people, rig))
    lengths, body_lengths = limb_lengths(his.joints), limb_lengths(body_joints(his, model))
    up = his.joints @ rig.up_vector
    below = np.full(len(recording), np.nan)
    below[his.frame] = up[:, _RIGHT[1]] - up[:, _RIGHT[0]]
    there = _one_a_frame(people, np.linalg.norm(_places(people, rig) - BYSTANDER_M, axis=1), AROUND_M)
    seen = bystander_seen(recording, rig)
    accelerations = _accelerations(his, fps)
    return SinglePerson(
        frames=len(recording),
        man_found=len(his),
        torn_limbs=int((lengths > LIMB_LIMIT * _median(lengths)).sum()),
        forearm_spread=_spread(lengths[:, list(FOREARMS)]),
        body_forearm_spread=_spread(body_lengths[:, list(FOREARMS)]),
        bone_forearm_spread=_spread(_forearm_bones(his, model)),
        wrist_acceleration=float(accelerations.mean()) if len(accelerations) > 0 else np.nan,
        largest_wrist_acceleration=float(accelerations.max()) if len(accelerations) > 0 else np.nan,
        wrist_below_shoulder_m=below[ARM_UP.start : ARM_UP.stop],
        residual_px=residual_to_nearest(his, recording, rig),
        bystander_seen=int(seen.sum()),
        bystander_found=int(seen[people.frame[there]].sum()),
    )


def man_of(people: Reconstruction, rig: Rig) -> NDArray[np.intp]:
    """(M,) the row of the man in each frame that has one, in the order of frames."""
    middle = (rig.centres @ _floor(rig).T).mean(axis=0)
    return _one_a_frame(people, np.linalg.norm(_places(people, rig) - middle, axis=1), MIDDLE_M)


def bystander_seen(recording: DetectionSequence, rig: Rig) -> NDArray[np.bool_]:
    """(T,) frames in which two views have five of the bystander's joints: rays that meet at their place."""
    seen = np.zeros(len(recording), dtype=bool)
    for frame in range(len(recording)):
        points = triangulate_pairs(recording[frame], rig, CandidateConfig())
        near = np.linalg.norm(points.xyz @ _floor(rig).T - BYSTANDER_M, axis=1) < AROUND_M
        seen[frame] = len(np.unique(points.joint[near])) >= FIVE_JOINTS
    return seen


def residual_to_nearest(
    people: Reconstruction,
    recording: DetectionSequence,
    rig: Rig,
    joints: tuple[int, ...] = (*WRISTS, 3, 6),
) -> float:
    """Median distance in pixels of projected `joints` from the nearest detection of them in each view.

    It knows nothing of gates: joints that leave what the views saw pay here.
    """
    nearest = []
    for row, frame in enumerate(people.frame.tolist()):
        seen = recording[frame]
        xy, _ = rig.project(people.joints[row])
        for joint in joints:
            for view in range(len(rig)):
                mine = seen.xy[(seen.joint == joint) & (seen.view == view)]
                if len(mine) > 0:
                    nearest.append(np.linalg.norm(mine - xy[view, joint], axis=1).min())
    known = np.array(nearest)[np.isfinite(nearest)]
    return float(np.median(known)) if len(known) > 0 else float("nan")


def _floor(rig: Rig) -> Array:
    """(2, 3) the axes of the world that lie in the floor."""
    return np.eye(3)[np.abs(rig.up_vector) < 0.5]


def _places(people: Reconstruction, rig: Rig) -> Array:
    """(N, 2) where on the floor people are: the mean of their joints; infinite for one without any."""
    known = np.isfinite(people.joints.sum(axis=2))[..., None]
    count = known.sum(axis=1)
    mean = np.where(known, people.joints, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, mean @ _floor(rig).T, np.inf)


def _one_a_frame(people: Reconstruction, distance: Array, limit: float) -> NDArray[np.intp]:
    """(M,) in each frame the row of least `distance` (N,), if under `limit`; in the order of frames."""
    order = np.lexsort((distance, people.frame))
    _, first = np.unique(people.frame[order], return_index=True)
    rows = order[first]
    return rows[distance[rows] < limit]


def _accelerations(people: Reconstruction, fps: float) -> Array:
    """Lengths over wrists and consecutive frames, m/s²."""
    wrists = people.joints[:, list(WRISTS)]
    second = np.linalg.norm(wrists[2:] - 2 * wrists[1:-1] + wrists[:-2], axis=-1) * fps**2
    second = second[people.frame[2:] - people.frame[:-2] == 2]
    return second[np.isfinite(second)]


def _median(lengths: Array) -> Array:
    return np.nanmedian(lengths, axis=0) if len(lengths) > 0 else np.zeros(lengths.shape[1])


def _forearm_bones(people: Reconstruction, model: BodyModel | None) -> Array:
    """(N, 2) lengths of the bones between elbow and wrist, right and left, metres."""
    joints = bone_joints(people, model)
    elbow, wrist = ([SMPL_24.index(f"{side}_{name}") for side in ("right", "left")] for name in ("elbow", "wrist"))
    return np.linalg.norm(joints[:, wrist] - joints[:, elbow], axis=-1)


def _spread(lengths: Array) -> float:
    """Standard deviation over mean, the mean of the columns."""
    if np.isfinite(lengths).sum() == 0:
        return float("nan")
    return float(np.nanmean(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)))
