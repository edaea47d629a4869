"""The node of docs/ros.md, with a ROS that only remembers; and the definitions that the page
lists.
"""

import json
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.ros.definitions import definition

PAGE = (Path(__file__).parents[2] / "docs" / "ros.md").read_text(encoding="utf-8")


def test_the_page_lists_the_messages_of_our_own():
    (text,) = re.findall(r"```text\n(.*?)```", PAGE, flags=re.DOTALL)
    for name, fields in re.findall(r"# (\w+)\.msg\n((?:[^#].*\n)+)", text):
        assert definition(f"shapepose_msgs/{name}").split("=" * 80)[0] == fields
    assert text.count(".msg") == 4


class Remembering:
    """rclpy's Node, as far as the example goes."""

    def __init__(self, name: str) -> None:
        self.published: list[tuple[str, dict]] = []
        self.subscribed: dict[str, object] = {}
        self.warned: list[str] = []

    def declare_parameter(self, name: str, default: str) -> SimpleNamespace:
        return SimpleNamespace(value=default)

    def create_publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
        return SimpleNamespace(
            publish=lambda message: self.published.append((topic, message.fields))
        )

    def create_subscription(self, kind: type, topic: str, callback: object, qos: object) -> None:
        self.subscribed[topic] = callback

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.warned.append)


@pytest.fixture
def ros(monkeypatch):
    def module(name: str, **content) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    message = type("Message", (), {})
    module("rclpy")
    module("rclpy.node", Node=Remembering)
    module("rclpy.qos", QoSProfile=dict, DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL=1))
    module("rosidl_runtime_py")
    module(
        "rosidl_runtime_py.set_message",
        set_message_fields=lambda to, fields: setattr(to, "fields", fields),
    )
    for package, name in (
        ("std_msgs", "String"),
        ("tf2_msgs", "TFMessage"),
        ("visualization_msgs", "MarkerArray"),
    ):
        module(package)
        module(f"{package}.msg", **{name: message})


@pytest.mark.slow
def test_the_node_publishes_who_is_there(ros, tmp_path, monkeypatch, five_cameras, two_people):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(code.splitlines()) <= 80
    monkeypatch.chdir(tmp_path)
    write_rig(five_cameras, tmp_path / "calibration.json")
    code = code.replace("workers=2", "workers=1")  # no processes in a test
    names: dict = {"__name__": "node"}
    exec(compile(code, "docs/ros.md", "exec"), names)
    node = names["People"]()
    xy, _ = five_cameras.project(two_people)
    with node.live:
        node.seen(SimpleNamespace(data="no line"))
        assert len(node.warned) == 1
        for frame in range(8):
            for view, callback in enumerate(node.subscribed.values()):
                flat = (
                    np.concatenate([xy[view], np.full((2, 25, 1), 0.9)], axis=-1)
                    .reshape(2, -1)
                    .tolist()
                )
                seen = {"camera": five_cameras.names[view], "time_s": frame / 10}
                data = json.dumps(seen | {"people": [{"pose_keypoints_2d": each} for each in flat]})
                callback(SimpleNamespace(data=data))
    topics = [topic for topic, _ in node.published]
    assert topics[0] == "/tf_static" and topics.count("/tf_static") == 1
    shown = [fields["markers"] for topic, fields in node.published if topic == "people/markers"][-1]
    assert sorted({each["id"] for each in shown}) == [0, 1] and len(shown) == 4
    points = np.array([[point[axis] for axis in "xyz"] for point in shown[0]["points"]])
    true = two_people[np.argmin(np.abs(two_people.mean(axis=1) - points.mean(axis=0)).sum(axis=1))]
    # Exact pixels of people who stand still, by the filter alone.
    assert np.linalg.norm(points - true, axis=1).mean() < 0.02
