"""Footage without a truth: what a man on a treadmill and a bystander must look like (Pose2Sim's demo recording).

One man exercises in the middle of four cameras; a bystander stands still where only two of them look.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.footage import SINGLE_FPS
from shapepose_fg.evaluation.trajectories import WRISTS
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
LIMBS = np.array(
    [
        [BODY_25.index(side + joint) for joint in pair]
        for side in "RL"
        for pair in (("Elbow", "Wrist"), ("Shoulder", "Elbow"), ("Hip", "Knee"), ("Knee", "Ankle"))
    ]
)
"""Upper and lower arms and legs: what does not change its length."""
FOREARMS = [0, 4]
ARMS = (*WRISTS, BODY_25.index("RElbow"), BODY_25.index("LElbow"))


def measure_single_person(
    people: Reconstruction, recording: DetectionSequence, rig: Rig, *, fps: float = SINGLE_FPS
) -> dict[str, Any]:
    """Measure a reconstruction of the recording; the man is whoever is in the middle of the cameras.

    Frames, and those with a row of the man; his torn limbs; the spread (standard deviation over mean, per cent) of
    his forearms' lengths; the mean and the largest acceleration of his wrists, m/s²; how far the right wrist is
    under the shoulder at the most while he raises it, metres; the median distance of his projected arms from the
    nearest detection, pixels; and the share of the frames in which two views have five of the bystander's joints
    that have the bystander, per cent. None where there is nothing to measure.
    """
    his = people.rows(man_of(people, rig))
    lengths = np.linalg.norm(his.joints[:, LIMBS[:, 0]] - his.joints[:, LIMBS[:, 1]], axis=-1)
    forearms, accelerations = lengths[:, FOREARMS], _accelerations(his, fps)
    up = his.joints @ rig.up_vector
    below = (up[:, BODY_25.index("RShoulder")] - up[:, BODY_25.index("RWrist")])[np.isin(his.frame, ARM_UP)]
    there = _one_a_frame(people, np.linalg.norm(_places(people, rig) - BYSTANDER_M, axis=1), AROUND_M)
    seen = bystander_seen(recording, rig)
    with np.errstate(invalid="ignore"):
        figures = {
            "forearm_spread": 100 * np.mean(np.nanstd(forearms, axis=0) / np.nanmean(forearms, axis=0))
            if np.isfinite(forearms).any()
            else np.nan,
            "wrist_acceleration": accelerations.mean() if len(accelerations) > 0 else np.nan,
            "largest_acceleration": accelerations.max(initial=0.0),
            "lowest_wrist_m": np.nanmax(below) if np.isfinite(below).any() else np.nan,
            "residual_px": residual_to_nearest(his, recording, rig),
            "bystander_found": 100 * seen[people.frame[there]].sum() / max(seen.sum(), 1),
        }
    torn = lengths > LIMB_LIMIT * np.nanmedian(lengths, axis=0) if len(his) > 0 else np.zeros(0)
    counts = {"frames": len(recording), "man_found": len(his), "torn_limbs": int(torn.sum())}
    counts["bystander_seen"] = int(seen.sum())
    return counts | {name: float(value) if np.isfinite(value) else None for name, value in figures.items()}


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


def residual_to_nearest(people: Reconstruction, recording: DetectionSequence, rig: Rig) -> float:
    """Median distance in pixels of projected elbows and wrists from the nearest detection of them in each view.

    It knows nothing of gates: joints that leave what the views saw pay here.
    """
    nearest = []
    for row, frame in enumerate(people.frame.tolist()):
        seen = recording[frame]
        xy, _ = rig.project(people.joints[row])
        for joint in ARMS:
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
