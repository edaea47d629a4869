"""Inverse kinematics of puppets: SMPL's joint rotations from pelvis, hands and feet.

Legs and arms of a `Puppet` are two-bone chains, solved in closed form. All is batched over frames,
for one person at a time.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import smpl_joints

PELVIS, NECK, HEAD = smpl_joints("pelvis neck head")
SPINE = smpl_joints("spine1 spine2 spine3")
SIDES = ("left", "right")
LEGS = tuple(smpl_joints(f"{side}_hip {side}_knee {side}_ankle") for side in SIDES)
"""Hip, knee, ankle: left, right."""
ARMS = tuple(
    smpl_joints(f"{side}_collar {side}_shoulder {side}_elbow {side}_wrist") for side in SIDES
)
"""Collar, shoulder, elbow, wrist: left, right."""


@dataclass(frozen=True)
class Puppet:
    """Pelvis, feet, hands and gaze of one person in T frames; world z up, metres and radians."""

    pelvis: Array
    """(T, 3) pelvis joint."""
    heading: Array
    """(T,) heading of the pelvis, from the x axis towards the y axis."""
    lean: Array
    """(T, 3) angles of the trunk, summed over its three joints: forward, twist to the left, to the
    right, rad."""
    ankles: Array
    """(T, 2, 3) ankle joints, left and right."""
    foot_heading: Array
    """(T, 2) headings of the feet."""
    foot_pitch: Array
    """(T, 2) pitch of the feet, rad; positive with the heel above the toes."""
    wrists: Array
    """(T, 2, 3) wrist joints, left and right, used where `reach` is 1."""
    reach: Array
    """(T, 2) 1 where the wrist follows `wrists`, 0 where the arm swings freely."""
    swing: Array
    """(T, 2) distance of a free hand in front of its resting place, metres."""
    gaze: Array
    """(T, 3) point that the head faces."""


def pose(puppet: Puppet, rest: Array) -> tuple[Array, Array, Array]:
    """SMPL's global_orient (T, 3), body_pose (T, 23, 3) and transl (T, 3) of a puppet.

    `rest` (24, 3) are the joints of the shaped body in the T-pose, y up and facing +z.
    """
    count = len(puppet.heading)
    turned = np.tile(np.eye(3), (count, 24, 1, 1))  # world from joint
    turned[:, PELVIS] = _facing(puppet.heading)
    position = np.zeros((count, 24, 3))
    position[:, PELVIS] = puppet.pelvis
    bones = rest - rest[np.maximum(SMPL_PARENTS, 0)]

    def grow(joint: int, local: Array | None = None) -> None:
        """Place a joint after its parent; without `local` it keeps the parent's rotation."""
        parent = SMPL_PARENTS[joint]
        position[:, joint] = position[:, parent] + turned[:, parent] @ bones[joint]
        turned[:, joint] = turned[:, parent] if local is None else turned[:, parent] @ local

    bend = Rotation.from_euler("YXZ", puppet.lean[:, [1, 0, 2]] / len(SPINE)).as_matrix()
    for joint in SPINE:
        grow(joint, bend)
    for joint in (NECK, HEAD):
        grow(joint)
    _turn_head(turned, position, puppet.gaze)
    for side, (hip, knee, ankle) in enumerate(LEGS):
        grow(hip)
        pole = turned[:, PELVIS] @ np.array([0.12 * (1, -1)[side], 0.0, 1.0])
        _two_bones(
            turned,
            position,
            bones,
            (hip, knee, ankle),
            puppet.ankles[:, side],
            pole,
            np.eye(3)[0],
        )
        turned[:, ankle] = _facing(puppet.foot_heading[:, side]) @ turned_about(
            "x", puppet.foot_pitch[:, side]
        )
        turned[:, ankle + 3] = turned[:, ankle]
    for side, (collar, shoulder, elbow, wrist) in enumerate(ARMS):
        sign = (1.0, -1.0)[side]
        grow(collar)
        grow(shoulder)
        target = _hand_target(puppet, turned, position, bones, side)
        above = target[:, 2] - position[:, shoulder, 2]
        grow(collar, turned_about("z", sign * 0.35 * np.clip(above / 0.4, 0.0, 1.0)))
        grow(shoulder)
        # Elbows point backwards under hanging arms and outwards under raised ones: never along the
        # arm.
        raised = np.clip((above + 0.35) / 0.5, 0.0, 1.0)[:, None]
        pole = (1 - raised) * (0.4 * sign, -0.5, -1.0) + raised * (sign, -0.6, -0.3)
        pole = np.einsum("tij,tj->ti", turned[:, SPINE[2]], pole)
        chain = (shoulder, elbow, wrist)
        _two_bones(
            turned,
            position,
            bones,
            chain,
            target,
            pole,
            np.array([0.0, (-1.0, 1.0)[side], 0.0]),
        )
        turned[:, wrist] = turned[:, wrist + 2] = turned[:, elbow]
    local = np.swapaxes(turned[:, SMPL_PARENTS[1:]], -1, -2) @ turned[:, 1:]
    axis_angle = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(count, 23, 3)
    orient = Rotation.from_matrix(turned[:, PELVIS]).as_rotvec()
    return orient, axis_angle, puppet.pelvis - rest[PELVIS]


def _facing(heading: Array) -> Array:
    """World from body (T, 3, 3) for an upright body (y up, facing +z) in a world with z up."""
    return turned_about("z", heading + np.pi / 2) @ turned_about("x", np.full(1, np.pi / 2))


def turned_about(axis: str, angle: Array) -> Array:
    """Rotations (T, 3, 3) by `angle` (T,) about a coordinate axis."""
    return Rotation.from_rotvec(np.eye(3)["xyz".index(axis)] * angle[:, None]).as_matrix()


def _turn_head(turned: Array, position: Array, gaze: Array) -> None:
    """Rotate neck and head, half each, towards `gaze` (T, 3), within the range of a neck."""
    chest = turned[:, SPINE[2]]
    sight = np.einsum("tji,tj->ti", chest, gaze - position[:, HEAD])
    yaw = np.clip(np.arctan2(sight[:, 0], sight[:, 2]), -1.0, 1.0)
    pitch = np.clip(-np.arctan2(sight[:, 1], np.hypot(sight[:, 0], sight[:, 2])), -0.5, 0.6)
    half = Rotation.from_euler("YX", np.stack([yaw, pitch], axis=1) / 2).as_matrix()
    turned[:, NECK] = chest @ half
    turned[:, HEAD] = chest @ half @ half


def _hand_target(puppet: Puppet, turned: Array, position: Array, bones: Array, side: int) -> Array:
    """Target of a wrist (T, 3): a blend of its own target and the position of a hanging, swinging
    arm.
    """
    shoulder, elbow, wrist = ARMS[side][1:]
    length = np.linalg.norm(bones[elbow]) + np.linalg.norm(bones[wrist])
    sign = (1.0, -1.0)[side]
    swing = puppet.swing[:, side]
    out, front = np.full_like(swing, 0.16 * sign), 0.04 + swing
    down = -np.sqrt(np.maximum((0.965 * length) ** 2 - out**2 - front**2, (0.5 * length) ** 2))
    upright = _facing(puppet.heading)  # arms hang vertically
    twist = _facing(puppet.heading + puppet.lean[:, 1] * 0.5)
    hanging = np.einsum("tij,tj->ti", twist, np.stack([out, np.zeros_like(out), front], axis=1))
    hanging += upright[:, :, 1] * down[:, None] + position[:, shoulder]
    weight = puppet.reach[:, side, None]
    return (1.0 - weight) * hanging + weight * puppet.wrists[:, side]


def _two_bones(
    turned: Array,
    position: Array,
    bones: Array,
    chain: tuple[int, int, int],
    target: Array,
    pole: Array,
    hinge: Array,
) -> None:
    """Rotate the first two joints of `chain` so that the third reaches `target` (T, 3), as far as
    possible.

    The middle joint bends towards `pole` (T, 3), about `hinge` (3,), an axis in the T-pose about
    which a positive angle bends the limb.
    """
    first, middle, last = chain
    upper, lower = np.linalg.norm(bones[middle]), np.linalg.norm(bones[last])
    line = target - position[:, first]
    reach = np.linalg.norm(line, axis=1, keepdims=True)
    u = line / reach
    # Maximum extension of a limb, as a share of its length; keeps the direction of its bend
    # defined.
    distance = np.clip(reach, abs(upper - lower) + 0.1, (upper + lower) * 0.995)
    v = pole - (pole * u).sum(axis=1, keepdims=True) * u
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    along = (upper**2 - lower**2 + distance**2) / (2 * distance)  # law of cosines
    aside = np.sqrt(np.maximum(upper**2 - along**2, 0.0))
    position[:, middle] = position[:, first] + along * u + aside * v
    position[:, last] = position[:, first] + distance * u
    axis = np.cross(v, u)
    for joint, end in ((first, middle), (middle, last)):
        bone = position[:, end] - position[:, joint]
        turned[:, joint] = _frame(bone, axis) @ _frame(bones[end][None], hinge[None]).swapaxes(
            -1, -2
        )


def _frame(bone: Array, axis: Array) -> Array:
    """Right-handed frames (T, 3, 3) with the first column along `bone` and the second towards
    `axis`.
    """
    e = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    n = axis - (axis * e).sum(axis=1, keepdims=True) * e
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.stack([e, n, np.cross(e, n)], axis=-1)
