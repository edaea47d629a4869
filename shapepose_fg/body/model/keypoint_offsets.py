"""Offsets of a detector's joints from the body model's.

A detector's hips are not SMPL's hips: annotation conventions differ. The offset is nearly constant
in the frame of the bone that the joint moves with, so it is one vector per joint.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.core.storage.files import read_json, write_atomically

_FORMAT = "shapepose-fg keypoint offsets 1"
_RIDES_ON = {
    "Nose REye LEye REar LEar": "head",
    "Neck": "spine3",
    "MidHip RHip LHip": "pelvis",
    "RShoulder": "right_collar",
    "LShoulder": "left_collar",
    "RElbow": "right_shoulder",
    "LElbow": "left_shoulder",
    "RWrist": "right_elbow",
    "LWrist": "left_elbow",
    "RKnee": "right_hip",
    "LKnee": "left_hip",
    "RAnkle": "right_knee",
    "LAnkle": "left_knee",
    "RBigToe RSmallToe RHeel": "right_ankle",
    "LBigToe LSmallToe LHeel": "left_ankle",
}
"""Bones have the name of the SMPL joint that they rotate about: a wrist moves with the forearm, so
with the elbow. Only bones with a rotation observable from the keypoints are used, so not a
hand's."""
_BONE_OF = {joint: bone for joints, bone in _RIDES_ON.items() for joint in joints.split()}
RIDES_ON = np.array([SMPL_24.index(_BONE_OF[joint]) for joint in BODY_25.joints])
"""(25,) index in `SMPL_24` of the bone with which each joint of BODY_25 moves."""
LARGEST_M = 0.2
"""Maximum length of an offset, m; a longer one indicates an error in units or data."""


@dataclass(frozen=True)
class KeypointOffsets:
    """Offsets of a detector's joints from the body's, in the frames of its bones.

    In T-pose every bone's frame is the body's own: x to its left, y up, z to its front.
    """

    xyz_m: Array
    """(25, 3) offset of each keypoint in the frame of its bone, metres."""
    sigma_m: Array
    """(25,) standard deviation of each offset, root mean square over the axes, metres."""
    count: Index
    """(25,) number of observed joints from which each offset was estimated; 0 for none."""
    bones: Index
    """(25,) index in `SMPL_24` of the bone with which each joint moves."""

    def __post_init__(self) -> None:
        for name, kind in {
            "xyz_m": float,
            "sigma_m": float,
            "count": np.intp,
            "bones": np.intp,
        }.items():
            value, shape = np.asarray(getattr(self, name)), (25, 3) if name == "xyz_m" else (25,)
            if value.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite numbers")
            object.__setattr__(self, name, value.astype(kind))
        if np.linalg.norm(self.xyz_m, axis=1).max() > LARGEST_M:
            raise ValueError(
                f"xyz_m must be metres, none longer than {LARGEST_M}; learn them from other "
                "detections"
            )
        if (self.sigma_m < 0).any() or (self.count < 0).any():
            raise ValueError("sigma_m and count must not be negative")
        if (self.bones < 0).any() or (self.bones >= len(SMPL_24)).any():
            raise ValueError(f"bones must be indices of SMPL's {len(SMPL_24)} joints")

    @classmethod
    def identity(cls) -> "KeypointOffsets":
        """Zero offsets."""
        return cls(np.zeros((25, 3)), np.zeros(25), np.zeros(25, dtype=np.intp), RIDES_ON)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for run.json and `save`: an entry per joint, millimetres with 3 digits."""
        joints = {
            name: {
                "bone": SMPL_24[self.bones[joint]],
                "xyz_mm": [round(1e3 * float(value), 3) for value in self.xyz_m[joint]],
                "sigma_mm": round(1e3 * float(self.sigma_m[joint]), 3),
                "count": int(self.count[joint]),
            }
            for joint, name in enumerate(BODY_25.joints)
        }
        return {"format": _FORMAT, "joints": joints}

    def save(self, path: str | Path) -> None:
        """Write as JSON, atomically."""
        text = json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"
        write_atomically(Path(path), lambda stream: stream.write(text.encode()))

    @classmethod
    def load(cls, path: str | Path) -> "KeypointOffsets":
        """Read a file of `save`, or the run.json of a reconstruction; raises InputError for
        anything else.
        """
        path = Path(path)
        content = read_json(path)
        if isinstance(content, dict) and isinstance(content.get("keypoint_offsets"), dict):
            content = content["keypoint_offsets"]
        return cls.read(content, path)

    @classmethod
    def read(cls, content: Any, path: Path) -> "KeypointOffsets":
        """The offsets in the `content` of a file at `path`; raises InputError if there are none."""
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise InputError(
                f"{path}: holds no keypoint offsets; give a run.json that does, or what "
                "KeypointOffsets.save wrote"
            )
        try:
            return cls.from_dict(content)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(
                f"{path}: {reason}; restore the file, or learn the offsets again"
            ) from None

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "KeypointOffsets":
        """Inverse of `as_dict`; raises KeyError, TypeError or ValueError if invalid. For files use
        `load`.
        """
        rows = [content["joints"][name] for name in BODY_25.joints]
        return cls(
            np.array([[_number(value) for value in row["xyz_mm"]] for row in rows]) / 1e3,
            np.array([_number(row["sigma_mm"]) for row in rows]) / 1e3,
            np.array([int(_number(row["count"])) for row in rows]),
            np.array([_bone(row["bone"]) for row in rows]),
        )


def _bone(name: object) -> int:
    """The index of a joint of SMPL; raises ValueError for any other name."""
    if name not in SMPL_24:
        raise ValueError(f"{name!r:.80} is not a joint of SMPL")
    return SMPL_24.index(str(name))


def _number(value: object) -> float:
    """A finite JSON number as float; raises ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r:.80} is not a number")
    return float(value)
