"""Node that receives 2D detections of several cameras and publishes people in 3D."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import importlib
from collections import deque
from collections.abc import Iterable
from itertools import takewhile
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.set_message import set_message_fields
from shapepose_msgs.msg import Detections
from tf2_msgs.msg import TFMessage

from shapepose_fg import InputError, OnlineReconstructor, Reconstruction, read_rig
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.ros.mcap_files import view_of_message
from shapepose_fg.io.ros.messages import ros_name
from shapepose_fg.io.ros.poses import Frames, frame_of
from shapepose_fg.io.ros.topics import LATCHED, PeopleTopics, Published
from shapepose_fg.io.skeleton_file import find_skeleton

PARAMETERS: dict[str, Any] = {
    "calibration": "calibration.json",
    "skeleton": "BODY_25",
    "lag_s": 0.3,
    "workers": 2,
    "covariances": "joints",
    "bodies": "now",
    "picture": "",
    "moving_cameras": [""],
    "odometry": "",
    "static_frames": True,
    "reliable_detections": False,
}
"""Parameters and their defaults; config/people.yaml explains them."""
QUEUE = 50
"""Maximum number of pictures of a camera that wait to be processed, or for a pose."""
POSES_S = 3.0
"""Time for which poses of moving cameras are kept, s."""
LATCH = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PeopleNode(Node):
    """Passes detections to an `OnlineReconstructor`, and publishes its people.

    All times are those of the messages, so that bags and simulations give the same people.
    """

    def __init__(self) -> None:
        super().__init__("people")
        own = {
            name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()
        }
        self.rig = read_rig(own["calibration"])
        self.skeleton = find_skeleton(own["skeleton"]) or BODY_25
        self.people = OnlineReconstructor(
            self.rig, skeleton=self.skeleton, lag_s=own["lag_s"], workers=own["workers"]
        )
        self.kind_of_bodies, self.static_frames = own["bodies"], own["static_frames"]
        self.moving = {
            each.name: frame_of(each.carrier) for each in self.rig.cameras if each.carrier
        }
        self.moving |= dict.fromkeys(set(own["moving_cameras"]) & set(self.rig.names), "")
        self.topics = PeopleTopics(self.rig, own["covariances"], own["picture"], self.moving)
        self.poses = Frames()
        self.waiting = deque[tuple[Any, str]]()
        """Views of moving cameras, and the coordinate frames whose poses they need."""
        self.publisher_of: dict[str, Any] = {}
        self.done, self.last_change = 0, None

        if self.moving:
            self._listen_to_poses(TFMessage, "/tf", 100)
            self._listen_to_poses(TFMessage, "/tf_static", LATCH)
            if own["odometry"]:
                self._listen_to_poses(Odometry, own["odometry"], 100)
        best_effort = QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
        quality = QUEUE if own["reliable_detections"] else best_effort
        for name in self.rig.names:
            topic = f"{ros_name(name)}/detections"
            self.create_subscription(Detections, topic, self.take_detections, quality)

    def take_detections(self, message: Detections) -> None:
        """Process one camera's detections; those of a moving camera wait for its pose."""
        try:
            view = view_of_message(message, "detections", self.rig, self.skeleton)
        except InputError as error:
            self.get_logger().warning(str(error))
            return
        if message.camera not in self.moving:
            self.push(*view)
            return
        frame = self.moving[message.camera] or message.header.frame_id.lstrip("/")
        self.waiting.append((view, frame))
        self.push_waiting()

    def push_waiting(self) -> None:
        """Process the waiting detections of moving cameras whose poses are known by now."""
        while self.waiting:
            view, frame = self.waiting[0]
            poses, covariances, is_known = self.poses.at(frame, np.array([view[2]]))
            if not is_known[0] and len(self.waiting) <= QUEUE:
                return
            self.waiting.popleft()
            if is_known[0]:
                self.push(*view, poses[0], covariances[0])
                self.poses.forget(view[2] - POSES_S)
            else:
                self.get_logger().warning(f"{view[0]}: no pose of {frame} at {view[2]:.3f} s")

    def push(self, *view: Any) -> None:
        """Process one view, and publish what is new after it."""
        try:
            self.people.push_view(*view)
        except ValueError as error:
            self.get_logger().warning(str(error))
            return
        self._log_cameras()
        done = self.people.report().frames
        if done == self.done:
            return  # other cameras' pictures of this time are still to come
        if self.done == 0 and self.static_frames:
            self.publish(self.topics.fixed(view[2]))
        self.done = done
        self.publish_people("now", self.people.people(), [view[2]])
        self.publish_people("settled", self.people.settled(), [])

    def publish_people(self, kind: str, rows: Reconstruction, empty_s: list[float]) -> None:
        """Publish rows frame by frame; without any, frames without people at `empty_s`, s."""
        for time_s in np.unique(rows.time_s).tolist() or empty_s:
            frame = rows.rows(rows.time_s == time_s)
            self.publish(self.topics.frame(frame, time_s, kind, kind == self.kind_of_bodies))

    def publish(self, messages: Iterable[Published]) -> None:
        """Publish messages; topics of people who have left are removed."""
        for topic, kind, fields in messages:
            package, name = kind.split("/")
            message_type = getattr(importlib.import_module(f"{package}.msg"), name)
            if topic not in self.publisher_of:
                quality = LATCH if topic.endswith(LATCHED) else 100
                self.publisher_of[topic] = self.create_publisher(message_type, topic, quality)
            publisher = self.publisher_of[topic]
            if topic.endswith(LATCHED) or publisher.get_subscription_count() > 0:
                message = message_type()
                set_message_fields(message, fields)
                publisher.publish(message)
            if topic == "/humans/bodies/tracked":
                self._remove_others(fields["ids"])

    def _remove_others(self, ids: list[str]) -> None:
        """Remove the topics of people other than `ids`."""
        for topic in list(self.publisher_of):
            _, *parts = topic.split("/")
            if parts[:2] == ["humans", "bodies"] and len(parts) == 4 and parts[2] not in ids:
                self.destroy_publisher(self.publisher_of.pop(topic))

    def _listen_to_poses(self, message_type: Any, topic: str, quality: Any) -> None:
        """Collect the poses of a topic for moving cameras."""
        package, _, _ = message_type.__module__.partition(".")
        kind = f"{package}/msg/{message_type.__name__}"

        def take(message: Any) -> None:
            try:
                self.poses.add(topic, kind, message, topic)
            except InputError as error:
                self.get_logger().warning(str(error))
            self.push_waiting()

        self.create_subscription(message_type, topic, take, quality)

    def _log_cameras(self) -> None:
        """Log cameras that fail, or work again."""
        changes = self.people.camera_changes()
        new = list(takewhile(lambda each: each is not self.last_change, reversed(changes)))
        for each in reversed(new):
            self.get_logger().warning(
                f"camera {each.camera}: {each.state.name} at {each.time_s:.2f} s"
            )
        self.last_change = changes[-1] if changes else None


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        node = PeopleNode()
    except InputError as error:  # the calibration, mostly
        rclpy.try_shutdown()
        raise SystemExit(str(error)) from None
    try:
        with node.people:
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
