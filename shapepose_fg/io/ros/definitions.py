"""Definitions of the ROS 2 messages that are written and read: those of ROS and ROS4HRI, and four
of this project.

Those of others are as in the distributions from Humble on, without constants and comments.
nav_msgs/Odometry and two related messages have only the fields that are read.
"""

import re

FIELDS = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "std_msgs/String": "string data",
    "std_msgs/ColorRGBA": "float32 r; float32 g; float32 b; float32 a",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header; string child_frame_id; geometry_msgs/Transform transform"
    ),
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose; float64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header; geometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": (
        "std_msgs/Header header; geometry_msgs/PoseWithCovariance pose"
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header; string child_frame_id; geometry_msgs/PoseWithCovariance pose"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset; uint32 y_offset; uint32 height; uint32 width; bool do_rectify"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header; uint32 height; uint32 width; string distortion_model; float64[] "
        "d; float64[9] k; float64[9] r; float64[12] p; uint32 binning_x; uint32 binning_y; "
        "sensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header; string[] name; float64[] position; float64[] velocity; float64[] "
        "effort"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header; string format; uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u; float32 v",
    "visualization_msgs/MeshFile": "string filename; uint8[] data",
    "visualization_msgs/Marker": (
        "std_msgs/Header header; string ns; int32 id; int32 type; int32 action; "
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; std_msgs/ColorRGBA color; "
        "builtin_interfaces/Duration lifetime; bool frame_locked; geometry_msgs/Point[] points; "
        "std_msgs/ColorRGBA[] colors; string texture_resource; sensor_msgs/CompressedImage "
        "texture; visualization_msgs/UVCoordinate[] uv_coordinates; string text; string "
        "mesh_resource; visualization_msgs/MeshFile mesh_file; bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "hri_msgs/IdsList": "std_msgs/Header header; string[] ids",
    "hri_msgs/NormalizedPointOfInterest2D": "float32 x; float32 y; float32 c",
    "hri_msgs/Skeleton2D": (
        "std_msgs/Header header; hri_msgs/NormalizedPointOfInterest2D[18] skeleton"
    ),
    "hri_msgs/NormalizedRegionOfInterest2D": (
        "std_msgs/Header header; float32 xmin; float32 ymin; float32 xmax; float32 ymax; float32 c"
    ),
    "shapepose_msgs/Person": (
        "int64 person; string status; float64[] joints; float64[] covariance; float64[] velocity;"
        " float64[] velocity_covariance; uint8[] known; float64[] betas; float64[] global_orient;"
        " float64[] body_pose; float64[] transl"
    ),
    "shapepose_msgs/People": (
        "std_msgs/Header header; string kind; string[] joint_names; shapepose_msgs/Person[] people"
    ),
    "shapepose_msgs/Keypoints": "float64[] pose_keypoints_2d",
    "shapepose_msgs/Detections": (
        "std_msgs/Header header; string camera; shapepose_msgs/Keypoints[] people"
    ),
}


def definition(name: str) -> str:
    """The text of a message and of all messages in it, as stored in MCAP files; `name` is
    package/Message.
    """
    order = [name]
    for each in order:
        inner = (field.split()[0].partition("[")[0] for field in FIELDS[each].split(";"))
        order += [other for other in inner if other in FIELDS and other not in order]
    texts = ["\n".join(field.strip() for field in FIELDS[each].split(";")) + "\n" for each in order]
    separator = "=" * 80 + "\n"
    return texts[0] + "".join(
        f"{separator}MSG: {each}\n{text}" for each, text in zip(order[1:], texts[1:], strict=True)
    )


def type_name(name: str) -> str:
    """Type name package/msg/Message, as used by ROS 2."""
    package, message = name.split("/")
    return f"{package}/msg/{message}"


def check_definition(name: str, text: str) -> None:
    """Check that a message definition `text` has all fields of `name` (package/Message) that are
    read.

    Messages may have further fields. ValueError that names the message and the field. Arrays of
    items without bytes, or with very many items, are refused, too: a short message could expand to
    any number of them.
    """
    parts = re.split(r"^=+\s*MSG: *(\S+) *$", "\n".join(text.splitlines()), flags=re.MULTILINE)
    messages = {
        _plain(each): _fields(each, part)
        for each, part in zip([name, *parts[1::2]], parts[::2], strict=True)
    }
    for each, fields in messages.items():
        size = max(
            (int(n) for kind in fields.values() for n in re.findall(r"\[(?:<=)?(\d+)\]", kind)),
            default=0,
        )
        # Maximum number of items of an array of fixed size.
        if len(fields) == 0 or size > 2**16:
            raise ValueError(f"{each} has {f'an array of {size}' if size else 'no field'}")
    waiting = [(name, name)]
    while len(waiting) > 0:
        own_name, other = waiting.pop()
        if other not in _TIME and other not in messages:
            raise ValueError(f"{other} is not defined")
        found = messages.get(other, _TIME.get(other, {}))
        for kind, field in (each.split() for each in FIELDS[own_name].split(";")):
            inner, _, array = kind.partition("[")
            has, _, has_array = found.get(field, "").partition("[")
            same_family = _FAMILY.get(inner, "message") == _FAMILY.get(has, "message") and has != ""
            if not same_family or array != has_array:
                raise ValueError(f"{other} has no {field} of {kind}")
            if inner in FIELDS:
                waiting.append((inner, has))


def _fields(message: str, text: str) -> dict[str, str]:
    """Types of a message's fields by name, from a text with comments, constants and defaults."""
    found = dict[str, str]()
    for line in text.splitlines():
        kind, _, rest = line.partition("#")[0].strip().partition(" ")
        field = rest.split()[0] if rest.split() else ""
        if field == "" or "=" in rest.partition('"')[0].partition("'")[0]:
            continue
        inner, bracket, array = kind.partition("[")
        inner = re.sub(r"<=\d+$", "", inner)
        if inner not in _FAMILY and "/" not in inner:
            inner = (
                f"{'std_msgs' if inner == 'Header' else _plain(message).partition('/')[0]}/{inner}"
            )
        found[field] = f"{_plain(inner)}{bracket}{array}"
    return found


def _plain(name: str) -> str:
    """Convert package/msg/Message to package/Message."""
    return name.replace("/msg/", "/")


_FAMILY = {each: "whole" for n in (8, 16, 32, 64) for each in (f"int{n}", f"uint{n}")}
_FAMILY |= {
    "byte": "whole",
    "char": "whole",
    "bool": "bool",
    "string": "string",
    "wstring": "wstring",
}
_FAMILY |= {"float32": "real", "float64": "real"}
"""Kind of value for each primitive ROS type; any other type is a message."""
_TIME = {
    each: {"sec": "int32", "nanosec": "uint32"}
    for each in ("builtin_interfaces/Time", "builtin_interfaces/Duration")
}
"""Messages whose definition may be missing in the file."""
