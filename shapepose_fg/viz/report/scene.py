"""The 3D scene of a report: people, bodies, cameras and floor as compact arrays for the page's
script.
"""

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
from shapepose_fg.core.world_axes import z_up
from shapepose_fg.io.export.skinned import BONES, motion_of
from shapepose_fg.io.export.take import Take

_MISSING = -32768
"""Code of an unknown coordinate."""
_FINEST_MM = 1.0
"""Resolution of positions, mm; coarser if the scene is more than 65 m wide."""
CELL_M = 0.05
"""Size of the grid cells in which one vertex of a body is kept, m. The open body then has 860 of
its 12,488 vertices, which a page can draw in every frame."""


@dataclass(frozen=True)
class PageScene:
    """What the 3D scene of a report page draws, and in which frames of the recording."""

    data: dict[str, Any]
    """The data for the page's script: plain values for JSON."""
    every: int
    """Step between the frames of the scene."""
    kept: int
    """Number of frames in the scene."""
    frames: int
    """Number of frames of the recording."""


def scene_of(take: Take, arrays: SmplArrays | None, most_bytes: int) -> PageScene:
    """The scene with at most about `most_bytes`; if necessary, only every second, third ... frame
    is used.

    The page's axes are those of the world rotated so that z is up. Bodies are included if the body
    model `arrays` is given.
    """
    J = len(take.people.joint_names)
    # Size of a body in a frame, bytes: quaternions and pelvis position.
    row_bytes = 4 / 3 * (6 * J + J + 2 + ((8 * BONES + 6) if arrays is not None else 0))
    every = max(1, int(np.ceil(len(take.people) * row_bytes / most_bytes)))
    index = np.arange(0, len(take.frames), every)
    axes = z_up(take.up)
    # Sorted by frame, and within a frame by person.
    frame, person = np.nonzero(take.rows[:, index].T >= 0)
    rows = take.rows[person, index[frame]]
    joints = take.people.joints[rows] @ axes.T
    # Moving cameras are drawn at their initial poses.
    cameras = (
        ()
        if take.rig is None
        else take.rig.at(np.full(len(take.rig), take.times_s[:1].sum())).cameras
    )
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
        "people": [
            {"id": int(identity), "colour": PALETTE[identity % len(PALETTE)]}
            for identity in take.persons
        ],
        "cameras": [scene_camera(camera, axes) for camera in cameras],
        "floor": _floor(joints),
        "view": _view(joints, centres),
    }
    if arrays is not None:
        scene |= _bodies(take, arrays, axes, index[frame], person, pack)
    return PageScene(scene, every, len(index), len(take.frames))


@dataclass(frozen=True)
class _Packing:
    """Positions as integer multiples of a unit, relative to an origin."""

    origin: Array
    """(3,) origin, metres."""
    unit_m: float
    """Length of one unit of the integers, metres."""

    def __call__(self, points: Array) -> Array:
        """Convert points (..., 3) to integers (..., 3); unknown or too distant points become
        `_MISSING`.
        """
        steps = np.rint((points - self.origin) / self.unit_m)
        near = np.isfinite(steps).all(axis=-1, keepdims=True) & (np.abs(steps) < -_MISSING).all(
            -1, keepdims=True
        )
        return np.where(near, steps, _MISSING)


def _packing(joints: Array) -> _Packing:
    """Unit and origin for the given joints."""
    placed = joints[np.isfinite(joints).all(axis=-1)]
    if len(placed) == 0:
        return _Packing(np.zeros(3), 1e-3 * _FINEST_MM)
    low, high = placed.min(axis=0), placed.max(axis=0)
    # Surfaces of bodies extend slightly beyond joints.
    coarse = float(np.ceil(1e3 * ((high - low).max() + 2.0) / 2 / 32000))
    return _Packing((low + high) / 2, 1e-3 * max(_FINEST_MM, coarse))


def _known_and_sigma(known: NDArray[np.uint8], sigma: Array) -> NDArray[np.uint8]:
    """Codes of one byte: how a joint is known in the two low bits, and the level of its sigma in
    the six high bits; 0 for unknown.

    Joints of kind `WEAK` are drawn like those of kind `BODY`.
    """
    known = np.where(known == Known.WEAK, Known.BODY, known)
    with np.errstate(invalid="ignore", divide="ignore"):
        # Quantisation of standard deviations: 63 levels in six bits, eight per doubling (steps of 9
        # %), from 1 mm on.
        level = 1 + np.rint(8 * np.log2(1e3 * sigma))
    level = np.where(np.isfinite(level), np.clip(level, 1, 63), 0)
    return (known + 4 * level).astype(np.uint8)


def _floor(joints: Array) -> float:
    """Height of the floor, metres: 0 if feet are near 0, otherwise that of the lowest joints."""
    height = joints[..., 2]
    placed = np.isfinite(height)
    if not placed.any():
        return 0.0
    lowest = np.min(np.where(placed, height, np.inf), axis=1)
    ground = float(np.quantile(lowest[np.isfinite(lowest)], 0.2))
    # Maximum height of feet above 0, m, for which the floor is drawn at 0.
    return 0.0 if abs(ground) < 0.3 else ground


def _view(joints: Array, centres: Array) -> dict[str, Any]:
    """The initial view: bounding box of the people, and extent of people and cameras."""
    points = joints.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        points = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.8]])
    # Outliers among the joints do not change the view.
    low, high = np.quantile(points, [0.003, 0.997], axis=0)
    low, high = np.minimum(low, high - 1.0), np.maximum(high, low + 1.0)
    middle = (low + high) / 2
    reach = float(np.linalg.norm(high - low)) / 2
    farthest_m = np.linalg.norm((centres - middle)[:, :2], axis=1).max(initial=0.0)
    box = {"low": low.tolist(), "high": high.tolist(), "middle": middle.tolist()}
    return box | {"reach": max(reach, 1.0), "cameras": float(farthest_m)}


def scene_camera(camera: Camera, axes: Array) -> dict[str, Any]:
    """A camera in the page's axes; the columns of `turn` are its right, down and forward axes."""
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
    """The bodies of N rows, for skinning by the page's script; each is a `person` (N,) of the take
    in a `frame` (N,).

    All share a simplified `mesh`: faces (F, 3), and the bones (M, 4) of each vertex with weights
    out of 255. `rest` (P, M, 3) and `rest_joints` (P, 24, 3) are the people in the T-pose; `turns`
    (N, 24, 4) are quaternions x y z w of bones relative to their parents, and `pelvis` (N, 3) is
    its position. Rows without a body are left out.
    """
    kept, faces, _ = thinned(arrays.template, arrays.faces, CELL_M)
    # Maximum number of bones per vertex; those with the largest weights are kept.
    order = np.argsort(-arrays.weights[kept], axis=1, kind="stable")[:, :4]
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
        rows = np.flatnonzero((person == each) & (place[frame] >= 0))
        turns[rows], pelvis[rows] = (
            motion.rotations[place[frame[rows]]],
            motion.pelvis[place[frame[rows]]],
        )
    millimetres = _Packing(np.zeros(3), 1e-3)
    # Scale of quaternion entries, which are stored as integers.
    return {
        "mesh": {
            "faces": _base64(faces, "<i2"),
            "bones": _base64(order, "<i2"),
            "weights": _base64(weights, "u1"),
            "parents": _base64(np.array(SMPL_PARENTS), "<i2"),
        },
        "rest": _base64(millimetres(rest), "<i2"),
        "rest_joints": _base64(millimetres(joints), "<i2"),
        "turns": _base64(np.rint(32767 * np.nan_to_num(turns)), "<i2"),
        "pelvis": _base64(pack(pelvis), "<i2"),
    }


def _base64(values: NDArray[Any], kind: str) -> str:
    """Base64 text of numbers, which the page's script decodes to a typed array."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind)).tobytes()).decode(
        "ascii"
    )
