"""Recorded motions performed by bodies of any shape on the floor of a room, z up; held hands stay
together.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel, accumulate
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import smpl_joints
from shapepose_fg.simulation.limbs import ARMS, SPINE, turned_about
from shapepose_fg.simulation.mocap import Clip, shoulder_rhythm
from shapepose_fg.simulation.motion import BodyMotion

_FEET = smpl_joints("left_ankle right_ankle left_foot right_foot")
"""Ankles and balls of the feet, left and right."""
_Z_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0]).as_matrix()
_HELD_M, _FREE_M = 0.17, 0.27
"""Distance between hands, m, below which they are held, and above which they are free: differences
in limb lengths leave 10 to 20 cm between hands that touched in the recording."""


@dataclass(frozen=True)
class Performance:
    """Motion of one person in the room, z up, metres."""

    rotations: Array
    """(T, 24, 3, 3) local rotations; for the pelvis, in the world."""
    joints: Array
    """(T, 24, 3) SMPL's joints."""
    rest: Array
    """(24, 3) the shaped body's joints in the T-pose."""

    def __len__(self) -> int:
        """Number of frames, T."""
        return len(self.joints)

    def moved(self, xy: Array, turn_rad: float = 0.0) -> "Performance":
        """The motion rotated about the vertical through the origin, then translated by
        `xy` (2,).
        """
        turn = turned_about("z", np.array([turn_rad]))[0]
        rotations = self.rotations.copy()
        rotations[:, 0] = turn @ rotations[:, 0]
        return replace(
            self, rotations=rotations, joints=self.joints @ turn.T + np.array([*xy, 0.0])
        )


class Figure:
    """A shaped body for motions: joints in the T-pose, and the soles of its feet."""

    def __init__(self, body: BodyModel, betas: Array):
        arrays = body.arrays
        shaped = arrays.template + arrays.shapes @ betas
        self.rest: Array = arrays.joint_regressor @ shaped
        """(24, 3) joints in the T-pose, y up."""
        self.leg_m = float(np.linalg.norm(np.diff(self.rest[[1, 4, 7]], axis=0), axis=1).sum())
        """Length of thigh and shank together, metres."""
        feet = [
            np.flatnonzero(arrays.weights[:, list(_FEET[side::2])].sum(axis=1) > 0.9)
            for side in (0, 1)
        ]
        # The lowest point of a foot is always a vertex of its convex hull.
        hull = np.concatenate([foot[ConvexHull(shaped[foot]).vertices] for foot in feet])
        self._soles, self._weights = shaped[hull], arrays.weights[hull][:, list(_FEET)]
        self._weights = self._weights / self._weights.sum(axis=1, keepdims=True)

    def joints(self, rotations: Array, pelvis: Array) -> tuple[Array, Array]:
        """Joints (T, 24, 3) and their world rotations (T, 24, 3, 3), with the pelvis at `pelvis`
        (T, 3).
        """
        world, places = accumulate(rotations), np.empty((len(pelvis), 24, 3))
        places[:, 0] = pelvis
        for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
            places[:, joint] = places[:, parent] + world[:, parent] @ (
                self.rest[joint] - self.rest[parent]
            )
        return places, world

    def lowest_sole(self, joints: Array, world: Array) -> Array:
        """Height (T,) of the lowest point of both feet, z up."""
        up = world[:, list(_FEET), 2]  # (T, 4, 3): vertical component of each rotation
        offsets = self._soles[:, None] - self.rest[list(_FEET)]
        heights = np.einsum("tfi,vfi,vf->tv", up, offsets, self._weights, optimize=True)
        return (heights + joints[:, list(_FEET), 2] @ self._weights.T).min(axis=1)


def perform(
    body: BodyModel, betas: Array, clip: Clip, *, scale: float | None = None
) -> Performance:
    """Perform `clip` with a body of shape `betas` (10,), on the floor z = 0 of a room with z up; +z
    becomes -y.

    Steps scale with the leg length (or by `scale`, for people who must stay together); collars
    follow the arms, hands hang loosely, and the soles are on the floor, except in jumps.
    """
    figure = Figure(body, np.asarray(betas, dtype=np.float64))
    ratio = figure.leg_m / clip.leg_m
    rotations = shoulder_rhythm(clip.rotations)
    if not clip.wrist_valid:
        rotations[:, 20:22] = np.eye(3)
    for hand, sign in zip(smpl_joints("left_hand right_hand"), (-1.0, 1.0), strict=True):
        # Bend of the fingers of a hand that was not recorded, rad.
        rotations[:, hand] = Rotation.from_rotvec([0.0, 0.0, sign * 0.25]).as_matrix()
    rotations[:, 0] = _Z_UP @ rotations[:, 0]
    pelvis = clip.pelvis * (ratio if scale is None else scale)
    pelvis[:, 1] = (clip.pelvis[:, 1] - clip.floor_y) * ratio
    return grounded(figure, rotations, pelvis @ _Z_UP.T, clip.fps, bend_toes=not clip.toe_valid)


def grounded(
    figure: Figure, rotations: Array, pelvis: Array, fps: float, *, bend_toes: bool
) -> Performance:
    """Shift a person vertically and smoothly, so that the supporting feet are on the floor."""
    joints, world = figure.joints(rotations, pelvis)
    if bend_toes:
        rotations = _toes_on_the_floor(rotations, joints, world, figure.lowest_sole(joints, world))
        joints, world = figure.joints(rotations, pelvis)
    joints = joints.copy()
    joints[..., 2] -= _floor(figure.lowest_sole(joints, world), fps)[:, None]
    return Performance(rotations, joints, figure.rest)


def together(betas: Array, performances: list[Performance], frames: int) -> BodyMotion:
    """SMPL's parameters of P people, `betas` (P, 10), in `frames` frames (used if P is 0)."""
    motion = BodyMotion.still(
        np.asarray(betas, dtype=np.float64).reshape(len(performances), 10), frames
    )
    for person, performed in enumerate(performances):
        vectors = (
            Rotation.from_matrix(performed.rotations.reshape(-1, 3, 3))
            .as_rotvec()
            .reshape(-1, 24, 3)
        )
        motion.global_orient[:, person] = vectors[:, 0]
        motion.body_pose[:, person] = vectors[:, 1:]
        # SMPL rotates the body about its pelvis in the T-pose, then translates it.
        motion.transl[:, person] = performed.joints[:, 0] - performed.rest[0]
    return motion


def _floor(lowest: Array, fps: float) -> Array:
    """Smooth height (T,) of the floor under a person with lowest points at `lowest` (T,), ignoring
    jumps.
    """
    if len(lowest) == 0:
        return lowest
    reach = 2 * max(1, round(0.3 * fps)) + 1
    opened = maximum_filter1d(
        minimum_filter1d(lowest, reach, mode="nearest"), reach, mode="nearest"
    )
    # Height, m, above the floor around a person above which it is a jump; less is recording
    # error.
    flies = (lowest - opened).max() > 0.12
    floor = gaussian_filter1d(opened if flies else lowest, 0.1 * fps, mode="nearest")
    below = np.maximum(floor - lowest - 0.015, 0.0)  # lift people deep in the floor
    wide = maximum_filter1d(below, 2 * max(1, round(0.15 * fps)) + 1, mode="nearest")
    return floor - gaussian_filter1d(wide, 0.08 * fps, mode="nearest")


def _toes_on_the_floor(rotations: Array, joints: Array, world: Array, lowest: Array) -> Array:
    """Keep unrecorded toes flat where the heel rises and the ball of the foot is on the floor."""
    bent = rotations.copy()
    for ankle, ball in ((7, 10), (8, 11)):
        pitch = np.arcsin(
            np.clip(-world[:, ankle, 2, 2], -1.0, 1.0)
        )  # pitch of the foot's +z below the horizontal
        near = np.clip((0.14 - (joints[:, ball, 2] - lowest)) / 0.06, 0.0, 1.0)
        angle = -np.clip(pitch, 0.0, 0.7) * near
        bent[:, ball] = turned_about("x", angle)
    return bent


def hold_hands(
    lead: Performance, follow: Performance, fps: float
) -> tuple[Performance, Performance]:
    """Bring hands of two people together that are close for a while, each moving half of the
    distance.

    Only shoulders and elbows rotate: the elbow by the law of cosines, the shoulder along the
    shortest arc. Each hand goes to the other person's nearest one.
    """
    if len(lead) == 0:
        return lead, follow
    pull = _pull(lead, follow, fps)
    for _ in range(2):  # the second pass corrects the rotated hand
        hands = [person.joints[:, [22, 23]] for person in (lead, follow)]
        between = hands[1][:, None] - hands[0][:, :, None]  # (T, 2, 2, 3) lead's hands to follow's
        gap = np.linalg.norm(between, axis=-1)
        # Distance between the knuckles of two held hands, m.
        step = (pull * np.maximum(1.0 - 0.07 / np.maximum(gap, 1e-6), 0.0) / 2)[..., None] * between
        lead = _reach(lead, step.sum(axis=2))
        follow = _reach(follow, -step.sum(axis=1))
    return lead, follow


def _pull(lead: Performance, follow: Performance, fps: float) -> Array:
    """(T, 2, 2) weights with which the hands of lead and follow hold each other, 0 to 1, smooth in
    time.
    """
    gap = np.linalg.norm(lead.joints[:, [22, 23], None] - follow.joints[:, None, [22, 23]], axis=-1)
    near = np.clip((_FREE_M - gap) / (_FREE_M - _HELD_M), 0.0, 1.0)
    nearest = np.exp(-gap / 0.02)
    # A hand near both hands of the other person holds the nearer one.
    share = nearest / np.maximum(
        np.maximum(nearest.sum(axis=1, keepdims=True), nearest.sum(axis=2, keepdims=True)), 1e-300
    )
    return gaussian_filter1d(near * share, 0.12 * fps, axis=0, mode="nearest")


def _reach(person: Performance, steps: Array) -> Performance:
    """Move the hands by `steps` (T, 2, 3) metres, left and right, as far as the arms reach."""
    rotations, joints = person.rotations.copy(), person.joints.copy()
    world = rotations[:, 0]
    for joint in SPINE:
        world = world @ rotations[:, joint]
    hands = smpl_joints("left_hand right_hand")
    for side, (collar, shoulder, elbow, wrist) in enumerate(ARMS):
        girdle = world @ rotations[:, collar]
        upper = girdle @ rotations[:, shoulder]
        fore = upper @ rotations[:, elbow]
        root, middle, end = (joints[:, joint] for joint in (shoulder, elbow, wrist))
        target = end + steps[:, side]
        bend = _bend(middle - root, end - middle, np.linalg.norm(target - root, axis=1))
        swing = _shortest(
            middle - root + np.einsum("tij,tj->ti", bend, end - middle), target - root
        )
        upper, fore = swing @ upper, swing @ bend @ fore
        rotations[:, shoulder] = np.swapaxes(girdle, -1, -2) @ upper
        rotations[:, elbow] = np.swapaxes(upper, -1, -2) @ fore
        bones = (
            (shoulder, elbow, upper),
            (elbow, wrist, fore),
            (wrist, hands[side], fore @ rotations[:, wrist]),
        )
        for parent, joint, turned in bones:
            joints[:, joint] = joints[:, parent] + turned @ (
                person.rest[joint] - person.rest[parent]
            )
    return replace(person, rotations=rotations, joints=joints)


def _bend(upper: Array, lower: Array, distance: Array) -> Array:
    """Rotation (T, 3, 3) of the forearm `lower` (T, 3) that gives the arm the length `distance`
    (T,).
    """
    a, b = np.linalg.norm(upper, axis=1), np.linalg.norm(lower, axis=1)
    axis = np.cross(upper, lower)
    size = np.linalg.norm(axis, axis=1)
    now = np.arctan2(size, (upper * lower).sum(axis=1))
    # Maximum extension of an arm, as a share of its length.
    length = np.clip(distance, np.abs(a - b) + 0.12, 0.995 * (a + b))
    then = np.arccos(np.clip((length**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))
    # The bending axis of a straight arm is undefined: such an arm is not bent.
    weight = np.clip(size / (a * b) / 0.05, 0.0, 1.0)
    change = (weight * (then - now) / np.maximum(size, 1e-9))[:, None] * axis
    return Rotation.from_rotvec(change).as_matrix()


def _shortest(before: Array, after: Array) -> Array:
    """Rotation (T, 3, 3) along the shortest arc from direction `before` to `after`, (T, 3) each."""
    axis = np.cross(before, after)
    size = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(size, (before * after).sum(axis=1))
    return Rotation.from_rotvec((angle / np.maximum(size, 1e-12))[:, None] * axis).as_matrix()
