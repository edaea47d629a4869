"""The 3D scene of a report: people, bodies, cameras and floor as small arrays for the page's script."""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.drawing import PALETTE, bones_of, thinned
from shapepose_fg.core.reconstruction import Known, sigma_m
from shapepose_fg.io.export.skinned import BONES, motion_of
from shapepose_fg.io.export.take import Take, z_up

_MISSING = -32768
"""Value of an unknown coordinate."""
_FINEST_MM = 1.0
"""Resolution of positions, mm; coarser where the scene is more than 65 m wide."""
_OCTAVE, _LEVELS = 8, 63
"""Standard deviations have 63 levels, eight per doubling, from 1 mm on: 9 % apart, in six bits."""
_FLOOR_M = 0.3
"""Height of feet within which the floor is drawn at 0, m."""
CELL_M = 0.05
"""Size of cells with one vertex of a body each, m: 860 of the open body's 12,488, which a page can draw in
every frame."""
_ROW_BYTES = 8 * BONES + 6
"""Size of a body in a frame, bytes: quaternions and the pelvis."""
_MOST_BONES = 4
"""Maximum number of bones of a vertex; the strongest are kept."""
_TURN = 32767
"""Scale of a quaternion's entries, which are stored as integers."""


@dataclass(frozen=True)
class Scene:
    """Data of a page, and the frames of the recording that it has."""

    data: dict[str, Any]
    """The data for the page's script: plain values for JSON."""
    every: int
    """Step between the frames that it has."""
    kept: int
    """Number of these frames."""
    frames: int
    """Number of frames of the recording."""


def scene_of(take: Take, arrays: SmplArrays | None, most_bytes: int) -> Scene:
    """The scene in at most about `most_bytes`, with every second, third ... frame if need be.

    The page's axes are those of the world rotated so that z is up. Bodies where `arrays`, the body model, is
    given.
    """
    J = len(take.people.joint_names)
    row_bytes = 4 / 3 * (6 * J + J + 2 + (_ROW_BYTES if arrays is not None else 0))
    every = max(1, int(np.ceil(len(take.people) * row_bytes / most_bytes)))
    index = np.arange(0, len(take.frames), every)
    axes = z_up(take.up)
    # By frame, and within a frame by person.
    frame, person = np.nonzero(take.rows[:, index].T >= 0)
    rows = take.rows[person, index[frame]]
    joints = take.people.joints[rows] @ axes.T
    # Cameras that move are drawn where they are at first.
    cameras = () if take.rig is None else take.rig.at(np.full(len(take.rig), take.times_s[:1].sum())).cameras
    centres = np.array([camera.centre for camera in cameras]).reshape(-1, 3) @ axes.T
    pack = _packing(joints)
    sigma = sigma_m(take.people.covariance[rows])
    counts = np.bincount(frame, minlength=len(index))
    scene = {
        "unit": pack.unit_m,
        "origin": pack.origin.tolist(),
        "axes": axes.T.tolist(),
        "frames": _base64(take.frames[index], "<i4"),
        "times": _base64(take.times_s[index] - take.times_s[0], "<f4"),
        "starts": _base64(np.r_[0, np.cumsum(counts)], "<i4"),
        "who": _base64(person, "<u2"),
        "joints": _base64(pack(joints), "<i2"),
        "known": _base64(_known_and_sigma(take.people.known[rows], sigma), "u1"),
        "joint_names": take.people.joint_names.tolist(),
        "bones": bones_of(tuple(take.people.joint_names.tolist())).tolist(),
        "people": [{"id": int(who), "colour": PALETTE[who % len(PALETTE)]} for who in take.persons],
        "cameras": [camera_of(camera, axes) for camera in cameras],
        "floor": _floor(joints),
        "view": _view(joints, centres),
    }
    if arrays is not None:
        scene |= _bodies(take, arrays, axes, index[frame], person, pack)
    return Scene(scene, every, len(index), len(take.frames))


@dataclass(frozen=True)
class _Packing:
    """Positions as integers of a unit from an origin."""

    origin: Array
    """(3,) origin, metres."""
    unit_m: float
    """Unit, metres."""

    def __call__(self, points: Array) -> Array:
        """(..., 3) whole numbers of points (..., 3); missing where a point is not known or too far."""
        steps = np.rint((points - self.origin) / self.unit_m)
        near = np.isfinite(steps).all(axis=-1, keepdims=True) & (np.abs(steps) < -_MISSING).all(-1, keepdims=True)
        return np.where(near, steps, _MISSING)


def _packing(joints: Array) -> _Packing:
    """The unit and origin for some joints."""
    placed = joints[np.isfinite(joints).all(axis=-1)]
    if len(placed) == 0:
        return _Packing(np.zeros(3), 1e-3 * _FINEST_MM)
    low, high = placed.min(axis=0), placed.max(axis=0)
    # Bodies reach a little farther than joints.
    coarse = float(np.ceil(1e3 * ((high - low).max() + 2.0) / 2 / 32000))
    return _Packing((low + high) / 2, 1e-3 * max(_FINEST_MM, coarse))


def _known_and_sigma(known: NDArray[np.uint8], sigma: Array) -> NDArray[np.uint8]:
    """Codes with how a joint is known in the two low bits, and the level of its sigma in the six above; 0 is
    unknown.

    A weakly seen joint is drawn like one from the body.
    """
    known = np.where(known == Known.WEAK, Known.BODY, known)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = 1 + np.rint(_OCTAVE * np.log2(1e3 * sigma))
    level = np.where(np.isfinite(level), np.clip(level, 1, _LEVELS), 0)
    return (known + 4 * level).astype(np.uint8)


def _floor(joints: Array) -> float:
    """Height of the floor, metres: 0 where feet are near it, else that of the lowest joints."""
    height = joints[..., 2]
    placed = np.isfinite(height)
    if not placed.any():
        return 0.0
    lowest = np.min(np.where(placed, height, np.inf), axis=1)
    ground = float(np.quantile(lowest[np.isfinite(lowest)], 0.2))
    return 0.0 if abs(ground) < _FLOOR_M else ground


def _view(joints: Array, centres: Array) -> dict[str, Any]:
    """The initial view: the box around people, and the extent of people and cameras."""
    points = joints.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        points = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.8]])
    # A joint that ran away is not looked at.
    low, high = np.quantile(points, [0.003, 0.997], axis=0)
    low, high = np.minimum(low, high - 1.0), np.maximum(high, low + 1.0)
    middle = (low + high) / 2
    reach = float(np.linalg.norm(high - low)) / 2
    away = np.linalg.norm((centres - middle)[:, :2], axis=1).max(initial=0.0)
    box = {"low": low.tolist(), "high": high.tolist(), "middle": middle.tolist()}
    return box | {"reach": max(reach, 1.0), "cameras": float(away)}


def camera_of(camera: Camera, axes: Array) -> dict[str, Any]:
    """A camera in the page's axes; the columns of `turn` point right, down and forward."""
    width, height = camera.image_size
    return {
        "name": camera.name,
        "centre": (axes @ camera.centre).tolist(),
        "turn": (axes @ camera.wTc[:3, :3]).T.tolist(),
        "K": [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]],
        "size": [width, height],
    }


def _bodies(
    take: Take, arrays: SmplArrays, axes: Array, frame: Index, person: Index, pack: _Packing
) -> dict[str, Any]:
    """The bodies of N rows, each a `person` (N,) of the take in a `frame` (N,), for the page's script to bend.

    All share one light `mesh`: faces (F, 3), and each vertex's bones (M, 4) with their weights of 255. `rest`
    (P, M, 3) and `rest_joints` (P, 24, 3) are people in the T-pose; `turns` (N, 24, 4) are quaternions x y z w of
    bones against their parents, and `pelvis` (N, 3) is where it is. Rows without a body are missing in them.
    """
    kept, faces, _ = thinned(arrays.template, arrays.faces, CELL_M)
    order = np.argsort(-arrays.weights[kept], axis=1, kind="stable")[:, :_MOST_BONES]
    weights = np.take_along_axis(arrays.weights[kept], order, axis=1)
    weights = np.rint(255 * weights / weights.sum(axis=1, keepdims=True))
    P, N = len(take.persons), len(frame)
    rest, joints = np.full((P, len(kept), 3), np.nan), np.full((P, BONES, 3), np.nan)
    turns, pelvis = np.full((N, BONES, 4), np.nan), np.full((N, 3), np.nan)
    for each in range(P):
        motion = motion_of(take, each, arrays, axes)
        if motion is None:
            continue
        rest[each], joints[each] = motion.rest.vertices[kept], motion.rest.joints
        place = np.full(len(take.frames), -1)
        place[motion.index] = np.arange(len(motion.index))
        mine = np.flatnonzero((person == each) & (place[frame] >= 0))
        turns[mine], pelvis[mine] = motion.rotations[place[frame[mine]]], motion.pelvis[place[frame[mine]]]
    millimetres = _Packing(np.zeros(3), 1e-3)
    return {
        "mesh": {
            "faces": _base64(faces, "<i2"),
            "bones": _base64(order, "<i2"),
            "weights": _base64(weights, "u1"),
            "parents": _base64(np.array(SMPL_PARENTS), "<i2"),
        },
        "rest": _base64(millimetres(rest), "<i2"),
        "rest_joints": _base64(millimetres(joints), "<i2"),
        "turns": _base64(np.rint(_TURN * np.nan_to_num(turns)), "<i2"),
        "pelvis": _base64(pack(pelvis), "<i2"),
    }


def _base64(values: NDArray[Any], kind: str) -> str:
    """Numbers as the page's script decodes them into a typed array."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind)).tobytes()).decode("ascii")
