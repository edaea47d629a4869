"""Topics on which people are published, for MCAP files and for nodes."""

from collections.abc import Collection, Iterator

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.ros.humans import humans, skeleton_2d
from shapepose_fg.io.ros.messages import (
    Message,
    body_transforms,
    camera_info,
    carrier_transforms,
    fixed_transforms,
    header,
    joint_state,
    markers,
    people_message,
    ros_name,
    skeleton_and_region,
)

Published = tuple[str, str, Message]
"""A topic, the type of its message (package/Message), and the message's fields."""
LATCHED = ("/tf_static", "/camera_info", "/urdf")
"""Ends of topics that are published once: later subscribers must receive them, too."""
_BODIES = "/humans/bodies"


class PeopleTopics:
    """Messages of one run, frame by frame.

    `rig` may be None: then there are no messages about cameras. `covariances` is a level of
    `COVARIANCES`. With the name of a camera as `picture`, people get their 2D skeleton and region
    in its picture. Cameras that are `moving` without a carrier have no static frame.
    """

    def __init__(
        self,
        rig: Rig | None,
        covariances: str = "all",
        picture: str = "",
        moving: Collection[str] = (),
    ) -> None:
        self._rig, self._covariances, self._moving = rig, covariances, moving
        self._camera = (
            rig.cameras[rig.names.index(picture)] if rig is not None and picture else None
        )
        self._described = set[str]()
        """Identifiers of the people whose URDF has been published; a person who returns gets
        another identifier."""

    def fixed(self, time_s: float) -> Iterator[Published]:
        """Yield /tf_static and the cameras, which are published once."""
        if self._rig is not None:
            yield (
                "/tf_static",
                "tf2_msgs/TFMessage",
                fixed_transforms(self._rig, time_s, self._moving),
            )
            for camera in self._rig.cameras:
                topic = f"/{ros_name(camera.name)}/camera_info"
                yield topic, "sensor_msgs/CameraInfo", camera_info(camera, time_s)

    def frame(
        self, rows: Reconstruction, time_s: float, kind: str, has_bodies: bool
    ) -> Iterator[Published]:
        """Yield the people of one frame; `kind` is `now` or `settled`.

        With `has_bodies`, also /tf and the topics of REP 155, which have one pose of each person at
        a time and must be of one kind.
        """
        topic = f"/people/{kind}"
        yield topic, "shapepose_msgs/People", people_message(rows, kind, time_s, self._covariances)
        # Lifetime of the markers of a person who is no longer seen, s.
        yield f"{topic}/markers", "visualization_msgs/MarkerArray", markers(rows, time_s, 0.2)
        if has_bodies:
            yield from self._bodies(rows, time_s)

    def _bodies(self, rows: Reconstruction, time_s: float) -> Iterator[Published]:
        people = list(humans(rows))
        moved = body_transforms(people, time_s)
        if self._rig is not None:
            moved += carrier_transforms(self._rig, time_s)
        if moved:
            yield "/tf", "tf2_msgs/TFMessage", {"transforms": moved}
        ids = {"header": header("", time_s), "ids": [each.body_id for each in people]}
        yield f"{_BODIES}/tracked", "hri_msgs/IdsList", ids
        self._described &= {each.body_id for each in people}
        for each in people:
            topic = f"{_BODIES}/{each.body_id}"
            yield f"{topic}/joint_states", "sensor_msgs/JointState", joint_state(each, time_s)
            if self._camera is not None:
                points = skeleton_2d(rows, each.row, self._camera)
                skeleton, region = skeleton_and_region(points, self._camera, time_s)
                yield f"{topic}/skeleton2d", "hri_msgs/Skeleton2D", skeleton
                yield f"{topic}/roi", "hri_msgs/NormalizedRegionOfInterest2D", region
            if each.body_id not in self._described and (urdf := each.urdf()) is not None:
                self._described.add(each.body_id)
                yield f"{topic}/urdf", "std_msgs/String", {"data": urdf}
