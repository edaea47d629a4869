"""People by REP 155 (ROS4HRI): joint states, link frames and a URDF of each person, and the 2D
skeleton in one camera.

Joints and links have the names and axes of the package human_description. In its zero pose a person
stands upright with hanging arms, and all frames have x to the front, y to the left and z up. The
trunk bends only forwards and backwards, elbows and knees are hinges.
"""

import math
import warnings
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

_FRONT_LEFT_UP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""Rotation to SMPL's axes (x left, y up, z front) from axes to the front, to the left and up."""
_HEAD = (0, 3, 6, 9, 12, 15)
"""SMPL's joints from the pelvis to the head."""
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
_RADIUS_M = 0.03
"""Radius of the limbs that the URDF draws, m."""


_Axes = tuple[tuple[float, float, float], ...]


class _Limb(NamedTuple):
    """An arm or a leg of the kinematic model."""

    links: tuple[str, ...]
    """Upper and lower link, and the end."""
    joints: tuple[str, ...]
    """Joints at the origins of these links, in the result."""
    smpl: tuple[int, ...]
    """SMPL's joints from the pelvis to the upper link."""
    side: float
    """1 on the left, -1 on the right: direction along y."""

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
        """Names of these three joints."""
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
        ("L", _ARM, (0, 3, 6, 9, 13, 16)),
        ("R", _ARM, (0, 3, 6, 9, 14, 17)),
        ("L", _LEG, (0, 1)),
        ("R", _LEG, (0, 2)),
    )
)


@dataclass(frozen=True)
class Human:
    """One person in one frame, in the kinematic model of REP 155."""

    row: int
    """Row of the result."""
    body_id: str
    """Identifier in the names of topics, frames and joints."""
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
            """Add a joint and its child link; draw the parent up to a joint along its z."""
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
                SubElement(shape, "cylinder", radius=f"{_RADIUS_M}", length=f"{abs(z):.4f}")

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
    for n in range(len(rows)):
        joints = dict(zip(rows.joint_names.tolist(), rows.joints[n], strict=True))
        hips = joints.get("MidHip", _middle(joints, "RHip", "LHip"))
        turns = np.concatenate([rows.global_orient[n, None], rows.body_pose[n]])
        if np.isfinite(hips).all() and np.isfinite(turns).all():
            smpl = exp_so3(turns)
            R = smpl[0] @ _FRONT_LEFT_UP
            places = {name: (each - hips) @ R for name, each in joints.items()}
            links, angles = _links(places, smpl)
            known = {name: link for name, link in links.items() if np.isfinite(link).all()}
            yield Human(n, str(int(rows.person[n])), rigid(R, hips), known, angles)


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


def _links(places: dict[str, Array], smpl: Array) -> tuple[dict[str, Array], dict[str, float]]:
    """Links, NaN if unknown, and angles, from joints in the body's frame and SMPL's rotations (24,
    3, 3).
    """

    def by_body(chain: tuple[int, ...]) -> Array:
        """Rotation of a bone in the body's frame; the identity in SMPL's rest pose."""
        return _FRONT_LEFT_UP.T @ reduce(np.matmul, smpl[list(chain[1:])]) @ _FRONT_LEFT_UP

    neck = places.get("Neck", _middle(places, "LShoulder", "RShoulder"))
    pitch = math.atan2(neck[0], neck[2]) if np.isfinite(neck).all() else 0.0
    torso, head = exp_so3(np.array([0.0, pitch, 0.0])), by_body(_HEAD)
    links = {
        "waist": rigid(torso, np.zeros(3)),
        "torso": rigid(torso, neck),
        "head": rigid(head, _middle(places, "LEar", "REar")),
    }
    angles = {"waist": pitch}
    angles |= zip(_HEAD_NAMES, _angles(torso.T @ head, _HEAD_AXES), strict=True)
    for limb in _LIMBS:
        # SMPL's arms point to the sides at rest, those of this model hang.
        hang = exp_so3(np.array([limb.side * math.pi / 2 if limb.is_arm else 0.0, 0.0, 0.0]))
        start, middle, end = (places.get(name, np.full(3, np.nan)) for name in limb.joints)
        forwards = 1.0 if limb.is_arm else -1.0
        upper, bend = _hinged(middle - start, end - middle, by_body(limb.smpl) @ hang, forwards)
        lower = upper @ exp_so3(np.array(_HINGE) * np.nan_to_num(bend))
        turns, points = (upper, lower, lower), (start, middle, end)
        links |= {
            name: rigid(turn, point)
            for name, turn, point in zip(limb.links, turns, points, strict=True)
        }
        if np.isfinite(upper).all():
            root = torso if limb.is_arm else np.eye(3)
            angles |= zip(limb.names, _angles(root.T @ upper, limb.axes), strict=True)
            angles |= {limb.links[1]: bend} if math.isfinite(bend) else {}
    return links, angles


def _hinged(upper: Array, lower: Array, by_body: Array, forwards: float) -> tuple[Array, float]:
    """Rotation (3, 3) of an upper arm or thigh along -z, and the angle of its hinge, from the
    vectors to the next joint and from there to the end; NaN if unknown.

    `by_body` is the rotation according to the fitted body, and `forwards` the direction in which
    the hinge bends.
    """
    z, along = -upper / np.linalg.norm(upper), lower / np.linalg.norm(lower)
    across = np.nan_to_num(along - (along @ z) * z)
    x = by_body[:, 0] * _STRAIGHT**2 + forwards * across * np.linalg.norm(across)
    x -= (x @ z) * z
    x /= max(float(np.linalg.norm(x)), 1e-12)
    return np.column_stack([x, np.cross(z, x), z]), math.atan2(along @ x, -(along @ z))


def _angles(R: Array, axes: _Axes) -> list[float]:
    """Angles of three consecutive joints about `axes` that together turn by R, radians."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():  # of aligned axes: any split of their turn is right
        warnings.simplefilter("ignore")
        return Rotation.from_matrix(R).as_davenport(np.array(axes, float), "intrinsic").tolist()


def _middle(places: dict[str, Array], first: str, second: str) -> Array:
    """(3,) midpoint of two joints; NaN if unknown."""
    unknown = np.full(3, np.nan)
    return (places.get(first, unknown) + places.get(second, unknown)) / 2
