"""scripts/run_pose2sim.py: what it writes for Pose2Sim, read back; Pose2Sim itself is not run."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(scope="module")
def script():
    """The script as a module; it imports its neighbour."""
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("run_pose2sim", SCRIPTS / "run_pose2sim.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["run_pose2sim"] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(SCRIPTS))
        sys.modules.pop("run_pose2sim", None)


def test_the_project_holds_the_same_cameras_and_people(script, tmp_path, five_cameras, two_people, seen_exactly):
    """Our own reader of Pose2Sim's cameras gives the rig back; each folder of people is named after its camera."""
    found = seen_exactly(five_cameras, two_people)
    project = tmp_path / "project"
    script.write_project(project, Recording(BODY_25, [found, found]), five_cameras, 3)
    read = read_rig(project / "calibration" / "Calib.toml", up="z")
    assert read.names == tuple(f"cam{view:02d}" for view in range(1, 6))
    np.testing.assert_allclose(read.K, five_cameras.K, atol=1e-9)
    np.testing.assert_allclose(read.cTw, five_cameras.cTw, atol=1e-9)
    folders = sorted(each.name for each in (project / "pose").iterdir())
    assert folders == [f"{name}_json" for name in read.names]
    for name in read.names:
        (project / "pose" / f"{name}_json").rename(project / "pose" / name)
    again = read_detections(project / "pose", read)
    assert len(again) == 2
    frame = again[1]
    for view in range(5):
        ours, its = found.xy[found.view == view], frame.xy[frame.view == view]
        np.testing.assert_allclose(np.sort(its, axis=0), np.sort(ours, axis=0), atol=1e-3)


def test_small_groups_are_left_out_where_they_are_to_be(script, tmp_path, five_cameras, two_people, seen_exactly):
    found = seen_exactly(five_cameras, two_people)
    head = np.isin(found.joint, [0, 15, 16, 17, 18])
    nobody = found.only(head)  # five joints a person
    for smallest, people in ((3, 2), (9, 0)):
        project = tmp_path / str(smallest)
        script.write_project(project, Recording(BODY_25, [nobody]), five_cameras, smallest)
        files = list((project / "pose" / "cam01_json").iterdir())
        assert len(files) == 1
        assert files[0].read_text().count("pose_keypoints_2d") == people


def test_its_skeleton_has_every_joint_once(script):
    def walk(node):
        yield node["id"], node["name"]
        for child in node.get("children", ()):
            yield from walk(child)

    ids = dict(walk(script.skeleton()))
    assert ids == {j: "CHip" if name == "MidHip" else name for j, name in enumerate(BODY_25.joints)}


def test_time_is_used_in_one_of_the_results_only(script, tmp_path):
    raw, filtered = (script.settings(tmp_path, 29.97, 300, 0.05, filtered=each) for each in (False, True))
    assert (raw["triangulation"]["interpolation"], filtered["triangulation"]["interpolation"]) == (
        "none",
        "linear",
    )
    assert raw["triangulation"]["fill_large_gaps_with"] == "nan"
    assert raw["project"]["frame_rate"] == 30
    assert raw["personAssociation"]["multi_person"]["reconstruction_error_threshold"] == 0.05
