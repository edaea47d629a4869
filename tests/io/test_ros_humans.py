"""REP 155: what a program that knows only the packages hri_msgs and human_description makes of our
messages.
"""

import json
import re
from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.ros.definitions import FIELDS, definition, type_name
from shapepose_fg.io.ros.humans import humans, skeleton_2d
from shapepose_fg.io.ros.topics import PeopleTopics

N = 40
HINGE = (0, -1, 0)
CHAIN = {
    "waist": ("body", "waist", (0, 1, 0)),
    "torso": ("waist", "torso", None),
    "r_head": ("torso", "r_head", (1, 0, 0)),
    "y_head": ("r_head", "y_head", (0, 0, 1)),
    "p_head": ("y_head", "p_head", HINGE),
    "head": ("p_head", "head", None),
}
for side, left in (("l", 1), ("r", -1)):
    CHAIN |= {
        f"{side}_y_shoulder": ("torso", f"{side}_y_shoulder", (0, 0, -left)),
        f"{side}_p_shoulder": (f"{side}_y_shoulder", f"{side}_p_shoulder", (left, 0, 0)),
        f"{side}_r_shoulder": (f"{side}_p_shoulder", f"{side}_shoulder", (0, 0, left)),
        f"{side}_elbow": (f"{side}_shoulder", f"{side}_elbow", HINGE),
        f"{side}_wrist": (f"{side}_elbow", f"{side}_wrist", None),
        f"{side}_y_hip": ("body", f"{side}_y_hip", (0, 0, -1)),
        f"{side}_p_hip": (f"{side}_y_hip", f"{side}_p_hip", (left, 0, 0)),
        f"{side}_r_hip": (f"{side}_p_hip", f"{side}_hip", HINGE),
        f"{side}_knee": (f"{side}_hip", f"{side}_knee", HINGE),
        f"{side}_ankle": (f"{side}_knee", f"{side}_ankle", None),
    }
"""Joints of human_description's human-tpl.xacro: parent, child and axis; None for a fixed one."""
HRI_MSGS = {
    "hri_msgs/msg/IdsList": "std_msgs/Header header\nstring[] ids\n",
    "hri_msgs/msg/NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c\n",
    "hri_msgs/msg/Skeleton2D": (
        "std_msgs/Header header\nuint8 NOSE = 0\nNormalizedPointOfInterest2D[18] skeleton\n"
    ),
    "hri_msgs/msg/NormalizedRegionOfInterest2D": (
        "std_msgs/Header header\nfloat32 xmin\nfloat32 ymin\nfloat32 xmax\nfloat32 ymax\n"
        "float32 c\n"
    ),
}
"""Fields of the package hri_msgs 2 (Apache-2.0)."""


def moved(count: int, spread_rad: float) -> Reconstruction:
    """Bodies in random poses, whose joints are those of the body."""
    rng = np.random.default_rng(5)
    body = BodyParameters(
        rng.normal(0, 1, (count, 10)), rng.normal(0, 1.5, (count, 3)),
        rng.normal(0, spread_rad, (count, 23, 3)), rng.normal(0, 2, (count, 3)),
    )  # fmt: skip
    model = BodyModel.default()
    return Reconstruction(
        frame=np.zeros(count, dtype=np.int64), person=np.arange(count) + 3,
        joint_names=np.array(BODY_25.joints), joints=model.keypoints(body),
        covariance=np.tile(np.eye(3) * 1e-4, (count, 25, 1, 1)), confidence=np.ones((count, 25)),
        status=np.full(count, "ok"), time_s=np.full(count, 2.5),
        velocity=np.zeros((count, 25, 3)), velocity_covariance=np.zeros((count, 25, 3, 3)),
        known=np.full((count, 25), Known.SEEN, dtype=np.uint8), betas=body.betas,
        global_orient=body.global_orient, body_pose=body.body_pose, transl=body.transl,
    )  # fmt: skip


@pytest.fixture(scope="module")
def people() -> Reconstruction:
    return moved(N, 0.5)


def turned(angles: dict[str, float]) -> dict[str, np.ndarray]:
    """Rotation of each link of human_description in the body's frame."""
    found = {"body": np.eye(3)}
    for name, (parent, child, axis) in CHAIN.items():
        turn = np.array(axis or (0, 0, 1)) * (angles[name] if axis else 0.0)
        found[child] = found[parent] @ Rotation.from_rotvec(turn).as_matrix()
    return found


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def test_joint_states_put_limbs_where_people_have_them(people):
    """By the chain and axes of the reference model: upper limbs exactly, lower ones unless they are
    almost straight.
    """
    names = BODY_25.joints
    for each in humans(people):
        rotation = turned(each.angles)
        xyz = dict(zip(names, people.joints[each.row], strict=True))
        R = each.world_from_body[:3, :3]
        for side, long in (("l", "L"), ("r", "R")):
            for points in (("Shoulder", "Elbow", "Wrist"), ("Hip", "Knee", "Ankle")):
                upper, lower = (unit(xyz[long + b] - xyz[long + a]) for a, b in pairwise(points))
                links = [f"{side}_{point.lower()}" for point in points[:2]]
                along = [R @ rotation[link] @ [0, 0, -1] for link in links]
                assert angle_deg(along[0], upper) < 1e-4
                bend = angle_deg(upper, lower)
                assert angle_deg(along[1], lower) < (2 if bend > 30 else 7)
            assert -0.41 < each.angles[f"{side}_p_shoulder"] < 3.3
        np.testing.assert_allclose(rotation["head"], each.links["head"][:3, :3], atol=1e-9)


def test_limbs_bend_as_those_of_people_do(people):
    """Elbows forwards and knees backwards: with both bent by a right angle at hanging arms."""
    rest = moved(1, 0.0)
    pose = np.zeros((1, 23, 3))
    pose[0, 15, 2], pose[0, 16, 2] = -np.pi / 2, np.pi / 2  # SMPL's arms hang
    pose[0, 17, 1], pose[0, 18, 1] = -np.pi / 2, np.pi / 2  # hands to the front
    pose[0, 3:5, 0] = np.pi / 2  # feet to the back
    body = BodyParameters(np.zeros((1, 10)), np.zeros((1, 3)), pose, np.zeros((1, 3)))
    joints = BodyModel.default().keypoints(body)
    rows = replace(rest, joints=joints, global_orient=body.global_orient, body_pose=pose)
    (human,) = humans(rows)
    for side in "lr":
        assert 1.2 < human.angles[f"{side}_elbow"] < 1.9
        assert -1.9 < human.angles[f"{side}_knee"] < -1.2
        assert abs(human.angles[f"{side}_p_shoulder"]) < 0.4
        assert -1.2 < human.angles[f"{side}_y_shoulder"] < 2.0
        assert abs(human.angles[f"{side}_r_hip"]) < 0.3 > abs(human.angles[f"{side}_y_hip"])


def test_frames_are_those_of_the_standard(people):
    published = list(PeopleTopics(None).frame(people, 2.5, "settled", True))
    (tf,) = [fields for topic, _, fields in published if topic == "/tf"]
    parents = {each["child_frame_id"]: each["header"]["frame_id"] for each in tf["transforms"]}
    assert parents["body_p3"] == "world"
    others = {child for child in parents if not child.startswith("body_")}
    links = {child for _, child, _ in CHAIN.values()}
    for child in others:
        link, _, body = child.rpartition("_")
        assert link in links and parents[child] == f"body_{body}"
    assert {f"l_wrist_p{n + 3}" for n in range(N)} <= others
    (tracked,) = [fields for topic, _, fields in published if topic == "/humans/bodies/tracked"]
    assert tracked["ids"] == [f"p{n + 3}" for n in range(N)]
    for each in humans(people):
        wrist = each.world_from_body @ each.links["r_wrist"] @ [0, 0, 0, 1]
        at = BODY_25.index("RWrist")
        np.testing.assert_allclose(wrist[:3], people.joints[each.row, at], atol=1e-9)


def test_the_urdf_is_the_reference_model_with_a_persons_lengths(people):
    first, *_ = humans(people)
    robot = ElementTree.fromstring(first.urdf() or "")
    vector = lambda element, key: tuple(float(x) for x in element.get(key).split())  # noqa: E731
    found, place = {}, {"body_p3": np.zeros(3)}
    rotation = {f"{name}_p3": R for name, R in turned(first.angles).items()}
    for joint in robot.findall("joint"):
        parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
        axis = None if joint.get("type") == "fixed" else vector(joint.find("axis"), "xyz")
        found[joint.get("name").removesuffix("_p3")] = (
            parent.removesuffix("_p3"), child.removesuffix("_p3"), axis,
        )  # fmt: skip
        place[child] = place[parent] + rotation[parent] @ vector(joint.find("origin"), "xyz")
    assert found == CHAIN
    assert {link.get("name") for link in robot.findall("link")} == place.keys()
    # The trunk of the model bends in one direction only; legs start at the hips.
    for limb in ("l_knee", "r_knee", "l_ankle", "r_ankle"):
        np.testing.assert_allclose(place[f"{limb}_p3"], first.links[limb][:3, 3], atol=0.08)


def test_who_is_not_known_whole_is_published_as_far_as_known(people):
    joints = people.joints.copy()
    joints[0, BODY_25.index("LWrist")] = np.nan
    joints[1, BODY_25.index("RShoulder")] = np.nan
    joints[2, BODY_25.index("MidHip")] = np.nan
    rows = replace(people, joints=joints)
    found = {each.row: each for each in humans(rows)}
    assert 2 not in found and len(found) == N - 1
    assert "l_wrist" not in found[0].links and "l_elbow" not in found[0].angles
    assert "l_elbow" in found[0].links and "l_p_shoulder" in found[0].angles
    assert "r_shoulder" not in found[1].links and "r_p_shoulder" not in found[1].angles
    assert found[0].urdf() is None and found[3].urdf() is not None
    for each in found.values():
        numbers = [*each.angles.values(), *np.ravel(list(each.links.values()))]
        assert np.isfinite(numbers).all()


def test_points_of_the_picture_are_those_of_the_camera(people, five_cameras):
    from tests.conftest import STANDING

    camera = five_cameras.cameras[0]
    rows = people.rows(np.arange(1))
    rows = replace(rows, joints=np.array(STANDING)[None])
    points = np.array(skeleton_2d(rows, 0, camera))
    xy, _ = camera.project(rows.joints[0, BODY_25.index("LWrist")])
    np.testing.assert_allclose(points[7, :2] * camera.image_size, camera.distort(xy[None])[0])
    behind = replace(rows, joints=2 * camera.centre - rows.joints)
    assert not np.any(skeleton_2d(behind, 0, camera))


def test_names_of_topics_are_those_that_ros_allows(people, five_cameras):
    """Parts of names begin with a letter or an underscore."""
    rig = Rig((replace(five_cameras.cameras[0], name="2 left"), *five_cameras.cameras[1:]), "z")
    topics = PeopleTopics(rig, picture="2 left")
    for topic, *_ in (*topics.fixed(2.5), *topics.frame(people, 2.5, "now", True)):
        assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic)


def test_urdf_is_published_once(people):
    topics = PeopleTopics(None)
    first = [topic for topic, *_ in topics.frame(people, 2.5, "settled", True)]
    second = [topic for topic, *_ in topics.frame(people, 2.6, "settled", True)]
    assert sum(topic.endswith("/urdf") for topic in first) == N
    assert not any(topic.endswith("/urdf") for topic in second)


@pytest.mark.parametrize("level", ["none", "joints", "all"])
def test_covariances_may_be_left_out(people, level):
    topics = PeopleTopics(None, level)
    (_, _, message), *_ = topics.frame(people, 2.5, "now", False)
    one = message["people"][0]
    assert (len(one["covariance"]), len(one["velocity_covariance"])) == {
        "none": (0, 0), "joints": (225, 0), "all": (225, 225),
    }[level]  # fmt: skip


def stores():
    typesys = pytest.importorskip("rosbags.typesys", reason="needs pip install rosbags")
    for name in ("ROS2_HUMBLE", "ROS2_JAZZY"):
        store = typesys.get_typestore(typesys.Stores[name])
        for kind, text in HRI_MSGS.items():
            store.register(typesys.get_types_from_msg(text, kind))
        yield typesys, store


@pytest.mark.parametrize("which", [0, 1], ids=["humble", "jazzy"])
def test_definitions_are_those_of_the_packages(which):
    """By the hash with which ROS 2 compares types."""
    typesys, theirs = list(stores())[which]
    ours = typesys.get_typestore(typesys.Stores.EMPTY)
    for name in FIELDS:
        ours.register(typesys.get_types_from_msg(definition(name), type_name(name)))
    partial = {"nav_msgs/Odometry"}  # only the fields that are read
    compared = [n for n in FIELDS if not n.startswith("shapepose_msgs/") and n not in partial]
    assert len(compared) > 20
    for name in compared:
        kind = type_name(name)
        assert ours.hash_rihs01(kind) == theirs.hash_rihs01(kind), name


def test_every_message_has_the_fields_of_its_package(people, five_cameras):
    """Serialised and read back with the packages' definitions, not ours."""
    typesys, store = next(iter(stores()))
    for name in ("People", "Person"):
        kind = f"shapepose_msgs/{name}"
        store.register(typesys.get_types_from_msg(definition(kind), type_name(kind)))
    topics = PeopleTopics(five_cameras, picture=five_cameras.names[0])
    rows = people.rows(np.arange(3))
    seen = set()
    for topic, kind, fields in (*topics.fixed(2.5), *topics.frame(rows, 2.5, "now", True)):
        message = filled(store, type_name(kind), fields)
        raw = store.serialize_cdr(message, type_name(kind))
        back = store.deserialize_cdr(raw, type_name(kind))
        seen.add(kind)
        if kind == "sensor_msgs/JointState":
            assert "waist_" + topic.split("/")[3] in back.name
            assert len(back.name) == len(back.position)
        if kind == "hri_msgs/Skeleton2D":
            assert len(back.skeleton) == 18
    assert {"hri_msgs/IdsList", "hri_msgs/Skeleton2D", "hri_msgs/NormalizedRegionOfInterest2D",
            "sensor_msgs/JointState", "std_msgs/String", "tf2_msgs/TFMessage"} <= seen  # fmt: skip
    json.dumps([fields for _, kind, fields in topics.frame(rows, 2.6, "now", True)
                if not kind.startswith("visualization")])  # fmt: skip


def filled(store, kind: str, fields: dict):
    """A message of rosbags from nested fields; each field must exist, and none may be missing."""
    from rosbags.typesys.base import Nodetype

    described = dict(store.fielddefs[kind][1])
    assert described.keys() == fields.keys(), kind

    def value(description, given):
        node, inner = description
        if node == Nodetype.NAME:
            return filled(store, inner, given)
        if node == Nodetype.BASE:
            return given
        item, size = inner
        assert node == Nodetype.SEQUENCE or len(given) == size, kind
        if item[0] == Nodetype.BASE and item[1][0] != "string":
            return np.frombuffer(given, np.uint8) if isinstance(given, bytes) else np.array(
                given, dtype=item[1][0].replace("octet", "uint8"))  # fmt: skip
        return [value(item, each) for each in given]

    return store.types[kind](**{name: value(described[name], fields[name]) for name in fields})
