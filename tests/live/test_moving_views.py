"""Cameras on a robot, whose poses come with what they see."""

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import covariance_calibration, match_people
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.detections.lines import read_view_line
from shapepose_fg.live.online import OnlineReconstructor
from tests.live.conftest import rows
from tests.pipeline.test_moving_cameras import FPS, TIMES, scene

FRAMES = 16
SIGMAS = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])
ERROR = SIGMAS * [1.2, -0.8, 0.5, 1.0, -1.5, 0.6]
"""Of all poses alike: rad and m."""


@pytest.fixture(scope="module")
def made():
    return scene()


def play(made, live, frames=range(FRAMES), error=None, covariance=None):
    """Push all views of some frames, the robot's poses with an `error`; what was said of now, and
    what settled.
    """
    now, settled = [], []
    wrong = gtsam.Pose3.Expmap(np.zeros(6) if error is None else error).matrix()
    for frame in frames:
        time_s = float(TIMES.time_s[frame])
        for view, camera in enumerate(made.rig.cameras):
            own = made.recording[frame].only(made.recording[frame].view == view)
            there = (made.true.at(np.array(time_s)) @ wrong, covariance) if camera.carrier else ()
            live.push_view(camera.name, own, time_s, *there)
        now.append(live.people())
        settled.append(live.settled())
    return rows(now), rows([*settled, live.finish()])


def found(made, people):
    """Mean error of rows, m, and how many of their joints are inside 95 % regions."""
    frame = np.round(people.time_s * FPS).astype(int)
    at = match_people(frame, people.joints, made.people[:FRAMES])
    assert len(at.missed) == len(at.invented) == len(at.duplicated) == 0
    off = people.joints[at.row] - made.people[at.frame, at.person]
    return np.linalg.norm(off, axis=-1).mean(), covariance_calibration(
        off, people.covariance[at.row]
    ).coverage[0.95]


@pytest.mark.slow
def test_poses_that_are_exact_and_poses_that_err_as_they_say(made, start):
    for people in play(made, start(made.rig)):
        error_m, _ = found(made, people)
        assert error_m < 0.02  # 3 px at 3 to 4 m, four views
    # Two of four cameras stand 5 cm and a degree from where they say: joints are 4 cm off, in one
    # direction.
    for people in play(made, start(made.rig), error=ERROR, covariance=np.diag(SIGMAS**2)):
        error_m, inside = found(made, people)
        assert error_m > 0.03 and inside > 0.9
    for people in play(made, start(made.rig), error=ERROR):
        assert found(made, people)[1] < 0.5


@pytest.mark.slow
def test_a_camera_that_carries_itself_goes_on_after_a_restart(made, start, tmp_path):
    still = [replace(each, carrier="", bTc=np.eye(4)) for each in made.rig.cameras]
    rig = replace(made.rig, cameras=tuple(still), trajectories=())
    live = start(rig)

    def push(one, frame):
        time_s = float(TIMES.time_s[frame])
        for view, camera in enumerate(made.rig.cameras):
            own = made.recording[frame].only(made.recording[frame].view == view)
            pose = made.true.at(np.array(time_s)) @ camera.bTc if camera.carrier else None
            one.push_view(camera.name, own, time_s, pose)

    for frame in range(8):
        push(live, frame)
    live.save(tmp_path / "state.npz")
    with OnlineReconstructor.load(tmp_path / "state.npz", rig, workers=1) as other:
        for frame in range(8, FRAMES):
            push(live, frame)
            push(other, frame)
        now = other.people()
        assert np.array_equal(live.people().joints, now.joints)
    apart = np.linalg.norm(now.joints[:, None] - made.people[FRAMES - 1], axis=-1).mean(axis=-1)
    assert (apart.min(axis=1) < 0.02).all()


@pytest.mark.slow
def test_a_robot_s_log_says_where_its_cameras_go(made, tmp_path):
    """Detections, odometry and mounts as ROS 2 messages; the calibration knows the robot's lenses
    only.
    """
    pytest.importorskip("mcap_ros2", reason='needs pip install "shapepose-fg[ros]"')
    from tests.io.test_ros_poses import header, odometry, transform, write

    robot = [camera for camera in made.rig.cameras if camera.carrier]
    still = [replace(each, carrier="", bTc=np.eye(4), wTc=np.eye(4)) for each in robot]
    write_rig(
        replace(made.rig, cameras=(*made.rig.cameras[:2], *still), trajectories=()),
        tmp_path / "rig.json",
    )
    mounts = [(each.name, gtsam.Pose3(each.bTc)) for each in robot]
    messages = [
        ("/tf_static", 0.0, transform("base", f"{name}_optical", 0.0, bTc)) for name, bTc in mounts
    ]
    for time_s in np.arange(0.0, FRAMES / FPS + 0.1, 0.02).tolist():
        pose = gtsam.Pose3(made.true.at(np.array(time_s)))
        messages.append(("/odom", time_s, odometry(time_s, pose, np.eye(6) * 1e-6)))
    rng = np.random.default_rng(0)
    for frame in range(FRAMES):
        time_s = float(TIMES.time_s[frame])
        rig = made.with_path(made.true.wTb).at(np.full(4, time_s))
        xy, _ = rig.project(made.people[frame])
        for view, camera in enumerate(rig.cameras):
            noisy = xy[view] + rng.normal(0, 3, xy[view].shape)
            flat = np.concatenate([noisy, np.full((*noisy.shape[:2], 1), 0.9)], axis=-1).reshape(
                2, -1
            )
            people = [{"pose_keypoints_2d": each} for each in flat.tolist()]
            seen = {
                "header": header(f"{camera.name}_optical", time_s),
                "camera": camera.name,
                "people": people,
            }
            messages.append(("/detections", time_s + 0.015, seen))
    write(tmp_path / "robot.mcap", sorted(messages, key=lambda each: each[1]))
    with pytest.raises(SystemExit) as ended:
        given = [
            "--calibration",
            tmp_path / "rig.json",
            "--detections",
            tmp_path / "robot.mcap",
            "--workers",
            "1",
        ]
        main(["live", *map(str, given), "--output", str(tmp_path / "people.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "people.jsonl").read_text().splitlines()]
    settled = [each for each in told if each["kind"] == "settled"]
    assert len(settled) == FRAMES
    for each in settled[4:]:
        frame, off = round(each["time_s"] * FPS), []
        for person in each["people"]:
            joints = np.array([joint or [np.nan] * 3 for joint in person["joints"]], dtype=float)
            off.append(
                np.nanmean(np.linalg.norm(joints - made.people[frame], axis=-1), axis=1).min()
            )
        # 3 px from four views at 3 to 4 m; the robot moves by 1 m, and its cameras are 0.6 m apart.
        assert len(off) == 2 and max(off) < 0.015  # 3 px from four views at 3 to 4 m


def test_misuse_is_refused(made, start):
    live, seen = start(made.rig), made.recording[0]
    own = seen.only(seen.view == 2)
    with pytest.raises(ValueError, match=r"pose must be \(4, 4\)"):
        live.push_view("cam2", own, 0.0, np.eye(3))
    with pytest.raises(ValueError, match="rotations must be orthonormal"):
        live.push_view("cam2", own, 0.0, 2 * np.eye(4))
    with pytest.raises(ValueError, match="camera cam2 moves; give a pose with its view at 99 s"):
        live.push_view("cam2", own, 99.0)


def test_a_line_may_have_a_pose(made):
    pose = str(np.eye(4).tolist())
    line = f'{{"camera": "cam2", "time_s": 1.5, "people": [], "pose": {pose}}}'
    camera, seen, time_s, read, surely = read_view_line(line, "line 1", made.rig, BODY_25)
    assert (camera, len(seen), time_s, surely) == ("cam2", 0, 1.5, None) and np.array_equal(
        read, np.eye(4)
    )
    for wrong in ("[[1, 2]]", str((2 * np.eye(4)).tolist())):
        with pytest.raises(InputError, match=r"line 1.*(pose|orthonormal).*moving camera"):
            read_view_line(line.replace(pose, wrong), "line 1", made.rig, BODY_25)
