"""The ROS 2 packages in docs/ros2: the node with a ROS that only remembers, and whether the files
agree with each other and with the library.
"""

import ast
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.ros.definitions import FIELDS, definition

ROS2 = Path(__file__).parents[2] / "docs" / "ros2"
MESSAGES, NODE = ROS2 / "shapepose_msgs", ROS2 / "shapepose_ros"
OURS = sorted(name.split("/")[1] for name in FIELDS if name.startswith("shapepose_msgs/"))


def test_message_files_are_those_of_the_library():
    assert sorted(each.stem for each in (MESSAGES / "msg").iterdir()) == OURS
    for name in OURS:
        lines = (MESSAGES / "msg" / f"{name}.msg").read_text().splitlines()
        fields = [line for line in lines if line and not line.startswith("#")]
        assert fields == definition(f"shapepose_msgs/{name}").split("=" * 80)[0].splitlines()


def test_message_files_are_read_by_another_parser():
    typesys = pytest.importorskip("rosbags.typesys", reason="needs pip install rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    for name in OURS:
        text = (MESSAGES / "msg" / f"{name}.msg").read_text()
        store.register(typesys.get_types_from_msg(text, f"shapepose_msgs/msg/{name}"))
    for name in OURS:
        assert store.hash_rihs01(f"shapepose_msgs/msg/{name}").startswith("RIHS01_")


def test_the_build_lists_every_message_and_dependency():
    cmake = (MESSAGES / "CMakeLists.txt").read_text()
    assert sorted(re.findall(r'"msg/(\w+)\.msg"', cmake)) == OURS
    manifest = ElementTree.parse(MESSAGES / "package.xml").getroot()
    given = {each.text for each in manifest.iter() if "depend" in each.tag}
    assert set(re.findall(r"find_package\((\w+)", cmake)) <= given
    assert manifest.findtext("member_of_group") == "rosidl_interface_packages"
    assert f"project({manifest.findtext('name')})" in cmake


def test_the_nodes_package_names_what_it_uses():
    manifest = ElementTree.parse(NODE / "package.xml").getroot()
    given = {each.text for each in manifest.iter("exec_depend")}
    code = (NODE / "shapepose_ros" / "people_node.py").read_text()
    used = set()
    for each in ast.walk(ast.parse(code)):
        if isinstance(each, ast.ImportFrom):
            used.add(str(each.module).split(".")[0])
        elif isinstance(each, ast.Import):
            used |= {alias.name.split(".")[0] for alias in each.names}
    sent = {name.split("/")[0] for name in FIELDS}
    used -= {*sys.stdlib_module_names, "numpy", "shapepose_fg"}
    assert used | {"hri_msgs", "sensor_msgs", "std_msgs", "visualization_msgs"} <= given
    assert given - {"launch", "launch_ros"} <= used | sent
    setup = (NODE / "setup.py").read_text()
    (module,) = re.findall(r'"\w+ = shapepose_ros\.(\w+):main"', setup)
    assert (NODE / "shapepose_ros" / f"{module}.py").is_file()
    for file in re.findall(r'\["((?:launch|config|package)[^"]*)"\]', setup):
        assert (NODE / file).is_file()
    versions = [ElementTree.parse(each).findtext("version") for each in ROS2.glob("*/package.xml")]
    assert len(set(versions)) == 1 and f'version="{versions[0]}"' in setup


class Node:
    """The part of rclpy's Node that is used."""

    def __init__(self, name: str) -> None:
        self.published: list[tuple[str, dict]] = []
        self.subscribed: dict[str, tuple] = {}
        self.warned: list[str] = []

    def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
        return SimpleNamespace(value=GIVEN.get(name, default))

    def create_publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
        def publish(message) -> None:
            self.published.append((topic, message.fields))

        return SimpleNamespace(
            publish=publish, topic=topic, kind=kind, qos=qos, get_subscription_count=lambda: 1
        )

    def destroy_publisher(self, publisher: SimpleNamespace) -> None:
        self.published.append(("removed", publisher.topic))

    def create_subscription(self, kind: type, topic: str, callback: object, qos: object) -> None:
        self.subscribed[topic] = callback, qos

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.warned.append)


GIVEN: dict[str, object] = {}
"""Parameters of the node."""


@pytest.fixture
def people_node(monkeypatch, tmp_path, five_cameras):
    def module(name: str, **content) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    class Qos(SimpleNamespace):
        def __init__(self, **given) -> None:
            super().__init__(**given)

    module("rclpy")
    module("rclpy.node", Node=Node)
    module("rclpy.executors", ExternalShutdownException=InterruptedError)
    module(
        "rclpy.qos", QoSProfile=Qos,
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="latched"),
        ReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort"),
    )  # fmt: skip
    module("rosidl_runtime_py")

    def set_message_fields(message, fields) -> None:
        message.fields = fields

    module("rosidl_runtime_py.set_message", set_message_fields=set_message_fields)
    for name in (*FIELDS, "nav_msgs/Odometry"):
        package, message = name.split("/")
        if f"{package}.msg" not in sys.modules:
            module(package)
            module(f"{package}.msg")
        made = type(message, (), {"__module__": f"{package}.msg._{message.lower()}"})
        setattr(sys.modules[f"{package}.msg"], message, made)
    write_rig(five_cameras, tmp_path / "calibration.json")
    GIVEN.clear()
    GIVEN.update(calibration=str(tmp_path / "calibration.json"), workers=1)
    file = NODE / "shapepose_ros" / "people_node.py"
    spec = importlib.util.spec_from_file_location("people_node", file)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def stamp(time_s: float) -> SimpleNamespace:
    sec, nanosec = divmod(round(time_s * 1e9), 10**9)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def detections(rig, xy, view: int, time_s: float) -> SimpleNamespace:
    """A shapepose_msgs/Detections."""
    xy = xy + np.random.default_rng(round(time_s * 10)).normal(0, 0.05, xy.shape)  # or it is frozen
    flat = np.concatenate([xy[view], np.full((*xy[view].shape[:2], 1), 0.9)], axis=-1)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp(time_s), frame_id=f"eye_{view}"),
        camera=rig.names[view],
        people=[SimpleNamespace(pose_keypoints_2d=each.ravel().tolist()) for each in flat],
    )


def test_parameters_are_those_of_the_files(people_node):
    text = (NODE / "config" / "people.yaml").read_text()
    assert yaml.safe_load(text)["/**"]["ros__parameters"] == people_node.PARAMETERS


class Recorded(SimpleNamespace):
    """An object of `launch` or `launch_ros`: what it was made from."""

    def __init__(self, *given, **named) -> None:
        super().__init__(given=given, **named)

    def perform(self, context: dict) -> str:
        """The value of a launch configuration."""
        return context[self.given[0]]


def test_the_launch_file_starts_the_node_with_its_parameters(people_node, monkeypatch):
    """Run with a `launch` that only remembers: own arguments override the file of parameters, and
    those that are not given leave it alone.
    """
    names = {
        "launch": "LaunchDescription LaunchContext",
        "launch.actions": "DeclareLaunchArgument OpaqueFunction",
        "launch.substitutions": "LaunchConfiguration PathJoinSubstitution",
        "launch_ros": "",
        "launch_ros.actions": "Node",
        "launch_ros.parameter_descriptions": "ParameterValue",
        "launch_ros.substitutions": "FindPackageShare",
    }
    for module, classes in names.items():
        made = ModuleType(module)
        vars(made).update({each: type(each, (Recorded,), {}) for each in classes.split()})
        monkeypatch.setitem(sys.modules, module, made)
    file = NODE / "launch" / "people.launch.py"
    scope: dict = {"__name__": "people_launch"}
    exec(compile(file.read_text(), str(file), "exec"), scope)
    (actions,) = scope["generate_launch_description"]().given
    *arguments, opened = actions
    declared = {each.given[0]: each.default_value for each in arguments}
    (share, *path) = declared.pop("parameters").given[0]
    known = {**people_node.PARAMETERS, "use_sim_time": False}
    given = {"calibration": "/my/rig.json", "skeleton": "COCO_17", "use_sim_time": "true"}
    assert set(declared.values()) == {""} and declared.keys() == given.keys() <= known.keys()
    for context in ({**declared, "calibration": "/my/rig.json"}, given, declared):
        (node,) = opened.function(context)
        manifest = ElementTree.parse(NODE / "package.xml")
        assert node.package == manifest.findtext("name")
        assert f'"{node.executable} = ' in (NODE / "setup.py").read_text()
        settings, *own = node.parameters
        assert settings.given == ("parameters",)
        assert share.given == (node.package,) and NODE.joinpath(*path).is_file()
        passed = own[0] if own else {}
        assert passed.keys() == {name for name, value in context.items() if value}
        for name, value in passed.items():
            assert value.given[0].given == (name,) and value.value_type is type(known[name])


@pytest.mark.slow
def test_the_node_publishes_who_is_there(people_node, five_cameras, two_people):
    node = people_node.PeopleNode()
    xy, _ = five_cameras.project(two_people)
    with node.people:
        for frame in range(16):
            seen = xy if frame < 8 else xy[:, :1]
            for view, name in enumerate(five_cameras.names):
                callback, qos = node.subscribed[f"{name}/detections"]
                assert qos.reliability == "best effort"
                message = detections(five_cameras, seen, view, frame / 10)
                if frame == 0 and view == 0:
                    message.camera = "no camera"
                callback(message)
    assert len(node.warned) == 1 and "there is no camera" in node.warned[0]
    topics = [topic for topic, _ in node.published]
    assert topics[0] == "/tf_static" and topics.count("/tf_static") == 1
    assert node.publisher_of["/tf_static"].qos.durability == "latched"
    tracked = [fields["ids"] for topic, fields in node.published if topic.endswith("/tracked")]
    assert ["p0", "p1"] in tracked and len(tracked[-1]) == 1
    assert topics.count("/humans/bodies/tracked") == topics.count("/people/now")
    gone = ({"p0", "p1"} - set(tracked[-1])).pop()
    assert ("removed", f"/humans/bodies/{gone}/joint_states") in node.published
    shown = [
        fields["markers"] for topic, fields in node.published if topic == "/people/now/markers"
    ]
    points = np.array([[point[axis] for axis in "xyz"] for point in shown[5][0]["points"]])
    true = two_people[np.argmin(np.abs(two_people.mean(axis=1) - points.mean(axis=0)).sum(axis=1))]
    # Exact pixels of people who stand still, by the filter alone.
    assert np.linalg.norm(points - true, axis=1).mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("source", ["tf", "odometry"])
def test_a_moving_camera_waits_for_its_pose(people_node, five_cameras, two_people, source):
    """The last camera is on a robot: its calibrated pose is not used, that of the messages is."""
    from scipy.spatial.transform import Rotation

    GIVEN["moving_cameras"], GIVEN["odometry"] = [five_cameras.names[4]], "/odom"
    node = people_node.PeopleNode()
    xy, _ = five_cameras.project(two_people)
    pose = five_cameras.cameras[4].wTc
    x, y, z = pose[:3, 3].tolist()
    turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), strict=True))
    place, turn = SimpleNamespace(x=x, y=y, z=z), SimpleNamespace(**turn)

    def pose_at(time_s: float) -> None:
        header = SimpleNamespace(stamp=stamp(time_s), frame_id="world")
        if source == "tf":
            moved = SimpleNamespace(
                header=header, child_frame_id="eye_4",
                transform=SimpleNamespace(translation=place, rotation=turn),
            )  # fmt: skip
            node.subscribed["/tf"][0](SimpleNamespace(transforms=[moved]))
        else:
            given = SimpleNamespace(
                pose=SimpleNamespace(position=place, orientation=turn),
                covariance=(np.eye(6) * 1e-6).ravel(),
            )
            message = SimpleNamespace(header=header, child_frame_id="eye_4", pose=given)
            node.subscribed["/odom"][0](message)

    with node.people:
        pose_at(-0.05 + 1)
        for frame in range(8):
            for view in range(5):
                node.take_detections(detections(five_cameras, xy, view, 1 + frame / 10))
            waits = len(node.waiting)
            pose_at(1 + frame / 10 + 0.05)
            assert waits == 1 and len(node.waiting) == 0
        report = node.people.report()
    assert report.frames == 8 and node.warned == []
    (static,) = [fields for topic, fields in node.published if topic == "/tf_static"]
    children = {each["child_frame_id"] for each in static["transforms"]}
    assert f"{five_cameras.names[4]}_optical" not in children and len(children) == 5
