"""The content of a calibration file before conversion: poses in the unit of the file, missing
values as None.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.bounds import Axis
from shapepose_fg.core.bounds import Unit as Unit
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.decompositions import ROTATION_TOLERANCE, nearest_rotation, rigid
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.lens import Lens, padded_distortion
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.core.validation import describe, numbers
from shapepose_fg.io.calibration.content import Content

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each unit, metres."""


@dataclass(frozen=True)
class WrittenCamera:
    """One camera of a calibration file."""

    name: str
    """Name in the file."""
    K: Array
    """(3, 3) intrinsic matrix, pixels; (0, 0) is the centre of the first pixel."""
    wTc: Array
    """(4, 4) world-from-camera pose in the file's unit; x right, y down, z forward."""
    image_size: tuple[int, int] | None
    """Width and height of the picture, pixels; None if the file does not state them."""
    distortion: Sequence[float] = ()
    """Coefficients in OpenCV's order; missing trailing ones are 0."""
    lens: Lens = "perspective"
    """Lens model of the coefficients."""
    readout_s: float = 0.0
    """Readout time of a rolling shutter, from the first row of a picture to the last, seconds."""
    trajectory: str = ""
    """The name of the trajectory that carries the camera; `wTc` is then the pose on the carrier."""

    def finished(self, metres: float, image_size: tuple[int, int] | None, path: Path) -> Camera:
        """Convert to a camera in metres; InputError if its values are not valid for a camera."""
        wTc = self.wTc.copy()
        wTc[:3, 3] *= metres
        size = self.image_size or image_size or (0, 0)
        with naming(path, "correct it in the file"):
            bend = padded_distortion(self.distortion, self.lens)
            mount = {"carrier": self.trajectory, "bTc": wTc} if self.trajectory else {}
            return Camera(self.name, self.K, wTc, size, bend, self.lens, self.readout_s, **mount)


@dataclass(frozen=True)
class WrittenRig:
    """The content of a calibration file."""

    cameras: Sequence[WrittenCamera]
    """The cameras in the order of the file."""
    unit: Unit | None
    """Unit of the translations; None if neither the file nor its format defines it."""
    up: Axis | None
    """Axis that points up; None if neither the file nor its format defines it."""
    cures: Mapping[str, str] = field(default_factory=dict)
    """Advice for error messages about missing values, by field: "unit", "up" or "image_size"."""
    trajectories: Sequence[Trajectory] = ()
    """Trajectories of the carriers of cameras."""
    notes: Sequence[str] = ()
    """Notes, a sentence each, on ignored parts of the file and on assumptions."""


@dataclass(frozen=True)
class CalibrationFormat:
    """A calibration format."""

    name: str
    """Name of the format, for messages."""
    read: Callable[[Content], WrittenRig | None]
    """Function that reads the cameras; None if the content has another format, InputError if it is
    damaged."""


@dataclass(frozen=True)
class Node:
    """Named values of a file, with checked access. An invalid value raises InputError with place,
    name and cure.
    """

    values: Mapping[str, Any]
    """Numbers, lists of numbers, arrays, and other values; None counts as missing."""
    place: str
    """File and camera, for messages."""
    cures: Mapping[str, str] = field(default_factory=dict)
    """Advice for error messages by name; under "" for all other names."""

    def refuse(self, name: str, problem: str) -> InputError:
        """An error about the value `name`."""
        return InputError(f"{self.place}: {name} {problem}; {self._cure(name)}")

    def _cure(self, name: str) -> str:
        return self.cures.get(name, self.cures.get("", "correct it in the file"))

    def named(self, names: str | Sequence[str]) -> str | None:
        """The first of several names, separated by spaces, that exists in the file."""
        every = names.split() if isinstance(names, str) else names
        return next((name for name in every if self.values.get(name) is not None), None)

    def numbers(self, names: str | Sequence[str], *counts: int, most: int = -1) -> Array | None:
        """The values under the first existing one of `names`, flattened; None if none exists.

        InputError unless they are finite, and their number is one of `counts`, or at most `most`.
        """
        name = self.named(names)
        if name is None:
            return None
        value = self.values[name]
        noun = "number" if counts == (1,) else "numbers"
        wanted = f"{' or '.join(map(str, counts)) or f'at most {most}'} {noun}"
        if counts != (1,) and not isinstance(value, list | np.ndarray):
            raise self.refuse(name, f"must hold {wanted}, got {describe(value)}")
        found = numbers(value, f"{self.place}: {name}", self._cure(name)).ravel()
        if len(found) not in counts and not len(found) <= most:
            raise self.refuse(name, f"must hold {wanted}, got {len(found)}")
        return found

    def needed(self, names: str | Sequence[str], *counts: int, most: int = -1) -> Array:
        """Like `numbers`, but InputError if they are missing."""
        found = self.numbers(names, *counts, most=most)
        if found is None:
            raise self.refuse(
                names.split()[0] if isinstance(names, str) else names[0], "is missing"
            )
        return found

    def camera(
        self,
        name: str,
        K: str | Sequence[str],
        wTc: Array,
        size: Sequence[str | Sequence[str]],
        distortion: str | Sequence[str],
        lens: Lens = "perspective",
        most: int = 14,
    ) -> WrittenCamera:
        """A camera with the pose `wTc`. Intrinsics are read by their names; `size` is the name of a
        list of two values, or two names.
        """
        sides = [self.numbers(each, 2 if len(size) == 1 else 1) for each in size]
        given = [round(side) for each in sides if each is not None for side in each]
        K_flat, coefficients = self.needed(K, 9), self.numbers(distortion, most=most)
        listed = [] if coefficients is None else coefficients.tolist()
        image_size = (given[0], given[1]) if len(given) == 2 else None
        return WrittenCamera(name, K_flat.reshape(3, 3), wTc, image_size, listed, lens)

    def pose(self, R: str, t: str, *, centre: bool = False) -> Array:
        """World from camera, from a rotation (9 values, or a rotation vector) and a translation, or
        the camera's `centre`.
        """
        turn, shift = self.needed(R, 9) if centre else self.needed(R, 9, 3), self.needed(t, 3)
        return pose(turn, shift, self.named(R) or R, self.place, centre=centre)

    def pose_of_rows(self, name: str) -> Array:
        """World from camera, from a 3 x 4 camera-from-world matrix."""
        cTw = self.needed(name, 12).reshape(3, 4)
        return pose(cTw[:, :3], cTw[:, 3], name, self.place)

    def pose_of_matrix(self, name: str) -> Array:
        """World from camera, from a 4 x 4 world-from-camera matrix."""
        wTc = self.needed(name, 16).reshape(4, 4)
        if np.any(wTc[3] != (0, 0, 0, 1)):
            raise self.refuse(name, "must have the last row 0 0 0 1")
        return pose(wTc[:3, :3], wTc[:3, 3], name, self.place, world_from_camera=True)


def pose(
    R: ArrayLike,
    t: ArrayLike,
    key: str,
    place: str,
    *,
    world_from_camera: bool = False,
    centre: bool = False,
) -> Array:
    """The world-from-camera matrix (4, 4) of a rotation and a translation (3), or the camera's
    `centre`.

    They are camera-from-world, unless `world_from_camera` is set. `R` is a matrix (nine values in
    any shape, row by row) or a rotation vector (three values, axis-angle). InputError if it is no
    rotation; `key` is its name in the file, `place` the file and the camera.
    """
    R, t = np.asarray(R, dtype=np.float64).ravel(), np.asarray(t, dtype=np.float64).ravel()
    R = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64) if R.size == 3 else R.reshape(3, 3)
    off = np.abs(R @ R.T - np.eye(3)).max()
    if not off <= ROTATION_TOLERANCE:
        problem = f"the rotation of {key} is not orthonormal (R Rᵀ is off by {off:.2g})"
        raise InputError(f"{place}: {problem}; give a pure rotation without scale, row by row")
    if np.linalg.det(R) < 0:
        cure = "use a right-handed world and OpenCV's camera axes: x right, y down, z forward"
        raise InputError(f"{place}: the rotation of {key} is a reflection (determinant -1); {cure}")
    # Deviation from orthonormal below which a rotation is not changed, so that writing and
    # reading a rig is lossless.
    if off >= 1e-12:
        R = nearest_rotation(R)
    if world_from_camera:
        return rigid(R, t)
    return rigid(R.T, t if centre else -R.T @ t)


def rotation_of(quaternion: ArrayLike, key: str, place: str) -> Array:
    """The rotation matrix (3, 3) of a quaternion x y z w; InputError if its norm is not 1."""
    length = float(np.sqrt(np.square(quaternion).sum()))
    if not abs(length - 1) <= ROTATION_TOLERANCE:
        raise InputError(
            f"{place}: the quaternion {key} must have length 1, got {length:.4g}; write it again"
        )
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Array:
    """The intrinsic matrix (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
