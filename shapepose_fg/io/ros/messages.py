"""Converts rows of a result, and cameras, to the contents of ROS 2 messages.

Coordinate frames follow REP 103 and 105: `map` has z up and is the parent of `world`, the frame of
the calibration; `<camera>_optical` is a camera, z forward; `body_p<identity>` is a person, at the
midpoint of the hips, x to the front and z to the head. Time stamps are on the clock of the
pictures.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from shapepose_fg.body.model.rotation import quaternion
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.drawing import bones_of, colour_of
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.io.ros.humans import Human

Message = dict[str, Any]
MAP, WORLD = "map", "world"
NS = 1_000_000_000
"""Nanoseconds per second."""
_LAST_S = 2**31
"""Upper limit of the seconds in a time stamp, which have 32 bits."""
_JOINT_M, _BONE_M = 0.05, 0.03
COVARIANCES: dict[str, tuple[str, ...]] = {
    "none": (),
    "joints": ("covariance",),
    "all": ("covariance", "velocity_covariance"),
}
"""Columns of a result with covariances, by level of detail."""


def nanoseconds(time_s: float) -> int:
    """Convert a time in seconds to nanoseconds, for the log of an MCAP file; InputError before 1970
    and after 2038.
    """
    if not 0 <= time_s < _LAST_S:
        raise InputError(f"time {time_s:g} s: ROS times must be 0 to 2^31 s; give times from 0 on")
    return round(time_s * NS)


def header(frame_id: str, time_s: float) -> Message:
    """std_msgs/Header."""
    sec, nanosec = divmod(nanoseconds(time_s), NS)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def people_message(
    rows: Reconstruction, kind: str, time_s: float, covariances: str = "all"
) -> Message:
    """shapepose_msgs/People: one frame's rows, the arrays of people.npz, flat, NaN if unknown.
    Covariances that a level of `COVARIANCES` leaves out are empty.
    """
    columns = ("joints", "velocity", *BODY)
    kept = (*columns, *COVARIANCES[covariances])
    people = [
        {
            "person": int(rows.person[n]),
            "status": str(rows.status[n]),
            "known": rows.known[n].tolist(),
        }
        | {
            name: getattr(rows, name)[n].ravel().tolist() if name in kept else []
            for name in (*columns, *COVARIANCES["all"])
        }
        for n in range(len(rows))
    ]
    return {
        "header": header(WORLD, time_s),
        "kind": kind,
        "joint_names": rows.joint_names.tolist(),
        "people": people,
    }


def body_transforms(people: Sequence[Human], time_s: float) -> list[Message]:
    """geometry_msgs/TransformStamped: from the world to each `body_p<identity>`, and from there to
    each link of the body.
    """
    made = [
        (parent, f"{name}_{each.body_id}", pose)
        for each in people
        for parent, name, pose in (
            (WORLD, "body", each.world_from_body),
            *((f"body_{each.body_id}", name, link) for name, link in each.links.items()),
        )
    ]
    return _transforms(made, time_s)


def joint_state(human: Human, time_s: float) -> Message:
    """sensor_msgs/JointState of one person."""
    return {
        "header": header(f"body_{human.body_id}", time_s),
        "name": [f"{name}_{human.body_id}" for name in human.angles],
        "position": list(human.angles.values()),
        "velocity": [],
        "effort": [],
    }


def skeleton_and_region(
    points: Sequence[tuple[float, float, float]], camera: Camera, time_s: float
) -> tuple[Message, Message]:
    """hri_msgs/Skeleton2D and hri_msgs/NormalizedRegionOfInterest2D of the points of one person in
    the picture of a camera.
    """
    stamped = {"header": header(optical(camera), time_s)}
    inside = np.array([each for each in points if each[2] > 0]).reshape(-1, 3)
    box = np.stack([inside.min(axis=0), inside.max(axis=0)]) if len(inside) else np.zeros((2, 3))
    (xmin, ymin, _), (xmax, ymax, c) = box.tolist()
    skeleton = [dict(zip("xyc", each, strict=True)) for each in points]
    region = {"xmin": xmin, "ymin": ymin, "xmax": xmax, "ymax": ymax, "c": c}
    return stamped | {"skeleton": skeleton}, stamped | region


def fixed_transforms(rig: Rig, time_s: float, moving: Collection[str] = ()) -> Message:
    """tf2_msgs/TFMessage of static frames: from `map` to `world`, and from `world`, or from their
    carriers, to the cameras. Cameras that are `moving` without a carrier are left out.
    """
    from scipy.spatial.transform import Rotation

    up, z = rig.up_vector, np.array([0.0, 0, 1])
    R = np.diag([1.0, -1, -1]) if up @ z < 0 else Rotation.align_vectors(z, up)[0].as_matrix()
    made = [(MAP, WORLD, rigid(R, np.zeros(3)))]
    for camera in rig.cameras:
        if camera.carrier:
            made.append((ros_name(camera.carrier), optical(camera), camera.bTc))
        elif camera.name not in moving:
            made.append((WORLD, optical(camera), camera.wTc))
    return {"transforms": _transforms(made, time_s)}


def carrier_transforms(rig: Rig, time_s: float) -> list[Message]:
    """geometry_msgs/TransformStamped from the world to each camera carrier (such as a robot)."""
    at = np.full(1, time_s)
    made = [(WORLD, ros_name(each.name), each.at(at)[0]) for each in rig.trajectories]
    return _transforms(made, time_s)


def camera_info(camera: Camera, time_s: float) -> Message:
    """sensor_msgs/CameraInfo for pictures with lens distortion."""
    width, height = camera.image_size
    # Names of lens models by the number of coefficients; those with more are
    # `rational_polynomial`.
    return {
        "header": header(optical(camera), time_s),
        "height": height,
        "width": width,
        "distortion_model": {4: "equidistant", 5: "plumb_bob"}.get(
            len(camera.distortion), "rational_polynomial"
        ),
        "d": camera.distortion.tolist(),
        "k": camera.K.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.column_stack([camera.K, np.zeros(3)]).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def markers(rows: Reconstruction, time_s: float, lasts_s: float) -> Message:
    """visualization_msgs/MarkerArray: joints and bones of all people, with a lifetime of `lasts_s`
    seconds.
    """
    return {"markers": list(_markers(rows, time_s, lasts_s))}


def _markers(rows: Reconstruction, time_s: float, lasts_s: float) -> Iterator[Message]:
    sec, nanosec = divmod(nanoseconds(lasts_s), NS)
    bones = np.asarray(bones_of(tuple(rows.joint_names.tolist())), dtype=np.intp).reshape(-1, 2)
    for n in range(len(rows)):
        joints = rows.joints[n]
        placed = np.isfinite(joints).all(axis=1)
        ends = bones[placed[bones].all(axis=1)].ravel()
        color = dict(zip("rgba", (*colour_of(int(rows.person[n])), 1.0), strict=True))
        # `SPHERE_LIST` and `LINE_LIST` of visualization_msgs/Marker.
        for ns, kind, points, size in (
            ("joints", 7, joints[placed], (_JOINT_M,) * 3),
            ("bones", 5, joints[ends], (_BONE_M, 0.0, 0.0)),
        ):
            yield {
                "header": header(WORLD, time_s), "ns": ns, "id": int(rows.person[n]) % _LAST_S,
                "type": kind, "action": 0,
                "pose": {"position": _xyz(np.zeros(3)), "orientation": _wxyz(np.eye(4)[0])},
                "scale": _xyz(np.array(size)), "color": color,
                "lifetime": {"sec": sec, "nanosec": nanosec}, "frame_locked": False,
                "points": list(map(_xyz, points)), "colors": [], "texture_resource": "",
                "texture": {"header": header("", 0.0), "format": "", "data": b""},
                "uv_coordinates": [], "text": "", "mesh_resource": "",
                "mesh_file": {"filename": "", "data": b""}, "mesh_use_embedded_materials": False,
            }  # fmt: skip


def ros_name(name: str) -> str:
    """Convert to a valid name of topics and frames: letters, digits and underscores, not beginning
    with a digit.
    """
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return plain if not plain[:1].isdigit() else f"_{plain}"


def optical(camera: Camera) -> str:
    """Name of a camera's optical frame, z forward."""
    return f"{ros_name(camera.name)}_optical"


def _transforms(made: Sequence[tuple[str, str, Array]], time_s: float) -> list[Message]:
    """geometry_msgs/TransformStamped of parents, children and poses (4, 4)."""
    poses = np.array([pose for *_, pose in made]).reshape(-1, 4, 4)
    return [
        {
            "header": header(parent, time_s),
            "child_frame_id": child,
            "transform": {"translation": _xyz(place), "rotation": _wxyz(turn)},
        }
        for (parent, child, _), place, turn in zip(
            made, poses[:, :3, 3], quaternion(poses[:, :3, :3]), strict=True
        )
    ]


def _xyz(point: Array) -> Message:
    return dict(zip("xyz", point.tolist(), strict=True))


def _wxyz(turn: Array) -> Message:
    return dict(zip("wxyz", turn.tolist(), strict=True))
