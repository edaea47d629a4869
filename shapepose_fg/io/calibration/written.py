"""A calibration as its file says it: poses in the file's own unit, and what the file does not say left open."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, FiniteFloat

from shapepose_fg.core.camera import Axis, Camera, Lens, padded_distortion
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content

Unit = Literal["m", "cm", "mm"]
"""The unit of lengths in a calibration file."""
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""How long each unit is."""

_ROTATION_TOLERANCE = 1e-3
"""How far R Rᵀ may be from the identity: calibrations are printed with four to six digits."""
_MOST_PIXELS = 1_000_000
_EXACT = 1e-12
"""Below this a rotation is left as written, so that a rig that is written and read stays the same."""

Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Matrix33 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
Pixels = Annotated[int, Field(gt=0, strict=False)]
ImageSize = Annotated[list[Pixels], Field(min_length=2, max_length=2)]

ONE_CAMERA = "give the calibration of the whole rig, intrinsics and poses"
"""The cure for a file that holds the intrinsics of one camera alone."""


@dataclass(frozen=True)
class WrittenCamera:
    """One camera of a calibration file."""

    name: str
    """What the file calls it."""
    K: NDArray[np.float64]
    """(3, 3) intrinsic matrix, pixels; (0, 0) is the centre of the first pixel."""
    wTc: NDArray[np.float64]
    """(4, 4) world-from-camera pose in the file's unit; x right, y down, z forward."""
    image_size: tuple[int, int] | None
    """(width, height), pixels; None where the file does not say."""
    distortion: Sequence[float] = ()
    """In OpenCV's order; coefficients at the end may be left out."""
    lens: Lens = "perspective"
    """Which lens the coefficients belong to."""


@dataclass(frozen=True)
class WrittenRig:
    """What a calibration file says."""

    cameras: Sequence[WrittenCamera]
    """In the order of the file."""
    unit: Unit | None
    """Of the translations; None where the file and its format do not say."""
    up: Axis | None
    """Which axis points up; None where the file and its format do not say."""
    cures: Mapping[str, str] = field(default_factory=dict)
    """How the user can say what the file does not, by field: "unit", "up" or "image_size"."""


@dataclass(frozen=True)
class Format:
    """One way in which calibrations are written."""

    name: str
    """For messages."""
    recognise: Callable[[Content], bool]
    """Whether a content is meant to be of this format, though it may be faulty."""
    read: Callable[[Content], WrittenRig]
    """The cameras; InputError naming file, place and cure where it is faulty."""
    cure: str = "correct it in the file"
    """What to do where the numbers are those of no camera."""


def pose(
    R: ArrayLike, t: ArrayLike, key: str, place: str, *, world_from_camera: bool = False
) -> NDArray[np.float64]:
    """The world-from-camera matrix (4, 4) of a rotation and a translation.

    They are camera-from-world unless said otherwise. `R` is a matrix (nine numbers in any shape, row by row) or
    a rotation vector (three, axis times angle). InputError where it is no rotation: `key` is its name in the
    file, `place` the file and the camera.
    """
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
    if R.size not in (3, 9) or len(t) != 3:
        raise InputError(
            f"{place}: {key} must hold 9 numbers (or 3, axis times angle) and its translation 3, got {R.size} and"
            f" {len(t)}; write both again"
        )
    R = np.asarray(cv2.Rodrigues(R.ravel())[0], dtype=np.float64) if R.size == 3 else R.reshape(3, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers like 1e300, which are refused here
        off = np.abs(R @ R.T - np.eye(3)).max()
    if not off <= _ROTATION_TOLERANCE:
        raise InputError(
            f"{place}: the rotation of {key} is not orthonormal (R Rᵀ is off by {off:.2g});"
            " give a pure rotation without scale, row by row"
        )
    if np.linalg.det(R) < 0:
        raise InputError(
            f"{place}: the rotation of {key} mirrors (determinant -1); use a right-handed world and"
            " OpenCV's camera axes: x right, y down, z forward"
        )
    if off >= _EXACT:
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
    wTc = np.eye(4)
    wTc[:3, :3] = R if world_from_camera else R.T
    wTc[:3, 3] = t if world_from_camera else -R.T @ t
    return wTc


def rotation_of(quaternion: ArrayLike, key: str, place: str) -> NDArray[np.float64]:
    """The rotation matrix (3, 3) of a quaternion x y z w; InputError where it is not of length 1."""
    x, y, z, w = np.asarray(quaternion, dtype=np.float64)
    length = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not abs(length - 1) <= _ROTATION_TOLERANCE:
        raise InputError(f"{place}: the quaternion {key} must have length 1, got {length:.4g}; write it again")
    x, y, z, w = (value / length for value in (x, y, z, w))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def picture_size(width: Any, height: Any, place: str) -> tuple[int, int] | None:
    """Width and height in pixels, None where neither is there; InputError where they are no numbers of pixels."""
    if width is None and height is None:
        return None
    sides = [side for side in (width, height) if isinstance(side, int | float) and 1 <= side <= _MOST_PIXELS]
    if len(sides) < 2:
        raise InputError(f"{place}: the picture's size must be pixels, got {width} x {height}; correct it")
    return round(sides[0]), round(sides[1])


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """The intrinsic matrix (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def finished(written: WrittenCamera, metres: float, image_size: tuple[int, int], path: Path, cure: str) -> Camera:
    """The camera in metres; InputError with `cure` where its numbers are those of no camera."""
    wTc = written.wTc.copy()
    wTc[:3, 3] *= metres
    size = image_size if written.image_size is None else written.image_size
    try:
        distortion = padded_distortion(written.distortion, written.lens)
        return Camera(written.name, written.K, wTc, size, distortion, written.lens)
    except ValueError as error:
        raise InputError(f"{path}: {error}; {cure}") from None
