"""Poses from ROS 2 messages (transforms, odometry and poses), as a tree of coordinate frames."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.trajectory import MOST_METRES, MOST_VARIANCE, UNIT_LENGTH, Trajectory
from shapepose_fg.io.ros.definitions import type_name
from shapepose_fg.io.ros.messages import NS, WORLD, ros_name

TREE = "tf2_msgs/TFMessage"
_WITH_CHILD = "nav_msgs/Odometry"
_ALONE = ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped")
KINDS = tuple(map(type_name, (TREE, _WITH_CHILD, *_ALONE)))
"""Types of messages with poses."""
_STATIC = "tf_static"


class Frames:
    """Poses of coordinate frames relative to their parents, collected from messages, and composed
    along the tree.
    """

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}
        self._received: dict[str, dict[int, tuple[Array, Array | None]]] = defaultdict(dict)
        self._fixed: dict[str, Array] = {}
        self._with_covariance = set[str]()
        self._known: dict[str, Trajectory] = {}

    def add(self, topic: str, kind: str, message: Any, place: str) -> None:
        """Add a message of one of `KINDS`. InputError naming `place` if a pose in it is invalid.

        Odometry has precedence over transforms of the same frame, because it has covariances.
        """
        for parent, child, stamp, pose, covariance in _links(topic, kind, message):
            if topic.endswith(_STATIC):
                self._fixed[child], self._parent[child] = (
                    _matrix(pose, f"{place}, frame {child}"),
                    parent,
                )
                continue
            covariances = _covariance(covariance, pose, f"{place}, frame {child}")
            if covariances is None and child in self._with_covariance:
                continue
            if covariances is not None and child not in self._with_covariance:
                self._with_covariance.add(child)
                self._received[child].clear()
            self._received[child][stamp] = _matrix(pose, f"{place}, frame {child}"), covariances
            self._parent[child] = parent
            self._known.pop(child, None)

    @property
    def moving(self) -> list[str]:
        """Frames that move relative to their parents, without descendants that do."""
        carries = {self._parent[child] for child in self._received}
        return sorted(child for child in self._received if child not in carries)

    def chain(self, frame: str) -> list[str]:
        """A frame, its parent, and so on, up to the frame below `world`, or to the last one with a
        parent.
        """
        found = list[str]()
        while frame in self._parent and frame != WORLD and frame not in found:
            found.append(frame)
            frame = self._parent[frame]
        return found

    def moves(self, frame: str) -> bool:
        """Whether the frame, or one of its ancestors, has several poses over time."""
        return any(each in self._received for each in self.chain(frame))

    def at(self, frame: str, time_s: Array) -> tuple[Array, Array, Mask]:
        """Poses (N, 4, 4) of a frame in the root of its tree at times (N,), their covariances (N,
        6, 6), rotation, then translation, along its own axes (0 if unknown), and (N,) whether poses
        close enough in time exist.
        """
        poses = np.tile(np.eye(4), (len(time_s), 1, 1))
        covariances, exists = np.zeros((len(time_s), 6, 6)), np.full(len(time_s), self.moves(frame))
        for each in self.chain(frame):
            # The error of a product A B is the error of A, transformed to B, plus the error of B.
            link = self._trajectory(each) if each in self._received else None
            if link is not None:
                exists &= link.covers(time_s)
                carry = _of_inverse(poses)
                covariances += carry @ link.covariance_at(time_s) @ carry.mT
            elif each in self._received:
                exists[:] = False
            poses = (self._fixed.get(each, np.eye(4)) if link is None else link.at(time_s)) @ poses
        return poses, covariances, exists

    def trajectory(self, frame: str, name: str) -> Trajectory:
        """The trajectory of a frame, at the times of the link in its chain with the most poses.
        ValueError if it has none.
        """
        moved = [each for each in self.chain(frame) if each in self._received]
        most = max(moved, key=lambda each: len(self._received[each]))
        time_s = np.array(sorted(self._received[most])) / NS
        poses, covariances, exists = self.at(frame, time_s)
        if exists.sum() < 2:
            raise ValueError(
                f"2 poses are needed, with {' in '.join(self.chain(frame))} known at the same time"
            )
        says = covariances[exists].any()
        return Trajectory(
            name, time_s[exists], poses[exists], covariances[exists] if says else None
        )

    def forget(self, before_s: float) -> None:
        """Drop poses before `before_s`, except for the last one of each link."""
        for child, received in self._received.items():
            for stamp in sorted(stamp for stamp in received if stamp < before_s * NS)[:-1]:
                del received[stamp]
                self._known.pop(child, None)

    def _trajectory(self, child: str) -> Trajectory | None:
        """One link over time; None if it has only one pose."""
        if child not in self._known and len(self._received[child]) > 1:
            received = sorted(self._received[child].items())
            time_s, poses = (
                np.array([at for at, _ in received]) / NS,
                np.stack([pose for _, (pose, _) in received]),
            )
            says = [covariances for _, (_, covariances) in received if covariances is not None]
            self._known[child] = Trajectory(child, time_s, poses, np.stack(says) if says else None)
        return self._known.get(child)


def _links(topic: str, kind: str, message: Any) -> Iterator[tuple[str, str, int, Array, Any]]:
    """Parent, child, stamp in nanoseconds, x y z qx qy qz qw and 36 numbers or None, for each pose
    in a message.
    """
    stamped = message.transforms if kind == type_name(TREE) else [message]
    for each in stamped:
        covariance = None
        if kind == type_name(TREE):
            child, place, turn = (
                each.child_frame_id,
                each.transform.translation,
                each.transform.rotation,
            )
        else:
            child = each.child_frame_id if kind == type_name(_WITH_CHILD) else topic
            pose, covariance = each.pose, getattr(each.pose, "covariance", None)
            pose = pose.pose if covariance is not None else pose
            place, turn = pose.position, pose.orientation
        numbers = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
        yield (
            each.header.frame_id.lstrip("/"),
            child.lstrip("/"),
            stamp_ns(each.header),
            numbers,
            covariance,
        )


def stamp_ns(header: Any) -> int:
    """Time stamp of a std_msgs/Header, nanoseconds."""
    return header.stamp.sec * NS + header.stamp.nanosec


def frame_of(carrier: str) -> str:
    """The coordinate frame of a carrier: the part of its name after #, otherwise the whole name."""
    file, _, frame = carrier.partition("#")
    return frame.lstrip("/") if frame else ros_name(file)


def _matrix(pose: Array, place: str) -> Array:
    from scipy.spatial.transform import Rotation

    if not np.isfinite(pose).all() or abs(np.linalg.norm(pose[3:]) - 1) > UNIT_LENGTH:
        raise InputError(
            f"{place}: a pose must be finite, with a quaternion of length 1; leave it out"
        )
    if np.abs(pose[:3]).max() > MOST_METRES:
        raise InputError(f"{place}: a pose is more than {MOST_METRES:g} m away; write metres")
    return rigid(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])


def _covariance(numbers: Any, pose: Array, place: str) -> Array | None:
    """(6, 6) covariance of rotation, then translation, along the frame's own axes, from ROS's 36
    values along the parent's axes; None if these are zero (unknown), or begin with -1.
    """
    if numbers is None:
        return None
    # ROS lists translation before rotation.
    parents = np.roll(np.array(list(numbers), dtype=np.float64).reshape(6, 6), 3, axis=(0, 1))
    if not parents.any() or parents[3, 3] == -1:
        return None
    if not np.isfinite(parents).all() or np.linalg.eigvalsh(parents)[0] < -1e-9 * max(
        1.0, parents.max()
    ):
        raise InputError(
            f"{place}: a covariance must be finite, without negative eigenvalues; write zeros"
        )
    # Some programs write the largest double for an unknown value.
    parents = np.minimum(parents, MOST_VARIANCE / 10)
    turn = np.kron(np.eye(2), _matrix(pose, place)[:3, :3])
    return np.asarray(turn.T @ (parents + parents.T) / 2 @ turn)


def _of_inverse(poses: Array) -> Array:
    """(N, 6, 6) adjoints of the inverses of poses (N, 4, 4): they transform from a parent's axes to
    the frame's.
    """
    R, (x, y, z) = poses[:, :3, :3].mT, poses[:, :3, 3].T
    none = np.zeros_like(x)
    found = np.zeros((len(poses), 6, 6))
    found[:, :3, :3] = found[:, 3:, 3:] = R
    found[:, 3:, :3] = R @ np.stack([none, z, -y, -z, none, x, y, -x, none], axis=-1).reshape(
        -1, 3, 3
    )
    return found
