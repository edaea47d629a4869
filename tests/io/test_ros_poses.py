"""Trajectories and moving cameras from MCAP files of ROS 2 messages, written by the library of
MCAP.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.calibration import with_trajectories
from shapepose_fg.io.ros.definitions import definition
from shapepose_fg.io.ros.mcap_files import read_views
from shapepose_fg.io.ros.messages import Message, header
from shapepose_fg.io.ros.poses import Frames
from shapepose_fg.io.trajectories import read_trajectory
from shapepose_fg.simulation.scene import ring_of_cameras

pytest.importorskip("mcap_ros2", reason='needs pip install "shapepose-fg[ros]"')
from mcap_ros2.writer import Writer

APART = "=" * 80 + "\n"
POSE = definition("geometry_msgs/Pose")
ODOMETRY = (
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    f"{APART}MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] "
    f"covariance\n{APART}MSG: geometry_msgs/Pose\n{POSE}{APART}MSG: "
    f"std_msgs/Header\n{definition('std_msgs/Header')}"
)
ALONE = (
    f"std_msgs/Header header\ngeometry_msgs/Pose pose\n{APART}MSG: geometry_msgs/Pose\n{POSE}"
    f"{APART}MSG: std_msgs/Header\n{definition('std_msgs/Header')}"
)
KINDS = {
    "/tf": ("tf2_msgs/msg/TFMessage", definition("tf2_msgs/TFMessage")),
    "/tf_static": ("tf2_msgs/msg/TFMessage", definition("tf2_msgs/TFMessage")),
    "/odom": ("nav_msgs/msg/Odometry", ODOMETRY),
    "/slam": ("geometry_msgs/msg/PoseStamped", ALONE),
    "/detections": ("shapepose_msgs/msg/Detections", definition("shapepose_msgs/Detections")),
}


def write(path, messages: list[tuple[str, float, Message]]):
    """An MCAP file of messages: topic, seconds of the log, content."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        schemas = {topic: writer.register_msgdef(*kind) for topic, kind in KINDS.items()}
        for topic, time_s, message in messages:
            writer.write_message(topic, schemas[topic], message, log_time=round(time_s * 1e9))
        writer.finish()
    return path


def parts(pose: gtsam.Pose3) -> tuple[Message, Message]:
    q = pose.rotation().toQuaternion()
    return dict(zip("xyz", pose.translation(), strict=True)), {
        "x": q.x(),
        "y": q.y(),
        "z": q.z(),
        "w": q.w(),
    }


def transform(parent: str, child: str, time_s: float, pose: gtsam.Pose3) -> Message:
    way, turn = parts(pose)
    return {
        "transforms": [
            {
                "header": header(parent, time_s),
                "child_frame_id": child,
                "transform": {"translation": way, "rotation": turn},
            }
        ]
    }


def odometry(time_s: float, pose: gtsam.Pose3, covariance: np.ndarray) -> Message:
    way, turn = parts(pose)
    told = {
        "pose": {"position": way, "orientation": turn},
        "covariance": covariance.ravel().tolist(),
    }
    return {"header": header("odom", time_s), "child_frame_id": "base", "pose": told}


TIMES = np.arange(11) / 10
MAP = [gtsam.Pose3(gtsam.Rot3.Rz(0.5), np.array([1.0, 2.0, 0.1 * t])) for t in TIMES]
ODOM = [gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2 + 0.3 * t), np.array([t, 0.5, 0.0])) for t in TIMES]
MOUNT = gtsam.Pose3(gtsam.Rot3.Rx(-2.0), np.array([0.2, 0.0, 1.2]))


@pytest.fixture
def robot(tmp_path):
    """SLAM corrects an odometry, and a camera is fixed to the base."""
    messages = [("/tf_static", 0.0, transform("base", "eye", 0.0, MOUNT))]
    for t, a, b in zip(TIMES.tolist(), MAP, ODOM, strict=True):
        messages += [
            ("/tf", t, transform("map", "odom", t, a)),
            ("/tf", t, transform("odom", "/base", t, b)),
        ]
    return write(tmp_path / "robot.mcap", messages)


def test_a_trajectory_is_put_together_along_the_frames(robot):
    base, eye = read_trajectory(robot), read_trajectory(f"{robot}#eye", "robot")
    assert base.name.endswith("robot.mcap") and eye.name == "robot" and eye.covariance is None
    np.testing.assert_allclose(base.time_s, TIMES)
    for n, (a, b) in enumerate(zip(MAP, ODOM, strict=True)):
        np.testing.assert_allclose(base.wTb[n], (a * b).matrix(), atol=1e-12)
        np.testing.assert_allclose(eye.wTb[n], (a * b * MOUNT).matrix(), atol=1e-12)
    rig = with_trajectories(ring_of_cameras(3, np.random.default_rng(0)), [f"cam1={robot}#base"])
    np.testing.assert_allclose(
        rig.at(np.full(3, 0.5)).cameras[1].wTc, (MAP[5] * ODOM[5]).matrix(), atol=1e-9
    )


def test_ros_covariances_are_of_the_parents_axes(tmp_path):
    """Errors of way, and of turn, along the parent's axes are drawn; the frame's own spread as is
    read.
    """
    root = np.random.default_rng(0).normal(0, 0.01, (6, 6))
    parents = root @ root.T
    file = write(
        tmp_path / "odom.mcap", [("/odom", t, odometry(t, ODOM[0], parents)) for t in (0.0, 0.1)]
    )
    found = read_trajectory(file)
    assert found.covariance is not None
    drawn = np.random.default_rng(1).multivariate_normal(
        np.zeros(6), parents, 20_000, method="cholesky"
    )
    R, t = ODOM[0].rotation(), ODOM[0].translation()
    errors = [
        gtsam.Pose3.Logmap(ODOM[0].between(gtsam.Pose3(gtsam.Rot3.Expmap(e[3:]) * R, t + e[:3])))
        for e in drawn
    ]
    # The entries of a covariance of 20,000 draws are right to 1 % of the largest; other axes are
    # 100 % off.
    np.testing.assert_allclose(
        found.covariance[1], np.cov(np.array(errors).T), atol=0.03 * parents.max()
    )


def test_the_errors_of_a_chain_add_up_as_in_gtsam(tmp_path):
    parents = np.diag([1e-4, 4e-4, 1e-4, 1e-4, 1e-4, 9e-4])
    messages = [("/tf_static", 0.0, transform("base", "eye", 0.0, MOUNT))]
    file = write(
        tmp_path / "odom.mcap",
        [
            *messages,
            *[
                ("/odom", t, odometry(t, each, parents))
                for t, each in zip(TIMES, ODOM, strict=True)
            ],
        ],
    )
    base, eye = read_trajectory(f"{file}#base"), read_trajectory(f"{file}#eye")
    assert base.covariance is not None and eye.covariance is not None
    Ad = MOUNT.inverse().AdjointMap()
    np.testing.assert_allclose(eye.covariance[3], Ad @ base.covariance[3] @ Ad.T, rtol=1e-9)


def test_odometry_is_taken_for_transforms_of_its_frame_and_a_pose_has_its_topics_name(tmp_path):
    told, sure = ODOM[3], np.eye(6) * 1e-4
    way, turn = parts(MAP[0])
    messages = []
    for t in (0.0, 0.1):
        messages += [
            ("/tf", t, transform("odom", "base", t, MAP[2])),
            ("/odom", t, odometry(t, told, sure)),
            (
                "/slam",
                t,
                {"header": header("map", t), "pose": {"position": way, "orientation": turn}},
            ),
        ]
    file = write(tmp_path / "robot.mcap", messages)
    base, slam = read_trajectory(f"{file}#base"), read_trajectory(f"{file}#/slam")
    np.testing.assert_allclose(base.wTb[0], told.matrix(), atol=1e-12)
    np.testing.assert_allclose(slam.wTb[1], MAP[0].matrix(), atol=1e-12)
    assert base.covariance is not None and slam.covariance is None


def test_refused_in_a_sentence(tmp_path, robot):
    messages = [
        ("/tf", t, transform("map", each, t, MOUNT)) for t in (0.0, 0.1) for each in ("base", "arm")
    ]
    two = write(tmp_path / "two.mcap", messages)
    bent = transform("map", "base", 0.0, MOUNT)
    bent["transforms"][0]["transform"]["rotation"]["w"] = 3.0
    cases = (
        (two, f"{two}: the moving frames in it are arm base; choose one with two.mcap#FRAME"),
        (f"{robot}#hand", "the moving frames in it are base; choose one with robot.mcap#FRAME"),
        (
            write(tmp_path / "none.mcap", []),
            "the moving frames in it are none; choose one with none.mcap#FRAME",
        ),
        (
            write(tmp_path / "bent.mcap", [("/tf", 0.0, bent)]),
            "topic /tf, frame base: a pose must be finite",
        ),
        (
            write(tmp_path / "once.mcap", messages[:1]),
            "frame base: 2 poses are needed, with base known at the same time; record more",
        ),
    )
    for path, says in cases:
        with pytest.raises(InputError) as refused:
            read_trajectory(path)
        assert says in str(refused.value), refused.value


def test_views_come_with_the_pose_of_their_moment(tmp_path):
    """A camera on the base, one that stands still, and one whose carrier is not in the file."""
    still = ring_of_cameras(3, np.random.default_rng(0))
    lift = Trajectory("lift.tum", np.array([0.0, 9.0]), np.tile(np.eye(4), (2, 1, 1)))
    lifted = replace(still.cameras[2], carrier="lift.tum")
    rig = replace(still, cameras=(*still.cameras[:2], lifted), trajectories=(lift,))
    flat = np.concatenate([np.full((25, 2), 300.0), np.full((25, 1), 0.8)], axis=1).ravel().tolist()
    sure, messages = np.eye(6) * 1e-4, [("/tf_static", 0.0, transform("base", "eye", 0.0, MOUNT))]
    for t, b in zip(TIMES.tolist(), ODOM, strict=True):
        messages.append(("/odom", t, odometry(t, b, sure)))
        for camera, frame in (("cam0", "/eye"), ("cam1", "wall"), ("cam2", "eye")):
            seen = {
                "header": header(frame, t + 0.05),
                "camera": camera,
                "people": [{"pose_keypoints_2d": flat}],
            }
            messages.append(("/detections", t + 0.06, seen))
    told: list[str] = []
    views = list(read_views(write(tmp_path / "seen.mcap", messages), rig, BODY_25, told.append))
    assert [each[0] for each in views[:4]] == ["cam0", "cam1", "cam0", "cam1"]
    moving, fixed = ([each for each in views if each[0] == name] for name in ("cam0", "cam1"))
    assert len(fixed) == 11 and all(each[3] is None for each in fixed)
    # The last picture is after the last pose.
    assert len(moving) == 10 and len(views) == 21
    assert [each.partition(": ")[2] for each in sorted(told)] == [
        "1 pictures of cam0 are left out: frame eye has no pose within 0.5 s",
        "11 pictures of cam2 are left out: frame lift_tum has no pose within 0.5 s",
    ]
    for n, (_, seen, time_s, pose, covariance) in enumerate(moving):
        between = (
            ODOM[n]
            * gtsam.Pose3.Expmap(0.5 * gtsam.Pose3.Logmap(ODOM[n].between(ODOM[n + 1])))
            * MOUNT
        )
        assert time_s == pytest.approx(TIMES[n] + 0.05) and len(seen) == 25
        # Turn and way are interpolated apart: a metre a second at 0.3 rad a second bends 0.4 mm in
        # 0.1 s.
        assert pose is not None and covariance is not None
        np.testing.assert_allclose(pose, between.matrix(), atol=1e-3)
        assert np.linalg.eigvalsh(covariance)[0] > 0


def test_a_damaged_file_is_refused_in_one_sentence(robot):
    whole, rng, refused = robot.read_bytes(), np.random.default_rng(0), 0
    for _ in range(60):
        spoiled = bytearray(whole)
        for place in rng.integers(0, len(spoiled), 5).tolist():
            spoiled[place] = rng.integers(0, 256)
        robot.write_bytes(bytes(spoiled))
        try:
            assert np.isfinite(read_trajectory(robot).wTb).all()
        except InputError as error:
            refused += 1
            assert "robot.mcap" in str(error)
    assert refused > 30


def test_very_many_poses_at_one_time_of_the_log_are_gone_through_once(tmp_path, monkeypatch):
    """Each look at a waiting picture goes through all poses of its frame."""
    rig = ring_of_cameras(2, np.random.default_rng(0))
    flat = np.concatenate([np.full((25, 2), 300.0), np.full((25, 1), 0.8)], axis=1).ravel().tolist()
    seen = {
        "header": header("base", 0.9),
        "camera": "cam0",
        "people": [{"pose_keypoints_2d": flat}],
    }
    poses = [("/tf", 0.0, transform("map", "base", n / 1000, MOUNT)) for n in range(1000)]
    file = write(tmp_path / "seen.mcap", [("/detections", 0.0, seen), *poses])
    asked = list[str]()
    at = Frames.at
    monkeypatch.setattr(
        Frames, "at", lambda self, frame, time_s: asked.append(frame) or at(self, frame, time_s)
    )
    (view,) = read_views(file, rig, BODY_25, print)
    assert view[3] is not None and len(asked) < 10
