"""People by REP 155 (ROS4HRI): joint states, link frames and a URDF of each person, and the 2D
skeleton in one camera.

Joints and links have the names and axes of the package human_description. In its zero pose a person
stands upright with hanging arms, and all frames have x to the front, y to the left and z up. The
trunk bends only forwards and backwards, elbows and knees are hinges.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import smpl_joints

_FRONT_LEFT_UP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""Rotation to SMPL's axes (x left, y up, z front) from axes to the front, to the left and up."""
_HINGE = (0, -1, 0)
"""Axis of elbows and knees."""
_HEAD_NAMES, _HEAD_AXES = ("r_head", "y_head", "p_head"), ((1, 0, 0), (0, 0, 1), _HINGE)
"""Names and axes of the three joints of the head."""
_STRAIGHT = 0.1
"""Sine of the bend of an elbow or knee at which the positions of joints and the fitted body
determine the axis of the hinge with equal weight. In an almost straight limb, noise would turn it.
"""
_SKELETON_2D = (
    "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist RHip RKnee RAnkle LHip LKnee LAnkle "
    "LEye REye LEar REar"
).split()
"""Points of hri_msgs/Skeleton2D in their order."""


_Axes = tuple[tuple[float, float, float], ...]


class _Limb(NamedTuple):
    """An arm or a leg of the kinematic model."""

    links: tuple[str, ...]
    """Upper and lower link, and the end."""
    joints: tuple[str, ...]
    """Joints of the result at the origins of the links."""
    smpl: tuple[int, ...]
    """SMPL's joints from above the pelvis to the upper link."""
    side: float
    """1 on the left, -1 on the right: direction of this side along the body's y axis, which points
    left."""

    @property
    def is_arm(self) -> bool:
        """Whether this limb is an arm, not a leg."""
        return self.links[0].endswith("shoulder")

    @property
    def axes(self) -> _Axes:
        """Axes of the three joints between trunk and upper link."""
        if self.is_arm:
            return (0, 0, -self.side), (self.side, 0, 0), (0, 0, self.side)
        return (0, 0, -1), (self.side, 0, 0), _HINGE

    @property
    def names(self) -> tuple[str, str, str]:
        """Names of the three joints between trunk and upper link."""
        side, _, name = self.links[0].partition("_")
        return f"{side}_y_{name}", f"{side}_p_{name}", f"{side}_r_{name}"


_ARM, _LEG = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")
_LIMBS = tuple(
    _Limb(
        tuple(f"{side.lower()}_{name}" for name in names),
        tuple(f"{side}{name.title()}" for name in names),
        smpl,
        1.0 if side == "L" else -1.0,
    )
    for side, names, smpl in (
        ("L", _ARM, (3, 6, 9, 13, 16)),
        ("R", _ARM, (3, 6, 9, 14, 17)),
        ("L", _LEG, (1,)),
        ("R", _LEG, (2,)),
    )
)


@dataclass(frozen=True)
class Human:
    """One person in one frame, in the kinematic model of REP 155."""

    row: int
    """Row of the result."""
    body_id: str
    """Identifier in the names of topics, frames and joints: p and the identity, because ROS 2 does
    not allow parts of topics that begin with a digit."""
    world_from_body: Array
    """(4, 4) pose of the frame at the middle of the hips, x to the front and z to the head."""
    links: dict[str, Array]
    """(4, 4) poses of the known links in the body's frame, by names without identifier."""
    angles: dict[str, float]
    """Angles of the known joints, radians, by names without identifier."""

    def urdf(self) -> str | None:
        """The kinematic model with the lengths of this frame; None while a limb is unknown."""
        at = {name: link[:3, 3] for name, link in self.links.items()}
        if not {"torso", *(name for limb in _LIMBS for name in limb.links)} <= at.keys():
            return None

        def length(first: str, second: str) -> float:
            return float(np.linalg.norm(at[first] - at[second]))

        robot = Element("robot", name=f"human_{self.body_id}")
        visuals = {"body": SubElement(robot, "link", name=f"body_{self.body_id}")}

        def add(
            name: str, parent: str, child: str, axis=None, y: float = 0.0, z: float = 0.0
        ) -> None:
            """Add a joint, at (0, y, z) in the frame of the parent link, and its child link. If z
            is not 0, the parent is drawn as a cylinder that ends at the joint.
            """
            kind = "fixed" if axis is None else "revolute"
            joint = SubElement(robot, "joint", name=f"{name}_{self.body_id}", type=kind)
            SubElement(joint, "origin", xyz=f"0 {y:.4f} {z:.4f}")
            SubElement(joint, "parent", link=f"{parent}_{self.body_id}")
            SubElement(joint, "child", link=f"{child}_{self.body_id}")
            visuals[child] = SubElement(robot, "link", name=f"{child}_{self.body_id}")
            if axis is not None:
                SubElement(joint, "axis", xyz=" ".join(map(str, axis)))
                span = {"lower": f"{-math.pi:.4f}", "upper": f"{math.pi:.4f}"}
                SubElement(joint, "limit", span, effort="0", velocity="0")
            if z != 0:
                visual = SubElement(visuals[parent], "visual")
                SubElement(visual, "origin", xyz=f"0 0 {z / 2:.4f}")
                shape = SubElement(visual, "geometry")
                # Radius of the limbs that the URDF draws, m.
                SubElement(shape, "cylinder", radius="0.03", length=f"{abs(z):.4f}")

        add("waist", "body", "waist", (0, 1, 0))
        add("torso", "waist", "torso", z=length("torso", "waist"))
        for parent, name, axis in zip(
            ("torso", *_HEAD_NAMES), _HEAD_NAMES, _HEAD_AXES, strict=False
        ):
            add(name, parent, name, axis)
        neck = length("head", "torso") if "head" in at else length("torso", "waist") / 3
        add("head", _HEAD_NAMES[-1], "head", z=neck)
        for limb in _LIMBS:
            upper, middle, end = limb.links
            other = f"{'r' if limb.side > 0 else 'l'}{upper[1:]}"
            chain = ("torso" if limb.is_arm else "body", *limb.names[:2], upper)
            for n, (name, axis) in enumerate(zip(limb.names, limb.axes, strict=True)):
                y = limb.side * length(upper, other) / 2 if n == 0 else 0.0
                add(name, chain[n], chain[n + 1], axis, y)
            add(middle, upper, middle, _HINGE, z=-length(upper, middle))
            add(end, middle, end, z=-length(middle, end))
        return tostring(robot, encoding="unicode")


def humans(rows: Reconstruction) -> Iterator[Human]:
    """Yield the people of one frame who have known hips and a body.

    Origins of links are joints of the result. Angles turn the limbs of the model towards the next
    joint; an almost straight elbow or knee may differ from it by a few degrees.
    """
    names = rows.joint_names.tolist()
    xyz = np.concatenate([rows.joints, np.full((len(rows), 1, 3), np.nan)], axis=1)

    def place(*wanted: str) -> Array:
        """(N, 3) middle of joints; NaN if one is unknown."""
        return xyz[:, [names.index(each) if each in names else -1 for each in wanted]].mean(axis=1)

    hips = place(*_present(names, "MidHip", "RHip", "LHip"))
    turns = np.concatenate([rows.global_orient[:, None], rows.body_pose], axis=1)
    known = np.isfinite(np.concatenate([hips[:, None], turns], axis=1)).all(axis=(1, 2))
    smpl = exp_so3(np.where(np.isfinite(turns), turns, 0.0))
    world_from_body = rigid(smpl[:, 0] @ _FRONT_LEFT_UP, hips)
    xyz = (xyz - hips[:, None]) @ world_from_body[:, :3, :3]

    def by_body(chain: tuple[int, ...]) -> Array:
        """(N, 3, 3) rotations of a bone in the body's frame; the identity in SMPL's rest pose."""
        return _FRONT_LEFT_UP.T @ reduce(np.matmul, (smpl[:, n] for n in chain)) @ _FRONT_LEFT_UP

    neck = place(*_present(names, "Neck", "LShoulder", "RShoulder"))
    pitch = np.nan_to_num(np.arctan2(neck[:, 0], neck[:, 2]))
    torso, head = (
        exp_so3(pitch[:, None] * [0.0, 1.0, 0.0]),
        by_body(smpl_joints("spine1 spine2 spine3 neck head")),
    )
    links = {
        "waist": rigid(torso, np.zeros((len(rows), 3))),
        "torso": rigid(torso, neck),
        "head": rigid(head, place("LEar", "REar")),
    }
    angles = {"waist": pitch} | _head_angles(torso.mT @ head)
    for limb in _LIMBS:
        start, middle, end = (place(name) for name in limb.joints)
        # SMPL's arms point to the sides at rest, those of this model hang.
        hang = exp_so3(np.array([limb.side * math.pi / 2 if limb.is_arm else 0.0, 0.0, 0.0]))
        own = by_body(limb.smpl) @ hang
        upper, bend = _hinged(middle - start, end - middle, own, limb.is_arm)
        lower = upper @ exp_so3(np.nan_to_num(bend)[:, None] * _HINGE)
        for name, turn, point in zip(
            limb.links, (upper, lower, lower), (start, middle, end), strict=True
        ):
            links[name] = rigid(turn, point)
        turned = torso.mT @ upper if limb.is_arm else upper
        mirrored = turned * np.outer((1, limb.side, 1), (1, limb.side, 1))
        three = _shoulder_angles(mirrored) if limb.is_arm else _hip_angles(mirrored, limb.side)
        angles |= zip(limb.names, three, strict=True)
        angles[limb.links[1]] = bend
    for n in np.flatnonzero(known).tolist():
        yield Human(
            n,
            f"p{int(rows.person[n])}",
            world_from_body[n],
            {name: link[n] for name, link in links.items() if np.isfinite(link[n]).all()},
            {name: float(each[n]) for name, each in angles.items() if math.isfinite(each[n])},
        )


def skeleton_2d(rows: Reconstruction, row: int, camera: Camera) -> list[tuple[float, float, float]]:
    """The 18 points of hri_msgs/Skeleton2D of one row: x and y in the picture of `camera`, 0 to 1,
    and confidence; all 0 for unknown joints and those outside the picture.
    """
    names = rows.joint_names.tolist()
    at = [names.index(name) if name in names else -1 for name in _SKELETON_2D]
    xy, depth = camera.project(rows.joints[row, at])
    share = camera.distort(xy) / camera.image_size
    score = np.clip(np.nan_to_num(rows.confidence[row, at]), 0.0, 1.0)
    inside = (depth > 0) & ((share >= 0) & (share <= 1)).all(axis=1) & (np.array(at) >= 0)
    points = np.where(inside[:, None], np.column_stack([share, score]), 0.0)
    return [(x, y, c) for x, y, c in points.tolist()]


def _present(names: list[str], whole: str, *parts: str) -> tuple[str, ...]:
    """The joint `whole` if the result has it, otherwise those whose middle it is."""
    return (whole,) if whole in names else parts


def _hinged(upper: Array, lower: Array, by_body: Array, is_arm: bool) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) of upper arms or thighs along -z, and the angles (N,) of their hinges,
    from the vectors (N, 3) to the next joint and from there to the end; NaN if unknown.

    `by_body` (N, 3, 3) are the rotations according to the fitted body.
    """
    z = -upper / np.linalg.norm(upper, axis=-1, keepdims=True)
    along = lower / np.linalg.norm(lower, axis=-1, keepdims=True)
    across = np.nan_to_num(along - (along * z).sum(axis=-1, keepdims=True) * z)
    bent = across * np.linalg.norm(across, axis=-1, keepdims=True)
    x = by_body[..., 0] * _STRAIGHT**2 + (bent if is_arm else -bent)
    x -= (x * z).sum(axis=-1, keepdims=True) * z
    x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return R, np.arctan2((along * x).sum(axis=-1), -(along * z).sum(axis=-1))


def _head_angles(R: Array) -> dict[str, Array]:
    """Angles of R (N, 3, 3) = X(r_head) Z(y_head) Y(-p_head)."""
    yaw = np.arctan2(-R[:, 0, 1], np.hypot(R[:, 1, 1], R[:, 2, 1]))
    roll, pitch = np.arctan2(R[:, 2, 1], R[:, 1, 1]), -np.arctan2(R[:, 0, 2], R[:, 0, 0])
    return dict(zip(_HEAD_NAMES, (roll, yaw, pitch), strict=True))


def _hip_angles(R: Array, side: float) -> tuple[Array, Array, Array]:
    """Angles y, p, r of R (N, 3, 3) = Z(-y) X(p) Y(-r), on the right mirrored: y is not mirrored in
    the model.
    """
    lift = np.arctan2(R[:, 2, 1], np.hypot(R[:, 0, 1], R[:, 1, 1]))
    return side * np.arctan2(R[:, 0, 1], R[:, 1, 1]), lift, np.arctan2(R[:, 2, 0], R[:, 2, 2])


def _shoulder_angles(R: Array) -> tuple[Array, Array, Array]:
    """Angles y, p, r of R (N, 3, 3) = Z(-y) X(p) Z(r), on the right mirrored. Of the two solutions
    this is the one within the limits of the reference model.
    """
    lift = np.arctan2(np.hypot(R[:, 0, 2], R[:, 1, 2]), R[:, 2, 2])
    yaw = np.arctan2(-R[:, 0, 2], -R[:, 1, 2])
    # Limits of the shoulder in the reference model, radians: largest lift to the back, and the
    # middle of its turns about the vertical.
    backwards = (lift <= 0.4) & (np.cos(yaw - 0.4) < 0)
    yaw, lift = np.where(backwards, yaw + math.pi, yaw), np.where(backwards, -lift, lift)
    x = np.cos(yaw) * R[:, 0, 0] - np.sin(yaw) * R[:, 1, 0]
    y = np.sin(yaw) * R[:, 0, 0] + np.cos(yaw) * R[:, 1, 0]
    roll = np.arctan2(np.cos(lift) * y + np.sin(lift) * R[:, 2, 0], x)
    return (yaw + math.pi) % (2 * math.pi) - math.pi, lift, roll
