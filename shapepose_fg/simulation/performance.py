"""Recorded motions performed by bodies of any shape, on the floor of a room with z up."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.simulation.mocap import Clip
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.shoulder import shoulder_rhythm

Array = NDArray[np.float64]

_FEET = (7, 8, 10, 11)
"""Ankles and balls of the feet, left and right."""
_RELAXED_HAND = 0.25
"""Radians by which the fingers of a hand that was not recorded are bent."""
_JUMP_M = 0.12
"""Who rises this far above the floor around it has jumped; less is how recordings err."""
_Z_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0]).as_matrix()


@dataclass(frozen=True)
class Performance:
    """One person's motion in the room, z up, metres."""

    rotations: Array
    """(T, 24, 3, 3) local rotations; the first is the pelvis' in the world."""
    joints: Array
    """(T, 24, 3) SMPL's joints."""
    rest: Array
    """(24, 3) the shaped body's joints in the T-pose."""

    def __len__(self) -> int:
        """Count of frames, T."""
        return len(self.joints)

    def moved(self, xy: Array, turn_rad: float = 0.0) -> "Performance":
        """Turned about the vertical through the origin, then shifted by `xy` (2,)."""
        turn = about_z(np.array([turn_rad]))[0]
        rotations = self.rotations.copy()
        rotations[:, 0] = turn @ rotations[:, 0]
        return replace(self, rotations=rotations, joints=self.joints @ turn.T + np.array([*xy, 0.0]))


class Figure:
    """A shaped body as motions need it: joints of its T-pose and the soles of its feet."""

    def __init__(self, body: BodyModel, betas: Array):
        arrays = body.arrays
        shaped = arrays.template + arrays.shapes @ betas
        self.rest: Array = arrays.joint_regressor @ shaped
        """(24, 3) joints in the T-pose, y up."""
        self.parents = body.parents
        """(24,) parent of each joint."""
        self.leg_m = float(np.linalg.norm(np.diff(self.rest[[1, 4, 7]], axis=0), axis=1).sum())
        """Length of thigh and shank together."""
        feet = [np.flatnonzero(arrays.weights[:, list(_FEET[side::2])].sum(axis=1) > 0.9) for side in (0, 1)]
        # Whatever the foot's turn, its lowest point is a corner of its convex hull.
        hull = np.concatenate([foot[ConvexHull(shaped[foot]).vertices] for foot in feet])
        self._soles, self._weights = shaped[hull], arrays.weights[hull][:, list(_FEET)]
        self._weights = self._weights / self._weights.sum(axis=1, keepdims=True)

    def joints(self, rotations: Array, pelvis: Array) -> tuple[Array, Array]:
        """Joints (T, 24, 3) and their world rotations (T, 24, 3, 3) with the pelvis joint at `pelvis` (T, 3)."""
        world, places = rotations.copy(), np.empty((len(pelvis), 24, 3))
        places[:, 0] = pelvis
        for joint in range(1, 24):
            parent = self.parents[joint]
            world[:, joint] = world[:, parent] @ rotations[:, joint]
            places[:, joint] = places[:, parent] + world[:, parent] @ (self.rest[joint] - self.rest[parent])
        return places, world

    def lowest_sole(self, joints: Array, world: Array) -> Array:
        """Height (T,) of the lowest point of both feet, z up."""
        up = world[:, list(_FEET), 2]  # (T, 4, 3): the height's share of each rotation
        offsets = self._soles[:, None] - self.rest[list(_FEET)]
        heights = np.einsum("tfi,vfi,vf->tv", up, offsets, self._weights, optimize=True)
        return (heights + joints[:, list(_FEET), 2] @ self._weights.T).min(axis=1)


def perform(body: BodyModel, betas: Array, clip: Clip, *, scale: float | None = None) -> Performance:
    """`clip` as a body of shape `betas` (10,) does it: on the floor z = 0 of a room with z up; +z becomes -y.

    Steps are longer in the measure of the legs (`scale` overrides it, for who must stay together); collars
    follow the arms, hands hang loosely, and the soles are on the floor, but for what is jumped.
    """
    figure = Figure(body, np.asarray(betas, dtype=np.float64))
    ratio = figure.leg_m / clip.leg_m
    rotations = shoulder_rhythm(clip.rotations)
    if not clip.wrist_valid:
        rotations[:, 20:22] = np.eye(3)
    for hand, sign in ((22, -1.0), (23, 1.0)):
        rotations[:, hand] = Rotation.from_rotvec([0.0, 0.0, sign * _RELAXED_HAND]).as_matrix()
    rotations[:, 0] = _Z_UP @ rotations[:, 0]
    pelvis = clip.pelvis * (ratio if scale is None else scale)
    pelvis[:, 1] = (clip.pelvis[:, 1] - clip.floor_y) * ratio
    return grounded(figure, rotations, pelvis @ _Z_UP.T, clip.fps, bend_toes=not clip.toe_valid)


def grounded(figure: Figure, rotations: Array, pelvis: Array, fps: float, *, bend_toes: bool) -> Performance:
    """Shift a person up and down, smoothly, so that the feet that carry are on the floor."""
    joints, world = figure.joints(rotations, pelvis)
    if bend_toes:
        rotations = _toes_on_the_floor(rotations, joints, world, figure.lowest_sole(joints, world))
        joints, world = figure.joints(rotations, pelvis)
    joints = joints.copy()
    joints[..., 2] -= _floor(figure.lowest_sole(joints, world), fps)[:, None]
    return Performance(rotations, joints, figure.rest)


def together(betas: Array, performances: list[Performance], frames: int) -> Motion:
    """SMPL's parameters of P people, `betas` (P, 10), in `frames` frames (needed where P is 0)."""
    motion = Motion.still(np.asarray(betas, dtype=np.float64).reshape(len(performances), 10), frames)
    for person, performed in enumerate(performances):
        vectors = Rotation.from_matrix(performed.rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 24, 3)
        motion.global_orient[:, person] = vectors[:, 0]
        motion.body_pose[:, person] = vectors[:, 1:]
        # SMPL turns the body about its pelvis where the T-pose has it, and shifts it afterwards.
        motion.transl[:, person] = performed.joints[:, 0] - performed.rest[0]
    return motion


def about_z(angle: Array) -> Array:
    """Rotations (T, 3, 3) by `angle` (T,) about the vertical."""
    return Rotation.from_rotvec(np.array([0.0, 0.0, 1.0]) * angle[:, None]).as_matrix()


def _floor(lowest: Array, fps: float) -> Array:
    """Height (T,) of the floor under somebody whose lowest point is at `lowest` (T,): smooth, blind for jumps."""
    if len(lowest) == 0:
        return lowest
    reach = 2 * max(1, round(0.3 * fps)) + 1
    opened = maximum_filter1d(minimum_filter1d(lowest, reach, mode="nearest"), reach, mode="nearest")
    flies = (lowest - opened).max() > _JUMP_M
    floor = gaussian_filter1d(opened if flies else lowest, 0.1 * fps, mode="nearest")
    below = np.maximum(floor - lowest - 0.015, 0.0)  # what would be deep in the floor lifts the person
    wide = maximum_filter1d(below, 2 * max(1, round(0.15 * fps)) + 1, mode="nearest")
    return floor - gaussian_filter1d(wide, 0.08 * fps, mode="nearest")


def _toes_on_the_floor(rotations: Array, joints: Array, world: Array, lowest: Array) -> Array:
    """Toes that were not recorded stay flat where the heel rises and the ball of the foot is on the floor."""
    bent = rotations.copy()
    for ankle, ball in ((7, 10), (8, 11)):
        pitch = np.arcsin(np.clip(-world[:, ankle, 2, 2], -1.0, 1.0))  # of the foot's +z, below the horizontal
        near = np.clip((0.14 - (joints[:, ball, 2] - lowest)) / 0.06, 0.0, 1.0)
        angle = -np.clip(pitch, 0.0, 0.7) * near
        bent[:, ball] = Rotation.from_rotvec(np.array([1.0, 0.0, 0.0]) * angle[:, None]).as_matrix()
    return bent
