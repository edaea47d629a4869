"""Reads the detections of one picture from a line of JSON: OpenPose's format, with camera and
time.
"""

from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic import BaseModel, Field, FiniteFloat

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import parse_json
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.core.validation import validated
from shapepose_fg.io.detections.people import OVERSHOOT, joints_of_people
from shapepose_fg.io.detections.view_streams import undistorted

_CURE = (
    'give {"camera": NAME, "time_s": SECONDS, "people": [{"pose_keypoints_2d": [x, y, score, '
    '...]}]}, and for a moving camera "pose": 4 x 4 numbers, "pose_covariance": 6 x 6'
)
_Row4 = Annotated[list[FiniteFloat], Len(4, 4)]
_Row6 = Annotated[list[FiniteFloat], Len(6, 6)]


class _Person(BaseModel, strict=True, extra="allow"):
    pose_keypoints_2d: list[float]


class _Line(BaseModel, strict=True, extra="allow"):
    camera: str
    time_s: Annotated[FiniteFloat, Field(ge=-1e12, le=1e12)]
    people: list[_Person]
    pose: Annotated[list[_Row4], Len(4, 4)] | None = None
    pose_covariance: Annotated[list[_Row6], Len(6, 6)] | None = None


def read_view_line(text: str, place: str, rig: Rig, skeleton: Skeleton) -> tuple[Any, ...] | None:
    """The arguments of `OnlineReconstructor.push_view`: camera, undistorted detections, time in
    seconds, and pose with covariance, None if the line has none. Joints far outside the picture are
    left out.

    None if the camera is one of `Rig.unwanted`. InputError, naming `place`, for an invalid line.
    """
    line = validated(_Line, parse_json(text.strip(), place), place, _CURE)
    if line.camera in rig.unwanted:
        return None
    people = [one.pose_keypoints_2d for one in line.people]
    pose, surely = (
        None if each is None else np.array(each) for each in (line.pose, line.pose_covariance)
    )
    if pose is not None:
        with naming(place, _CURE):
            both = None if surely is None else np.stack([surely, surely])
            Trajectory(line.camera, np.arange(2.0), np.stack([pose, pose]), both)
    return *view_of(line.camera, line.time_s, people, place, rig, skeleton), pose, surely


def view_of(
    camera: str, time_s: float, flat: list[list[float]], place: str, rig: Rig, skeleton: Skeleton
) -> tuple[str, Detections, float]:
    """Camera name, detections and time for keypoints in flat lists of x, y, score (pixels of the
    picture), one list per person.
    """
    if camera not in rig.names:
        raise InputError(
            f"{place}: there is no camera {camera[:40]}; there are {', '.join(rig.names)}"
        )
    K = skeleton.keypoint_count
    if any(len(each) != 3 * K for each in flat):
        wrong = next(len(each) for each in flat if len(each) != 3 * K)
        raise InputError(
            f"{place}: {3 * K} numbers per person are expected for {skeleton.name}, got {wrong}; "
            f"{_CURE}"
        )
    keypoints = np.array(flat, dtype=np.float64).reshape(len(flat), K, 3)
    if np.nanmax(keypoints[..., 2], initial=0.0) > OVERSHOOT:
        raise InputError(
            f"{place}: scores must be 0 to 1, got {np.nanmax(keypoints[..., 2]):.3g}; rescale them"
        )
    frame = np.zeros(len(flat), dtype=np.intp)
    view = joints_of_people(frame, keypoints, lambda score: np.minimum(score, 1.0), skeleton)
    seen = undistorted(view, place, rig.cameras[rig.names.index(camera)]).seen
    return camera, seen, float(time_s)
