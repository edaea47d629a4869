"""A calibration as the file states it: poses in the file's own unit, and missing information left open."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis, Camera
from shapepose_fg.core.decompositions import ROTATION_TOLERANCE, nearest_rotation, rigid
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.lens import Lens, padded_distortion
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.validation import describe

Unit = Literal["m", "cm", "mm"]
"""The unit of lengths in a calibration file."""
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each unit, metres."""

_EXACT = 1e-12
"""Deviation below which a rotation is kept as written, so that a rig that is written and read stays the same."""
_MOST_COEFFICIENTS = 14


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
    """Width and height of the picture, pixels; None where the file does not state them."""
    distortion: Sequence[float] = ()
    """Coefficients in OpenCV's order; missing ones at the end are 0."""
    lens: Lens = "perspective"
    """Lens model of the coefficients."""
    readout_s: float = 0.0
    """Time that the shutter takes from the first row of a picture to the last, seconds."""
    trajectory: str = ""
    """The name of the trajectory that carries the camera; `wTc` is then the pose on the carrier."""

    def finished(self, metres: float, image_size: tuple[int, int] | None, path: Path) -> Camera:
        """The camera in metres; InputError where its numbers are those of no camera."""
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
    """Unit of the translations; None where the file and its format do not say."""
    up: Axis | None
    """Axis that points up; None where the file and its format do not state it."""
    cures: Mapping[str, str] = field(default_factory=dict)
    """Cures for missing information, by field: "unit", "up" or "image_size"."""
    trajectories: Sequence[Trajectory] = ()
    """Trajectories of the carriers of cameras."""
    notes: Sequence[str] = ()
    """Notes, a sentence each, on what was left out of the file or assumed."""


@dataclass(frozen=True)
class Format:
    """A format of calibrations."""

    name: str
    """Name of the format, for messages."""
    read: Callable[[Content], WrittenRig | None]
    """The cameras; None where the content is of another format, InputError where it is of this one and faulty."""


@dataclass(frozen=True)
class Node:
    """Named values of a file. Anything wrong with one is an InputError with place, name and cure."""

    values: Mapping[str, Any]
    """Numbers, lists of them, arrays, and other things; None counts as missing."""
    place: str
    """The file, and the camera in it."""
    cures: Mapping[str, str] = field(default_factory=dict)
    """Cures by name; under the empty name for all others."""

    def refuse(self, name: str, problem: str) -> InputError:
        """An error about one of the values."""
        cure = self.cures.get(name.partition("[")[0], self.cures.get("", "correct it in the file"))
        return InputError(f"{self.place}: {name} {problem}; {cure}")

    def named(self, names: str | Sequence[str]) -> str | None:
        """The first of several names, separated by spaces, that has a value."""
        every = names.split() if isinstance(names, str) else names
        return next((name for name in every if self.values.get(name) is not None), None)

    def numbers(self, names: str | Sequence[str], *counts: int, most: int = -1) -> Array | None:
        """The numbers, flat, under the first existing one of `names`; None where none exists.

        They are finite, and as many as one of `counts`, or at most `most` of them.
        """
        name = self.named(names)
        if name is None:
            return None
        value = self.values[name]
        noun = "number" if counts == (1,) else "numbers"
        wanted = f"{' or '.join(map(str, counts)) or f'at most {most}'} {noun}"
        if counts != (1,) and not isinstance(value, list | np.ndarray):
            raise self.refuse(name, f"must hold {wanted}, got {describe(value)}")
        found = np.array(list(self._flat(name, value)))
        if len(found) not in counts and not len(found) <= most:
            raise self.refuse(name, f"must hold {wanted}, got {len(found)}")
        try:
            np.array(value, dtype=np.float64)
        except ValueError:
            raise self.refuse(name, "must have rows of equal length") from None
        return found

    def needed(self, names: str | Sequence[str], *counts: int, most: int = -1) -> Array:
        """Return `numbers` that must be there; InputError where they are missing."""
        found = self.numbers(names, *counts, most=most)
        if found is None:
            raise self.refuse(names.split()[0] if isinstance(names, str) else names[0], "is missing")
        return found

    def camera(
        self,
        name: str,
        K: str | Sequence[str],
        wTc: Array,
        size: Sequence[str | Sequence[str]],
        distortion: str | Sequence[str],
        lens: Lens = "perspective",
        most: int = _MOST_COEFFICIENTS,
    ) -> WrittenCamera:
        """A camera at `wTc`; its intrinsics by their names, `size` by that of a list of two numbers, or by two."""
        sides = [self.numbers(each, 2 if len(size) == 1 else 1) for each in size]
        given = [round(side) for each in sides if each is not None for side in each]
        K_flat, coefficients = self.needed(K, 9), self.numbers(distortion, most=most)
        listed = [] if coefficients is None else coefficients.tolist()
        image_size = (given[0], given[1]) if len(given) == 2 else None
        return WrittenCamera(name, K_flat.reshape(3, 3), wTc, image_size, listed, lens)

    def pose(self, R: str, t: str, *, centre: bool = False) -> Array:
        """World from camera, of a rotation (9 numbers, or axis times angle) and a translation, or `centre`."""
        turn, shift = self.needed(R, 9) if centre else self.needed(R, 9, 3), self.needed(t, 3)
        return pose(turn, shift, self.named(R) or R, self.place, centre=centre)

    def pose_of_rows(self, name: str) -> Array:
        """World from camera, of camera from world as 3 x 4 numbers."""
        cTw = self.needed(name, 12).reshape(3, 4)
        return pose(cTw[:, :3], cTw[:, 3], name, self.place)

    def pose_of_matrix(self, name: str) -> Array:
        """World from camera as written, 4 x 4 numbers."""
        wTc = self.needed(name, 16).reshape(4, 4)
        if np.any(wTc[3] != (0, 0, 0, 1)):
            raise self.refuse(name, "must have the last row 0 0 0 1")
        return pose(wTc[:3, :3], wTc[:3, 3], name, self.place, world_from_camera=True)

    def _flat(self, name: str, value: Any) -> Iterator[float]:
        """All numbers of a value; `name` says where it is."""
        if isinstance(value, list | np.ndarray):
            for index, each in enumerate(value.tolist() if isinstance(value, np.ndarray) else value):
                yield from self._flat(f"{name}[{index}]", each)
        elif isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(name, f"must be a number, got {describe(value)}")
        elif not np.isfinite(value):
            raise self.refuse(name, f"must be a finite number, got {describe(value)}")
        else:
            yield float(value)


def pose(
    R: ArrayLike, t: ArrayLike, key: str, place: str, *, world_from_camera: bool = False, centre: bool = False
) -> Array:
    """The world-from-camera matrix (4, 4) of a rotation and a translation (3), or the camera's `centre`.

    They are camera-from-world unless said otherwise. `R` is a matrix (nine numbers in any shape, row by row) or
    a rotation vector (three, axis times angle). InputError where it is no rotation: `key` is its name in the
    file, `place` the file and the camera.
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
    if off >= _EXACT:
        R = nearest_rotation(R)
    if world_from_camera:
        return rigid(R, t)
    return rigid(R.T, t if centre else -R.T @ t)


def rotation_of(quaternion: ArrayLike, key: str, place: str) -> Array:
    """The rotation matrix (3, 3) of a quaternion x y z w; InputError where it is not of length 1."""
    length = float(np.sqrt(np.square(quaternion).sum()))
    if not abs(length - 1) <= ROTATION_TOLERANCE:
        raise InputError(f"{place}: the quaternion {key} must have length 1, got {length:.4g}; write it again")
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Array:
    """The intrinsic matrix (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
