"""Trajectories from files: what odometry and SLAM write, and one sentence for what cannot be
used.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.rig_file import write_trajectory
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.calibration import read_rig, with_trajectories, write_rig
from shapepose_fg.io.trajectories import read_trajectory
from shapepose_fg.simulation.scene import ring_of_cameras

TUM = "# time x y z qx qy qz qw\n10.0 1 2 3 0 0 0 1\n10.5 1 2 4 0 0 0.70710678 0.70710678\n"


def read(tmp_path: Path, text: str) -> Trajectory:
    (tmp_path / "robot.tum").write_text(text)
    return read_trajectory(tmp_path / "robot.tum")


def test_tum(tmp_path):
    found = read(tmp_path, TUM)
    assert found.name == "robot" and found.covariance is None
    np.testing.assert_allclose(found.time_s, [10, 10.5])
    np.testing.assert_allclose(found.wTb[:, :3, 3], [[1, 2, 3], [1, 2, 4]])
    # A quarter turn about z takes x to y.
    np.testing.assert_allclose(found.wTb[1, :3, 0], [0, 1, 0], atol=1e-8)


STRAY = (
    "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, "
    "distortion_center_y\n"
    "812.5, 000000, 1, 2, 3, 0, 0, 0, 1, 1400, 1401, 950, 725, , \n"
    "812.6, 000001, 1, 2, 4, 0, 0, 0, 1, 1402, 1403, 952, 727, , \n"
)
"""What Stray Scanner writes on an iPhone: OpenCV's axes."""
ARKIT = "812500000000 1 0 0 1 0 1 0 2 0 0 1 3 \n812600000000 1 0 0 1 0 1 0 2 0 0 1 4 \n"
"""What ARKit Data Logger writes: rows of the 3 x 4 matrix; the camera looks along -z."""
ARCORE = "812500000000 0 0 0 1 1 2 3\n812500000000 0 0 0 1 1 2 3\n812600000000 0 0 0 1 1 2 4\n"
"""What ARCore Data Logger writes: qx qy qz qw tx ty tz; a picture may be logged twice."""


@pytest.mark.parametrize(("text", "ahead"), [(STRAY, 1), (ARKIT, -1), (ARCORE, -1)])
def test_logs_of_phones_with_their_axes(tmp_path, text, ahead):
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.time_s, [812.5, 812.6])
    np.testing.assert_allclose(found.wTb[:, :3, 3], [[1, 2, 3], [1, 2, 4]])
    np.testing.assert_allclose(found.wTb[1, :3, :3], np.diag([1, ahead, ahead]), atol=1e-12)


def test_a_log_with_a_clock_of_its_own_begins_with_the_pictures(tmp_path):
    found = read(tmp_path, STRAY)
    np.testing.assert_allclose(found.from_start(np.array([np.nan, 2.0, 2.1])).time_s, [2.0, 2.1])
    assert found.from_start(np.array([812.0, 813.0])) is found


def test_columns_in_any_order_with_covariances(tmp_path):
    head = "qw,qx,qy,qz,x,y,z,time_s,rx_rx,ry_ry,rz_rz,x_x,y_y,z_z,rx_z"
    row = "1,0,0,0,5,6,7,{},1e-4,1e-4,4e-4,0.01,0.02,0.03,1e-3"
    found = read(tmp_path, "\n".join([head, row.format(0), row.format(1)]))
    np.testing.assert_allclose(found.wTb[0, :3, 3], [5, 6, 7])
    expected = np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.02, 0.03])
    expected[0, 5] = expected[5, 0] = 1e-3
    assert found.covariance is not None
    np.testing.assert_allclose(found.covariance, np.stack([expected] * 2))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("0 1 2 3 0 0 0 1\n", "a trajectory needs 2 poses or more, got 1; write a line for each"),
        (TUM + "11 1 2 3 0 0 1\n", "line 4 must hold 8 numbers, got 7; correct the line"),
        (TUM + "11 1 2 x 0 0 0 1\n", "line 4 must hold numbers, got 'x'; write seconds and metres"),
        (TUM + "11 1 2 nan 0 0 0 1\n",
         "line 4 must hold numbers, got 'nan'; write seconds and metres"),
        (TUM + "10.5 1 2 3 0 0 0 1\n", "line 4 must be later than the pose before; sort by time"),
        (TUM + "11 1 2 3 1 0 0 1\n",
         "line 4: the quaternion qx qy qz qw must have length 1, got 1.414; write"),
        (TUM + "11 1e9 2 3 0 0 0 1\n", "line 4 is more than 1e+06 m away; write metres"),
        ("0 1 0 0 1 0 1 0 2 0 0 9 3\n" * 2, "rows must hold a time and a rotation beside a trans"),
        ("time_s x y z qx qy qz\n", "line 1: column qw is missing; name the columns time_s"),
        ("time_s x y z qx qy qz qw speed\n",
         "line 1: column 'speed' is unknown or occurs twice; name"),
        ("time_s x y z qx qy qz qw x_x\n", "line 1: the covariance lacks rx_rx; give rx_rx ry_ry"),
        (
            "time_s x y z qx qy qz qw rx_rx ry_ry rz_rz x_x y_y z_z\n"
            "0 0 0 0 0 0 0 1 1 1 1 1 1 -1\n"
            + "1 0 0 0 0 0 0 1 1 1 1 1 1 1\n",
            "line 2: the covariance must have no negative eigenvalue; write variances",
        ),
    ],
)  # fmt: skip
def test_refuses_in_a_sentence_with_file_line_and_cure(tmp_path, text, sentence):
    with pytest.raises(InputError) as refused:
        read(tmp_path, text)
    assert str(refused.value).startswith(f"{tmp_path / 'robot.tum'}: {sentence}")


@pytest.fixture
def rig() -> Rig:
    """Two cameras that stand still, and two on a robot whose poses have covariances."""
    still = ring_of_cameras(4, np.random.default_rng(0))
    bTc = still.cameras[2].wTc
    wTb = np.tile(np.eye(4), (3, 1, 1))
    wTb[:, 0, 3] = [0, 0.1, 0.3]
    root = np.random.default_rng(1).normal(0, 0.01, (3, 6, 6))
    path = Trajectory("robot", np.array([0.0, 0.1, 0.2]), wTb, root @ root.mT, refined=True)
    moving = (replace(each, carrier="robot", bTc=bTc, wTc=bTc) for each in still.cameras[2:])
    return replace(still, cameras=(*still.cameras[:2], *moving), trajectories=(path,))


def test_a_rig_file_and_its_trajectories_come_back(tmp_path, rig):
    write_rig(rig, tmp_path / "rig.json")
    back = read_rig(tmp_path / "rig.json")
    assert [each.carrier for each in back.cameras] == ["", "", *["trajectories/robot.csv"] * 2]
    (was,), (now,) = rig.trajectories, back.trajectories
    assert now.refined and now.drift == was.drift
    np.testing.assert_allclose(now.wTb, was.wTb, atol=1e-12)
    assert now.covariance is not None and was.covariance is not None
    np.testing.assert_allclose(now.covariance, was.covariance, rtol=1e-12)
    time_s = np.full(4, 0.15)
    np.testing.assert_allclose(back.at(time_s).cTw, rig.at(time_s).cTw, atol=1e-12)
    as_tum = read_trajectory(tmp_path / "trajectories" / "robot.tum")
    np.testing.assert_allclose(as_tum.wTb, was.wTb, atol=1e-12)


def test_an_odometry_that_starts_at_zero_is_put_into_the_world(tmp_path, rig):
    write_rig(rig, tmp_path / "rig.json")
    content = json.loads((tmp_path / "rig.json").read_text())
    wTo = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 0], [0, 0, 0, 1]]
    content["trajectories"]["trajectories/robot.csv"]["wTo"] = wTo
    (tmp_path / "rig.json").write_text(json.dumps(content))
    moved = read_rig(tmp_path / "rig.json").trajectories[0]
    np.testing.assert_allclose(moved.wTb, np.array(wTo) @ rig.trajectories[0].wTb, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"trajectory": "../robot.tum"},
            "trajectory ../robot.tum must be in the folder of the rig file or below; move it",
        ),
        ({"trajectory": "nowhere.tum"}, "nowhere.tum: there is no such file"),
        (
            {"wTc": np.eye(4).tolist()},
            "give exactly one of wTc and cTw, or, of a moving camera, trajectory and bTc",
        ),
        (
            {"bTc": [[1, 2], [3, 4]]},
            "bTc must hold 16 numbers, got 4; write the 4x4 carrier-from-camera",
        ),
    ],
)
def test_refuses_a_rig_file_that_says_wrongly_how_a_camera_moves(tmp_path, rig, change, says):
    write_rig(rig, tmp_path / "rig.json")
    content = json.loads((tmp_path / "rig.json").read_text())
    content["cameras"][3] |= change
    (tmp_path / "rig.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"rig\.json|nowhere") as refused:
        read_rig(tmp_path / "rig.json")
    assert says in str(refused.value)


def test_a_trajectory_of_a_camera_of_any_calibration(tmp_path, rig):
    still = ring_of_cameras(2, np.random.default_rng(0))
    write_trajectory(rig.trajectories[0], tmp_path / "poses.tum")
    found = with_trajectories(still, [f"cam1={tmp_path / 'poses.tum'}"])
    assert [each.carrier for each in found.cameras] == ["", "cam1"]
    np.testing.assert_allclose(found.cameras[1].wTc, rig.trajectories[0].wTb[0], atol=1e-12)
    for given, says in (
        (
            ["cam9=a.tum"],
            "--trajectory cam9=a.tum: must name a camera and a file; write CAMERA=FILE with one of",
        ),
        (["cam1"], "must name a camera and a file"),
        (
            ["cam0=a.tum", "cam1=a.tum"],
            "the camera has a trajectory already, or the file is given for another camera, too; "
            "give the pose",
        ),
    ):
        with pytest.raises(InputError) as refused:
            with_trajectories(still, given)
        assert says in str(refused.value)
