"""Reads body models in SMPL's file format, `.npz` or the official `.pkl`, and validates them."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_pickle import RefusedPickle, as_array, read_smpl_pickle
from shapepose_fg.core.arrays import Array, Real
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.core.storage.npz import read_npz

DATA = Path(__file__).parent.parent / "data"
"""Folder of the built-in body, its priors and the weights of its fitter."""
NUM_BETAS = 10
"""Number of shape components in use; a file may have more."""
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Parent of each of SMPL's 24 joints."""
_NUM_KEYPOINTS = len(BODY_25)
_SMPL_NUM_VERTICES = 6890
_SMPL_VERTEX_KEYPOINTS = {
    "Nose": 332, "REye": 6260, "LEye": 2800, "REar": 4071, "LEar": 583, "LBigToe": 3216,
    "LSmallToe": 3226, "LHeel": 3387, "RBigToe": 6617, "RSmallToe": 6624, "RHeel": 6787,
}  # fmt: skip
"""Vertices of SMPL's own mesh for keypoints."""
_HEIGHT_M = (0.4, 3.0)
"""Range of body heights, m, from a newborn to above any adult; detects templates in other units."""
_BELONGS = {
    "RShoulder": "right_shoulder", "RElbow": "right_elbow", "RWrist": "right_wrist",
    "LShoulder": "left_shoulder", "LElbow": "left_elbow", "LWrist": "left_wrist",
    "RHip": "right_hip", "RKnee": "right_knee", "RAnkle": "right_ankle",
    "LHip": "left_hip", "LKnee": "left_knee", "LAnkle": "left_ankle",
}  # fmt: skip
"""SMPL joints of keypoints: of SMPL's own mesh they are the keypoints, of others they are near."""
_RISING = ("ankle", "knee", "hip", "shoulder")
"""Joints in ascending order of height in T-pose."""


@dataclass(frozen=True)
class SmplArrays:
    """Validated arrays of a body model, in float64."""

    template: Array
    """(Nv, 3) vertices of the mean body in T-pose, metres, y up, facing +z."""
    shapes: Array
    """(Nv, 3, 10) derivatives of the vertices by each beta, metres."""
    pose_blend: Array | None
    """(Nv, 3, 207) derivatives of the vertices by each entry of R - I, metres; None if the file has
    none or only zeros."""
    joint_regressor: Array
    """(24, Nv) regressor of the joints from the shaped template."""
    weights: Array
    """(Nv, 24) skinning weights; rows sum to 1."""
    keypoint_regressor: Array
    """(25, Nv) regressor of BODY_25 keypoints from the posed vertices."""
    faces: NDArray[np.int64]
    """(F, 3) vertex indices of the triangles."""

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of template, shapes and joint regressor, rounded to float32."""
        digest = hashlib.sha256()
        for array in (self.template, self.shapes, self.joint_regressor):
            digest.update(np.ascontiguousarray(array, dtype=np.float32).tobytes())
        return digest.hexdigest()


def read_smpl_file(path: Path, keypoint_regressor: Real | None = None) -> SmplArrays:
    """Read the model in `path`; raises InputError naming file, key and cure if it is unusable."""
    entries = _Entries(path, _read_entries(path))
    template = entries.floats("v_template", (None, 3))
    count = len(template)
    entries.check_tree()
    joint_regressor = entries.floats("J_regressor", (24, count))
    if keypoint_regressor is not None or _KEYPOINTS in entries.content:
        keypoints = entries.floats(_KEYPOINTS, (_NUM_KEYPOINTS, count), keypoint_regressor)
    elif count == _SMPL_NUM_VERTICES:
        keypoints = _smpl_keypoint_regressor(joint_regressor)
    else:
        raise InputError(
            f"{path}: no keypoint_regressor, and with {count} vertices this is not SMPL's own "
            f"mesh: add the key, or pass keypoint_regressor= ({_NUM_KEYPOINTS}, {count}), the "
            "weights that make BODY_25 from vertices"
        )
    problem = _implausible(template, joint_regressor, keypoints)
    if problem is not None:
        raise InputError(f"{path}: {problem}")
    return SmplArrays(
        template=template,
        shapes=entries.shapes(count),
        pose_blend=entries.pose_blend(count),
        joint_regressor=joint_regressor,
        weights=entries.weights(count),
        keypoint_regressor=keypoints,
        faces=entries.faces(count),
    )


def _read_entries(path: Path) -> dict[str, Any]:
    """The file's arrays, or records of them, by name."""
    if path.suffix not in (".npz", ".pkl"):
        raise InputError(f"{path}: a body model must be .npz or .pkl; give one of these")
    try:
        if path.suffix == ".pkl":
            return read_smpl_pickle(path)
        return read_npz(path, (*_KEYS, _KEYPOINTS), "download the file again")
    except InputError:
        raise
    except RefusedPickle as error:
        raise InputError(
            f"{path}: cannot be read safely ({error}); use the unchanged file from the model's "
            "site, or save its arrays as .npz"
        ) from error
    except Exception as error:  # a damaged pickle can raise any error
        raise InputError(
            f"{path}: cannot be read as a body model ({type(error).__name__}: {error}); download "
            "the file again"
        ) from error


class _Entries:
    """Validates the entries of one file."""

    def __init__(self, path: Path, content: dict[str, Any]):
        self.path, self.content = path, content

    def array(self, name: str) -> NDArray[Any]:
        """The array called `name`; raises InputError if it is missing or not an array."""
        if name not in self.content:
            raise InputError(f"{self.path}: {name} is missing; a body model has {' '.join(_KEYS)}")
        value = self.content[name]
        try:
            return value if isinstance(value, np.ndarray) else as_array(value)
        except Exception as error:  # records of a damaged pickle can contain anything
            raise InputError(
                f"{self.path}: {name} is not an array ({error}); download the file again"
            ) from error

    def floats(self, name: str, shape: tuple[int | None, ...], value: Any = None) -> Array:
        """The array `name`, or `value` in its place, validated as finite and of this shape; None is
        any positive length.
        """
        value = self.array(name) if value is None else np.asarray(value)
        fits = value.ndim == len(shape) and all(
            n == m if n is not None else m > 0 for n, m in zip(shape, value.shape, strict=True)
        )
        if not fits or value.dtype.kind not in "fiub":
            expected = ", ".join("Nv" if n is None else str(n) for n in shape)
            raise InputError(
                f"{self.path}: {name} must be numbers ({expected}), got {value.dtype} "
                f"{value.shape}: use an unchanged file of one model"
            )
        if not np.all(np.isfinite(value)):
            raise InputError(
                f"{self.path}: {name} has values that are not finite; download the file again"
            )
        return np.ascontiguousarray(value, dtype=np.float64)

    def shapes(self, count: int) -> Array:
        """The first 10 shape components, (Nv, 3, 10)."""
        shapes = self.array("shapedirs")
        if shapes.ndim != 3 or shapes.shape[2] < NUM_BETAS:
            raise InputError(
                f"{self.path}: shapedirs must be ({count}, 3, {NUM_BETAS} or more), got "
                f"{shapes.shape}: use the file with {NUM_BETAS} shape components"
            )
        return self.floats("shapedirs", (count, 3, NUM_BETAS), shapes[..., :NUM_BETAS])

    def pose_blend(self, count: int) -> Array | None:
        """The pose blend shapes, or None if the model has none."""
        if "posedirs" not in self.content or not np.any(self.array("posedirs")):
            return None
        return self.floats("posedirs", (count, 3, 207))

    def weights(self, count: int) -> Array:
        """Skinning weights, normalised so that rows sum to 1 exactly."""
        weights = self.floats("weights", (count, 24))
        total = weights.sum(1, keepdims=True)
        if np.any(weights < -1e-6) or np.any(np.abs(total - 1) > 1e-2):  # files round
            raise InputError(
                f"{self.path}: weights must be >= 0 with rows that sum to 1: not this model's file"
            )
        return weights / total

    def faces(self, count: int) -> NDArray[np.int64]:
        """Triangles, validated to use existing vertices."""
        faces = self.array("f")
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise InputError(
                f"{self.path}: f must be whole numbers (F, 3), got {faces.dtype} {faces.shape}"
            )
        faces = faces.astype(np.int64)
        if np.any(faces < 0) or np.any(faces >= count):
            raise InputError(
                f"{self.path}: f names vertices outside 0..{count - 1}; download the file again"
            )
        return faces

    def check_tree(self) -> None:
        """Raise InputError for any kinematic tree but SMPL's: fitters and priors use its 24 joints
        by index.
        """
        table = self.array("kintree_table")
        fits = table.shape == (2, 24) and table.dtype.kind in "iuf"
        if fits:
            parents = np.asarray(table[0], dtype=np.int64)
            fits = np.array_equal(parents[1:], SMPL_PARENTS[1:]) and np.array_equal(
                table[1], np.arange(24)
            )
        if not fits:
            raise InputError(
                f"{self.path}: kintree_table is not the tree of SMPL's 24 joints (shape "
                f"{table.shape}): use a SMPL body; SMPL-H, SMPL-X and others are not supported"
            )


_KEYPOINTS = "keypoint_regressor"
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")


def _smpl_keypoint_regressor(joint_regressor: Array) -> Array:
    """Regressor of BODY_25 keypoints for SMPL's own mesh: joints for the limbs, single vertices for
    face and feet.
    """
    regressor = np.zeros((_NUM_KEYPOINTS, _SMPL_NUM_VERTICES))
    for name, vertex in _SMPL_VERTEX_KEYPOINTS.items():
        regressor[BODY_25.index(name), vertex] = 1
    for name, joint in _BELONGS.items():
        regressor[BODY_25.index(name)] = joint_regressor[SMPL_24.index(joint)]
    for middle, sides in {"Neck": ("RShoulder", "LShoulder"), "MidHip": ("RHip", "LHip")}.items():
        regressor[BODY_25.index(middle)] = regressor[[BODY_25.index(side) for side in sides]].mean(
            0
        )
    return regressor


def _implausible(template: Array, joint_regressor: Array, keypoint_regressor: Array) -> str | None:
    """The first problem, as the end of a sentence that names the array; None if the body is
    plausible.

    `template` (Nv, 3) in T-pose, y up, facing +z; regressors (24, Nv) and (25, Nv).
    """
    height = float(np.ptp(template[:, 1]))
    if not _HEIGHT_M[0] <= height <= _HEIGHT_M[1]:
        return f"v_template is {height:.4g} high along y: give it in metres, y up"
    for name, regressor in (
        ("J_regressor", joint_regressor),
        ("keypoint_regressor", keypoint_regressor),
    ):
        off = np.abs(regressor.sum(axis=1) - 1).max()
        # Tolerance for row sums of regressors, which are weighted means printed with few digits.
        if off > 0.02:
            return (
                f"{name} has rows that do not sum to 1 (off by {off:.2g}): use an unchanged file "
                "of one model"
            )
    joints: dict[str, Array] = dict(zip(SMPL_24, joint_regressor @ template, strict=True))
    keypoints: dict[str, Array] = dict(
        zip(BODY_25.joints, keypoint_regressor @ template, strict=True)
    )
    for part in (*_RISING, "elbow", "wrist"):
        if not joints[f"left_{part}"][0] > joints[f"right_{part}"][0]:
            return (
                f"J_regressor puts left_{part} to the right of right_{part}: the body's left is +x"
            )
    for side in ("left", "right"):
        for low, high in pairwise(_RISING):
            if not joints[f"{side}_{low}"][1] < joints[f"{side}_{high}"][1]:
                return (
                    f"J_regressor puts {side}_{low} above {side}_{high}: rows are SMPL's joints "
                    "in order, y is up"
                )
    for name, joint in _BELONGS.items():
        distance = float(np.linalg.norm(keypoints[name] - joints[joint]))
        side, part = joint.split("_")
        mirrored = joints[f"{'right' if side == 'left' else 'left'}_{part}"]
        # Maximum distance of a keypoint from its SMPL joint, as a share of the body's height.
        if distance > 0.15 * height or distance > np.linalg.norm(keypoints[name] - mirrored):
            return (
                f"keypoint_regressor puts {name} {distance:.2g} m from {joint}: rows are BODY_25 "
                "in order"
            )
    return None
