"""A Pose2Sim project as it lies, and TRC and C3D where its next steps look for them."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.cli.reconstruct.request import Request, prepare
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.export.markers import write_pose2sim_files
from shapepose_fg.io.pose2sim_project import read_pose2sim_project

CONFIG = """
[project]
project_dir = '.'
multi_person = {multi}
frame_rate = {rate}
frame_range = {frames}

[pose]
pose_model = 'Body_with_feet'
"""


def write_config(folder, multi="false", rate="50", frames="'auto'"):
    (folder / "Config.toml").write_text(CONFIG.format(multi=multi, rate=rate, frames=frames))


@pytest.fixture
def project(tmp_path, five_cameras):
    """A project with cameras, and files of frames 3 to 6 of each, without people."""
    folder = tmp_path / "Walk"
    (folder / "calibration").mkdir(parents=True)
    write_rig(five_cameras, folder / "calibration" / "rig.json")
    for name in five_cameras.names:
        place = folder / "pose" / f"{name}_json"
        place.mkdir(parents=True)
        for number in range(3, 7):
            (place / f"{name}_{number:06d}.json").write_text(
                json.dumps({"version": 1.3, "people": []})
            )
    write_config(folder)
    return folder


def refusal(folder):
    with pytest.raises(InputError) as raised:
        read_pose2sim_project(folder)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_project_is_read_as_it_lies(project):
    found = read_pose2sim_project(project)
    assert found.calibration.name == "rig.json" and found.detections == project / "pose"
    assert (found.fps, found.first_number, found.frames, found.multi_person) == (
        50.0,
        3,
        None,
        False,
    )
    assert found.span(4) == range(4)
    assert found.name_of(None, 3, 6) == "Walk_3-6" and found.name_of(1, 3, 6) == "Walk_P1_3-6"


def test_the_project_s_own_numbers_choose_frames(project):
    write_config(project, frames="[4, 6]")
    assert read_pose2sim_project(project).span(4) == range(1, 3)
    write_config(project, frames="[5, 400]")
    assert read_pose2sim_project(project).span(4) == range(2, 4)
    write_config(project, frames="[40, 60]")
    with pytest.raises(
        InputError, match=r"frame_range is \[40, 60\], but the detections have frames 3 to 6"
    ):
        read_pose2sim_project(project).span(4)


def test_detections_brought_into_step_come_first(project):
    shutil.copytree(project / "pose", project / "pose-sync")
    shutil.copytree(project / "pose", project / "pose-associated")
    assert read_pose2sim_project(project).detections.name == "pose-sync"
    shutil.rmtree(project / "pose-sync")
    assert read_pose2sim_project(project).detections.name == "pose"
    shutil.rmtree(project / "pose")
    assert read_pose2sim_project(project).detections.name == "pose-associated"


def test_a_trial_takes_cameras_and_settings_of_its_session(project):
    session = project.parent
    shutil.move(project / "calibration", session / "calibration")
    write_config(session, multi="true", rate="120")
    (project / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    found = read_pose2sim_project(project)
    assert found.calibration.parent == session.resolve() / "calibration"
    assert (found.fps, found.multi_person) == (60.0, True)
    assert "give one of them: Walk" in refusal(session)


def test_a_toml_of_cameras_comes_before_other_formats(project, shared_data):
    room = project / "calibration"
    shutil.copy(shared_data / "pose2sim_single" / "Calib.qca.txt", room)
    shutil.copy(shared_data / "formats" / "pose2sim_Calib.toml", room / "Calib_qualisys.toml")
    (room / "notes.toml").write_text("[about]\nby = 'us'\n")
    assert read_pose2sim_project(project).calibration.name == "Calib_qualisys.toml"


def test_the_rate_is_the_video_s_where_the_project_says_auto(project):
    import cv2

    write_config(project, rate="'auto'")
    assert read_pose2sim_project(project).fps == 30.0
    (project / "videos").mkdir()
    video = cv2.VideoWriter(
        str(project / "videos" / "cam0.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 24, (64, 48)
    )
    for _ in range(3):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    assert read_pose2sim_project(project).fps == 24.0
    (project / "pose" / "times.csv").write_text("time_s\n0\n0.1\n0.2\n0.3\n")
    found = read_pose2sim_project(project)
    assert found.fps is None
    known = prepare(Request(project=project), None, notify=print)
    assert known.request.fps is None and known.request.timestamps == project / "pose" / "times.csv"


def test_what_is_missing_is_named_with_the_cure(project):
    shutil.rmtree(project / "pose")
    assert "neither 2D detections (pose-sync pose pose-associated) nor videos" in refusal(project)
    (project / "videos").mkdir()
    (project / "videos" / "cam0.mp4").write_bytes(b"")
    said = refusal(project)
    assert f"shapepose-fg detect --project {project} --network NETWORK" in said
    (project / "calibration" / "rig.json").unlink()
    assert "no calibration in a known format; it contains nothing" in refusal(project)
    (project / "calibration").rmdir()
    assert "there is no calibration folder" in refusal(project)
    (project / "Config.toml").unlink()
    assert "Config.toml: there is no such file" in refusal(project)
    assert "there is no such folder" in refusal(project / "elsewhere")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": "'fast'"}, "frame_rate must be a frame rate in Hz or 'auto', got 'fast'"),
        ({"rate": "true"}, "frame_rate must be"),
        ({"rate": "100000.5"}, "frame_rate must be"),
        ({"rate": "0.009"}, "frame_rate must be"),
        ({"frames": "[9, 3]"}, "frame_range must be 'auto', 'all', or two frame numbers"),
        ({"multi": "'yes'"}, "multi_person must be true or false"),
        ({"multi": "="}, "cannot be read as TOML"),
    ],
)
def test_a_malformed_config_is_named(project, change, words):
    write_config(project, **change)
    assert words in refusal(project)


@pytest.fixture
def two_tracks(two_people):
    """Person 4 in frames 0 to 3, person 9, whom no view sees, in frames 1 to 3 but for 2."""
    frames, persons = np.array([0, 1, 1, 2, 3, 3]), np.array([4, 4, 9, 4, 4, 9])
    joints = np.where((persons == 4)[:, None, None], two_people[0], two_people[1])
    count = len(frames)
    return Reconstruction(
        frame=frames,
        person=persons,
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=np.broadcast_to(1e-4 * np.eye(3), (count, 25, 3, 3)).copy(),
        confidence=np.full((count, 25), 0.8),
        betas=np.full((count, 10), np.nan),
        global_orient=np.full((count, 3), np.nan),
        body_pose=np.full((count, 23, 3), np.nan),
        transl=np.full((count, 3), np.nan),
        status=np.full(count, "body undetermined"),
        time_s=frames / 50.0,
        known=np.where((persons == 4)[:, None], Known.SEEN, Known.BODY)
        .repeat(25, axis=1)
        .astype(np.uint8),
        run={"frames": [0, 4], "time": {"fps": 50.0}},
    )


def rows_of(path):
    """Header of a TRC file, and its numbers."""
    lines = path.read_text().splitlines()
    return lines[:5], np.array([[float(word) for word in line.split("\t")] for line in lines[5:]])


def test_trc_and_c3d_are_where_the_next_steps_look(project, two_tracks, two_people):
    ezc3d = pytest.importorskip("ezc3d")
    written = write_pose2sim_files(two_tracks, "z", read_pose2sim_project(project))
    # One person, who is seen most; frames 0 to 3 are the project's 3 to 6.
    assert [each.name for each in written.files] == ["Walk_3-6.trc", "Walk_3-6.c3d"]
    assert {each.parent for each in written.files} == {project / "pose-3d"} and written.notes == []
    header, rows = rows_of(project / "pose-3d" / "Walk_3-6.trc")
    assert header[0].endswith("Walk_3-6.trc") and "CHip" in header[3].split("\t")
    np.testing.assert_allclose(rows[:, 0], [3, 4, 5, 6])
    np.testing.assert_allclose(rows[:, 1], [0.06, 0.08, 0.10, 0.12], atol=1e-6)
    # Pose2Sim turns z up into y up so: x, y, z become y, z, x.
    np.testing.assert_allclose(rows[0, 2:].reshape(25, 3), two_people[0][:, [1, 2, 0]], atol=1e-6)
    c3d = ezc3d.c3d(str(project / "pose-3d" / "Walk_3-6.c3d"))
    assert c3d["header"]["points"]["frame_rate"] == 50
    np.testing.assert_allclose(
        c3d["data"]["points"][:3, :, 0].T, 1e3 * two_people[0][:, [1, 2, 0]], atol=1e-2
    )


def test_everybody_has_files_where_the_project_is_of_several(project, two_tracks):
    write_config(project, multi="true")
    (project / "pose-3d").mkdir()
    (project / "pose-3d" / "Walk_0-9.trc").write_text("old")
    written = write_pose2sim_files(two_tracks, "z", read_pose2sim_project(project))
    names = [each.name for each in written.files if each.suffix == ".trc"]
    assert names == ["Walk_P0_3-6.trc", "Walk_P1_4-6.trc"]
    assert any("leaves out 1 frames" in each for each in written.notes)
    assert any("also has Walk_0-9.trc of an earlier run" in each for each in written.notes)
    assert (project / "pose-3d" / "Walk_0-9.trc").read_text() == "old"


def test_times_that_c3d_cannot_have_are_a_note(project, two_tracks):
    """The run that is over by then must end well: the TRC is there, and what is missing is said."""
    late = replace(two_tracks, time_s=np.where(two_tracks.frame == 3, 1e9, two_tracks.time_s))
    written = write_pose2sim_files(late, "z", read_pose2sim_project(project))
    assert [each.name for each in written.files] == ["Walk_3-6.trc"]
    assert len(written.notes) == 1 and written.notes[0].startswith(
        "C3D is not written: people.npz: the times cover"
    )
    back = replace(two_tracks, time_s=-two_tracks.time_s)
    written = write_pose2sim_files(back, "z", read_pose2sim_project(project))
    assert written.files == [] and written.notes[0].startswith(
        "TRC and C3D are not written: time_s does not increase"
    )


def test_c3d_of_high_frame_numbers(project, two_tracks):
    ezc3d = pytest.importorskip("ezc3d")
    late = replace(two_tracks, frame=two_tracks.frame + 70_000, run={"time": {"fps": 50.0}})
    written = write_pose2sim_files(late, "z", read_pose2sim_project(project))
    file = ezc3d.c3d(str(project / "pose-3d" / "Walk_70003-70006.c3d"))
    assert file["header"]["points"]["first_frame"] == 0
    assert "numbers its frames from 1, not 70004" in written.notes[0]


def test_nobody_is_a_note(project):
    written = write_pose2sim_files(
        Reconstruction.empty(BODY_25.joints), "z", read_pose2sim_project(project)
    )
    assert written.files == [] and "the result has no people" in written.notes[0]


@pytest.mark.slow
def test_reconstruct_takes_a_project(shared_data, tmp_path, capsys):
    """Pose2Sim's demo recording, laid out as Pose2Sim does it, its frames numbered from 5."""
    source, folder = shared_data / "pose2sim_single", tmp_path / "Demo"
    (folder / "calibration").mkdir(parents=True)
    shutil.copy(source / "Calib.qca.txt", folder / "calibration")
    write_config(folder, rate="60", frames="[8, 20]")
    for camera in ("cam01", "cam02", "cam03", "cam04"):
        place = folder / "pose" / f"{camera}_json"
        place.mkdir(parents=True)
        for number, file in enumerate(sorted((source / "openpose" / camera).glob("*.json"))[:20]):
            shutil.copy(file, place / f"{camera}_{number + 5:06d}.json")
    with pytest.raises(SystemExit) as ended:
        main(["reconstruct", "--project", str(folder), "--workers", "1"])
    said = capsys.readouterr()
    assert ended.value.code == 0, said.err
    _, rows = rows_of(folder / "pose-3d" / "Demo_8-19.trc")
    assert rows[0, 0] == 8 and rows[-1, 0] == 19
    # The man stands: his nose is 1 m and more above his ankles, y up.
    header, _ = rows_of(folder / "pose-3d" / "Demo_8-19.trc")
    names = [name for name in header[3].split("\t")[2:] if name]
    xyz = rows[:, 2:].reshape(len(rows), -1, 3)
    assert (xyz[:, names.index("Nose"), 1] - xyz[:, names.index("RAnkle"), 1] > 1).all()
    assert json.loads((folder / "shapepose-fg" / "run.json").read_text())["frames"] == [3, 15]
