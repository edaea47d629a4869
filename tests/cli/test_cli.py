"""The command line: what it prints, where it writes, and one sentence for everything that goes
wrong.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

import shapepose_fg.cli.reconstruct.run
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.cli.main import app, main
from shapepose_fg.core.errors import WorkLost
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.notes import Notes
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.parts import Part, Parts

K = [1000.0, 0, 500, 0, 1000, 400, 0, 0, 1]


@pytest.fixture
def recording(tmp_path: Path) -> list[str]:
    """Options for five empty frames of two cameras, with results going to `out`."""
    poses = {
        "left": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0],
        "right": [1, 0, 0, -1, 0, 1, 0, 0, 0, 0, 1, 0],
    }
    cameras = {name: {"K": K, "RT": RT, "imgSize": [1001, 801]} for name, RT in poses.items()}
    (tmp_path / "calibration.json").write_text(json.dumps(cameras))
    for name in cameras:
        (tmp_path / f"{name}.txt").write_text("4 5\n" + "0\n" * 125)
    options = {
        "--calibration": tmp_path / "calibration.json",
        "--detections": tmp_path,
        "--output": tmp_path / "out",
    }
    return ["reconstruct", *(str(word) for option in options.items() for word in option)]


@pytest.fixture
def pipeline(monkeypatch) -> dict:
    """Replace the pipeline by one that finds two people in every frame; returns what it was called
    with.
    """
    called: dict = {}

    def fake(kept, task, execution):
        called.update(vars(task), **vars(execution))
        rig, frames, times = task.rig, task.frames, task.times
        execution.progress(len(frames), len(frames))
        N = 2 * len(frames)
        frame, person = np.repeat(np.array(frames), 2), np.arange(N)
        J, V, names = (
            25,
            len(rig),
            {"joint_names": np.array(BODY_25.joints), "view_names": np.array(rig.names)},
        )
        nothing = {
            "xy": np.full((N, J, V, 2), np.nan),
            "residual_px": np.full((N, J, V, 2), np.nan),
        }
        nothing |= {"candidate": np.full((N, J, V), -1), "confidence": np.zeros((N, J, V))}
        rows = Reconstruction(
            frame=frame,
            person=person,
            joint_names=np.array(BODY_25.joints),
            joints=np.ones((N, 25, 3)),
            covariance=np.tile(4e-4 * np.eye(3), (N, 25, 1, 1)),
            confidence=np.ones((N, 25)),
            known=np.full((N, 25), Known.SEEN),
            betas=np.zeros((N, 10)),
            global_orient=np.zeros((N, 3)),
            body_pose=np.zeros((N, 23, 3)),
            transl=np.zeros((N, 3)),
            status=np.array([Status.OK, Status.TOO_FEW_VIEWS] * len(frames), dtype=str),
            observations=ObservationTable(
                frame=frame, person=person, gate=np.zeros((N, J, V), dtype=int), **names, **nothing
            ),
        )
        parts = Parts(kept)
        parts.append(Part(rows, Notes(len(frames))))
        run = {
            "frames": [frames.start, frames.stop],
            "time": (times or FrameTimes.assumed(5)).as_dict(),
            "seconds": {"load": 3.0, "vote": 0.005 * len(frames)},
        }
        return Assembly(parts, BODY_25.joints, rig.names, run=run)

    monkeypatch.setattr(shapepose_fg.cli.reconstruct.run, "reconstruct_parts", fake)
    monkeypatch.setattr("shapepose_fg.core.compiling._spent_s", 0.0)  # by tests that went before
    return called


def run(*arguments: str) -> int:
    """Exit code of a command line."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return caught.value.code


def test_reconstruct_writes_results_and_says_what_it_found(recording, pipeline, tmp_path, capsys):
    assert run(*recording) == 0
    people = Reconstruction.load(tmp_path / "out")
    assert len(people) == 10
    read = ("calibration.json", "left.txt", "right.txt")
    assert set(people.run["inputs"]) == {str(tmp_path / name) for name in read}
    left = hashlib.sha256((tmp_path / "left.txt").read_bytes()).hexdigest()
    assert people.run["inputs"][str(tmp_path / "left.txt")] == left
    printed = capsys.readouterr()
    # No progress bar where nobody watches; the files' frames are empty, and it is said.
    assert re.fullmatch(r"warning: No camera sees a person [^\n]+\n", printed.err)
    words = " ".join(printed.out.split())
    for part in (
        "5 (0:5) of 2 cameras, 30 Hz (assumed; reconstruct --fps sets it)",
        "without identities, 2.0 a frame (2 to 2)",
        "rows 10 in all",
        "5 ok",
        "5 too few views",
    ):
        assert part in words
    for part in (
        "100.0 % seen by two views; median sigma 20 mm",
        "5.0 ms a frame",
        "out/people.npz",
        "out/run.json",
    ):
        assert part.replace(" ", "") in words.replace(" ", "")


def test_options_reach_the_pipeline(recording, pipeline, tmp_path):
    (tmp_path / "settings.toml").write_text("batch_frames = 7\n")
    config = str(tmp_path / "settings.toml")
    assert run(*recording, "--frames", "1:4", "--up", "-y", "--unit", "mm", "--config", config) == 0
    assert pipeline["frames"] == range(1, 4)
    assert pipeline["rig"].up == "-y"
    assert pipeline["rig"].centres[1].tolist() == [0.001, 0, 0]
    assert pipeline["config"].batch_frames == 7
    assert pipeline["fitter"] is None
    assert config in Reconstruction.load(tmp_path / "out").run["inputs"]


@pytest.mark.slow
def test_times_cuts_and_time_itself_reach_the_pipeline(recording, pipeline, tmp_path):
    assert run(*recording) == 0
    assert pipeline["times"] is None and pipeline["cuts"] == () and pipeline["shapes"] is None
    assert pipeline["config"].temporal
    assert run(*recording, "--overwrite", "--fps", "25", "--cuts", "2,4", "--no-temporal") == 0
    np.testing.assert_allclose(pipeline["times"].frame_s, [0, 0.04, 0.08, 0.12, 0.16])
    assert pipeline["cuts"] == (2, 4) and not pipeline["config"].temporal
    assert run(*recording, "--overwrite", "--fps", "25", "--readout", "0.02") == 0
    assert [camera.readout_s for camera in pipeline["rig"].cameras] == [0.02, 0.02]
    stamps = tmp_path / "times.csv"
    stamps.write_text("right,left\n" + "".join(f"{0.05 * t},{0.05 * t + 0.01}\n" for t in range(5)))
    (tmp_path / "settings.toml").write_text("temporal = false\n")
    options = [
        "--timestamps",
        str(stamps),
        "--config",
        str(tmp_path / "settings.toml"),
        "--temporal",
    ]
    assert run(*recording, *options, "--overwrite") == 0
    np.testing.assert_allclose(
        pipeline["times"].time_s[:, 0], 0.05 * np.arange(5) + 0.01
    )  # left is first in the rig
    assert pipeline["config"].temporal
    assert str(stamps) in Reconstruction.load(tmp_path / "out").run["inputs"]


@pytest.mark.slow
def test_shapes_are_kept_from_one_recording_to_the_next(
    recording, pipeline, tmp_path, monkeypatch, capsys
):
    fake, file = (
        shapepose_fg.cli.reconstruct.run.reconstruct_parts,
        tmp_path / "kept" / "subjects.npz",
    )

    def with_shapes(kept, task, execution):
        result, shapes = fake(kept, task, execution), task.shapes
        found = SubjectShapes(np.array(["0"]), np.full((1, 10), 0.5), np.eye(10)[None], shapes.body)
        for n in range(len(result.parts)):
            result.keep_bodies(n, {name: result.parts.column(n, name) for name in BODY})
        return replace(result, shapes=found)

    monkeypatch.setattr(shapepose_fg.cli.reconstruct.run, "reconstruct_parts", with_shapes)
    assert run(*recording, "--shapes", str(file)) == 0
    assert len(pipeline["shapes"]) == 0
    assert "shapes of 1 people" in " ".join(capsys.readouterr().out.split())
    assert run(*recording, "--shapes", str(file), "--overwrite") == 0
    assert pipeline["shapes"].names.tolist() == ["0"]
    np.testing.assert_array_equal(pipeline["shapes"].betas, 0.5)
    assert str(file) in Reconstruction.load(tmp_path / "out").run["inputs"]


def test_other_formats_are_read_and_what_was_made_of_them_is_said(
    recording, pipeline, tmp_path, capsys
):
    """Cameras without a picture size, and COCO's results, whose scores are per cent."""
    cameras = {
        name: {
            "R": np.eye(3).tolist(),
            "T": [[1000.0 * x], [0.0], [0.0]],
            "k": [0.0] * 3,
            "p": [0.0] * 2,
        }
        | {"fx": 1000.0, "fy": 1000.0, "cx": 500.0, "cy": 400.0}
        for x, name in enumerate(("a", "b"))
    }
    (tmp_path / "calibration.json").write_text(json.dumps(cameras))
    (tmp_path / "pose").mkdir()
    for name in cameras:
        person = {"image_id": 0, "keypoints": [100.0, 200.0, 50.0] * 17}
        (tmp_path / "pose" / f"{name}.json").write_text(json.dumps([person]))
    options = [
        "--calibration",
        str(tmp_path / "calibration.json"),
        "--detections",
        str(tmp_path / "pose"),
    ]
    command = ["reconstruct", *options, "--output", str(tmp_path / "out")]
    assert run(*command) == 2
    assert "image_size is missing; pass --image-size WIDTHxHEIGHT" in capsys.readouterr().err
    assert run(*command, "--image-size", "wide") == 2
    assert "--image-size wide: must be WIDTHxHEIGHT" in capsys.readouterr().err
    assert run(*command, "--image-size", "1001x801", "--skeleton", "COCO_17") == 0
    assert pipeline["rig"].centres[1].tolist() == [1, 0, 0] and pipeline["rig"].up == "z"
    assert pipeline["detections"].skeleton.name == "COCO_17"
    notes = Reconstruction.load(tmp_path / "out").run["notes"]
    printed = capsys.readouterr().err
    assert len(notes) == 2 and all(f"note: {note}" in printed for note in notes)
    assert "scores reach 50" in notes[0] and "COCO_17 has no Neck and no MidHip" in notes[1]


@pytest.mark.slow
def test_what_detect_wrote_is_found_and_kept_with_the_result(recording, pipeline, tmp_path, capsys):
    """Times of 60 a second in microseconds are 60 a second; footage.json goes along, and away with
    the next.
    """
    (tmp_path / "times.csv").write_text(
        "frame, time_s\n" + "".join(f"{t}, {t / 60:.6f}\n" for t in range(5))
    )
    footage = {"format": "shapepose-fg footage 1", "cameras": []}
    (tmp_path / "footage.json").write_text(json.dumps(footage))
    assert run(*recording) == 0
    assert "5 (0:5) of 2 cameras, 60 Hz" in " ".join(capsys.readouterr().out.split())
    people = Reconstruction.load(tmp_path / "out")
    assert people.run["time"] == {
        "source": str(tmp_path / "times.csv"),
        "fps": 60.0,
        "per_camera": False,
    }
    assert json.loads((tmp_path / "out" / "footage.json").read_text()) == footage
    assert run(*recording, "--fps", "30", "--overwrite") == 0
    assert Reconstruction.load(tmp_path / "out").run["time"]["fps"] == 30.0
    (tmp_path / "footage.json").unlink()
    assert run(*recording, "--overwrite") == 0
    assert not (tmp_path / "out" / "footage.json").exists()


@pytest.mark.slow
def test_a_finished_result_stays_until_it_is_to_be_overwritten(
    recording, pipeline, tmp_path, capsys
):
    """And what was made of it is not taken for the new one's."""
    assert run(*recording, "--fps", "60") == 0
    before = (tmp_path / "out" / "people.npz").read_bytes()
    for options in ((), ("--resume",), ("--restart",)):
        capsys.readouterr()
        assert run(*recording, "--fps", "30", *options) == 2
        assert (
            f"{tmp_path / 'out'}: there is a finished result; give another"
            in capsys.readouterr().err
        )
    assert (tmp_path / "out" / "people.npz").read_bytes() == before
    for again in (1, 2):
        (tmp_path / "out" / "export").mkdir()
        (tmp_path / "out" / "export" / "joints.csv").write_text(f"of result {again}")
        assert run(*recording, "--fps", "30", "--overwrite") == 0
        assert (
            "belongs to the previous result; it was renamed to export-older"
            in capsys.readouterr().err
        )
    assert not (tmp_path / "out" / "export").exists()
    assert (tmp_path / "out" / "export-older" / "joints.csv").read_text() == "of result 1"
    assert (tmp_path / "out" / "export-older2" / "joints.csv").read_text() == "of result 2"


@pytest.mark.slow
def test_warnings_are_warnings_unless_they_are_to_be_strict(recording, pipeline, capsys):
    assert run(*recording) == 0
    assert "warning: No camera sees a person" in capsys.readouterr().err
    assert run(*recording, "--strict", "--overwrite") == 1
    assert run(*recording, "--strict", "--overwrite", "--no-check") == 0


def test_who_is_lost_says_so_in_one_line_with_the_cause(
    recording, pipeline, tmp_path, capsys, monkeypatch
):
    """Five frames in which both cameras see four people, and of which two come out, some
    dropped.
    """
    joint = "4 0.1 0.3 0.5 0.7 0.5 0.5 0.5 0.5 1 1 1 1\n"
    frame = joint * 25 + ("0 " * 16 + "\n") * len(BODY_25.limbs)
    for name in ("left", "right"):
        (tmp_path / f"{name}.txt").write_text("4 5\n" + frame * 5)
    fake = shapepose_fg.cli.reconstruct.run.reconstruct_parts

    def dropping(*arguments):
        found, why = fake(*arguments), "there too briefly"
        return found.with_run(people={"dropped": {why: 2}}, dropped_frames={why: [[3, 5]]})

    monkeypatch.setattr(shapepose_fg.cli.reconstruct.run, "reconstruct_parts", dropping)
    assert run(*recording, "--fps", "25", "--no-check") == 0
    assert (
        "lost 2 rows dropped: there too briefly (frames 3-4); two cameras see 4.0 people per "
        "frame, but 2.0 are found: 0.2 s are too short to confirm all people; give more frames, "
        "or --no-temporal"
    ) in " ".join(capsys.readouterr().out.split())


def test_one_camera_is_no_recording(recording, pipeline, tmp_path, capsys):
    cameras = json.loads((tmp_path / "calibration.json").read_text())
    (tmp_path / "calibration.json").write_text(json.dumps({"left": cameras["left"]}))
    assert run(*recording) == 2
    assert "at least 2 cameras are needed, got 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "frames"),
    [(":2", range(2)), ("3:", range(3, 5)), (":", range(5)), ("4:5", range(4, 5))],
)
def test_frames_are_half_open(recording, pipeline, text, frames):
    assert run(*recording, "--frames", text) == 0
    assert pipeline["frames"] == frames


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ["--frames", "2:9"],
            "--frames 2:9: not in the recording, which has 5 frames; give A:B with 0 <= A < B <= 5",
        ),
        (["--frames", "3:3"], "--frames 3:3: not in the recording, which has 5 frames"),
        (["--frames", "-2:"], "--frames -2:: must be A:B with two frame numbers, such as 0:100"),
        (["--frames", "all"], "--frames all: must be A:B"),
        (["--fps", "0"], "--fps 0: must be at least 0.001"),
        (["--readout", "20"], "--readout 20: must be 0 to 0.1 seconds, such as 0.02"),
        (["--fps", "nan"], "--fps nan: must"),
        (
            ["--cuts", "3,2"],
            "--cuts 3,2: must be increasing frame numbers between 1 and 4, such as 300,600",
        ),
        (["--cuts", "5"], "--cuts 5: must be increasing frame numbers between 1 and 4"),
        (["--cuts", "a"], "--cuts a: must be increasing frame numbers"),
        (["--timestamps", "/nothing.txt"], "/nothing.txt: there is no such file; check the path"),
        (
            ["--timestamps", __file__, "--fps", "25"],
            "--fps and --timestamps: both determine the times of frames",
        ),
        (["--shapes", "s.npz", "--no-temporal"], "--shapes: shapes need people over time"),
        (["--shapes", __file__], "cannot be read as an .npz file without pickled objects"),
        (["--up", "up"], "'--up': 'up' is not one of 'x', '-x', 'y', '-y', 'z', '-z'"),
        (["--unit", "inch"], "'--unit': 'inch' is not one of 'm', 'cm', 'mm'"),
        (["--config", "/nothing.toml"], "/nothing.toml: there is no such file; check the path"),
        (["--body", "/nothing.npz"], "/nothing.npz: there is no such file"),
        (
            ["--calibration", "/nothing.json"],
            "/nothing.json: there is no such file; check the path",
        ),
        (["--detections", "/nothing"], "/nothing: there is no such folder; check the path"),
        (
            ["--output", f"{__file__}/out"],
            "out: results cannot be written here (Not a directory); give a writable folder",
        ),
        (["--loud"], "No such option: --loud"),
    ],
)
def test_errors_are_one_sentence_and_exit_code_2(recording, pipeline, capsys, options, sentence):
    assert run(*recording, *options) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert sentence in printed.err
    assert printed.err.count("\n") == 1
    assert "people" not in pipeline  # nothing was reconstructed in vain


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["reconstruct"],
            "--calibration, --detections and --output: missing; give them, or --project",
        ),
        (["rebuild"], "No such command 'rebuild'"),
        (
            ["evaluate", "x", "--ground-truth", "y"],
            "No such option: --ground-truth",
        ),
        (["evaluate", "/nothing", "--truth", "/gt.txt"], "/gt.txt: there is no such file"),
    ],
)
def test_wrong_command_lines(capsys, arguments, sentence):
    assert run(*arguments) == 2
    assert sentence in capsys.readouterr().err


def test_a_disk_that_is_full_is_one_sentence_too(recording, pipeline, monkeypatch, capsys):
    def full(stream, columns):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shapepose_fg.core.result_files, "write_npz", full)
    assert run(*recording) == 2
    out = Path(recording[recording.index("--output") + 1])
    assert f"{out}/people.npz: No space left on device; " in capsys.readouterr().err
    # What was done is kept, and nothing is left half written.
    assert [path.name for path in out.iterdir()] == ["parts"]


def test_inputs_that_go_while_it_runs_do_no_harm(recording, pipeline, tmp_path, monkeypatch):
    fake = shapepose_fg.cli.reconstruct.run.reconstruct_parts
    left = hashlib.sha256((tmp_path / "left.txt").read_bytes()).hexdigest()

    def vanishing(*arguments, **options):
        (tmp_path / "left.txt").unlink()
        (tmp_path / "right.txt").write_text("something else")
        return fake(*arguments, **options)

    monkeypatch.setattr(shapepose_fg.cli.reconstruct.run, "reconstruct_parts", vanishing)
    assert run(*recording) == 0
    assert Reconstruction.load(tmp_path / "out").run["inputs"][str(tmp_path / "left.txt")] == left


def test_help_names_the_commands(capsys):
    for arguments in ([], ["--help"]):
        assert run(*arguments) == 0
        printed = capsys.readouterr().out
        assert all(command in printed for command in ("reconstruct", "evaluate", "demo", "config"))


def test_config_prints_every_table_with_units(capsys):
    assert run("config") == 0
    printed = capsys.readouterr().out
    assert "[people]" in printed
    assert "gate_m = " in printed


def test_paragraphs_of_the_help_have_no_line_ends_of_their_own():
    """A terminal of 80 columns would break their lines twice."""
    commands = getattr(typer.main.get_command(app), "commands", {})
    broken = [name for name, each in commands.items() if re.search(r"\S\n[^\s-]", each.help)]
    assert len(commands) > 10 and broken == []


def test_help_groups_the_options(capsys):
    """The same words for the same things, under the same headings."""
    for command, groups in (
        ("reconstruct", ("Input", "Time", "Result", "Run")),
        ("overlay", ("Input", "Drawing", "Time", "Result")),
        ("detect", ("Input", "Network", "Time", "Result")),
    ):
        assert run(command, "--help") == 0
        printed = capsys.readouterr().out
        assert all(f"─ {group} ─" in printed for group in groups)
    assert run("--help") == 0
    printed = capsys.readouterr().out
    assert all(
        words in printed
        for words in ("Reconstruct a recording", "Use a result", "Try and evaluate")
    )


@pytest.fixture
def short_scene(monkeypatch):
    """The demo on five frames of its scene."""
    from shapepose_fg.simulation import built_in_scene

    monkeypatch.setattr("shapepose_fg.simulation.built_in_scene", lambda: built_in_scene(frames=5))


def test_demo_compares_with_the_truth_and_leaves_a_report(
    short_scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert run("demo") == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    lines = [line.split() for line in printed.out.splitlines() if line.strip()]
    share = {" ".join(words[:-1]): words[-1] for words in lines}
    # What is asked of the whole scene holds of its first frames too.
    assert all(float(share[name]) == 100 for name in ("PCP, %", "MOTA, %", "IDF1, %"))
    assert float(share["MPJPE, mm"]) <= 30 and float(share["recall, %"]) >= 98
    assert 80 < float(share["in 95 % region, %"]) <= 100
    assert len(Reconstruction.load("demo")) == 20
    assert (tmp_path / "demo" / "report.html").is_file()


def test_a_report_is_left_or_taken_away(recording, pipeline, capsys):
    page = Path(recording[recording.index("--output") + 1]) / "report.html"
    assert run(*recording) == 0
    assert "open it in a browser" in capsys.readouterr().out
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert run(*recording, "--no-report", "--overwrite") == 0
    assert not page.exists() and "open it in" not in capsys.readouterr().out


def test_the_scene_is_what_the_demo_says_it_is():
    from shapepose_fg.cli.demo import SCENE
    from shapepose_fg.simulation import built_in_scene

    scene = built_in_scene()
    assert (
        f"{scene.people} people in close motion, {len(scene.rig)} cameras, {len(scene)} frames"
        in SCENE
    )


def test_train_fitter_without_torch_names_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert run("train-fitter", "--body", tmp_path / "SMPL_NEUTRAL.pkl") == 2
    said = capsys.readouterr().err
    assert said == 'error: torch is not installed; pip install "shapepose-fg[train]"\n'


def test_version_is_a_command_and_an_option(capsys):
    said = []
    for word in ("version", "--version"):
        assert run(word) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] and "shapepose-fg " in said[0]


@pytest.mark.slow
def test_a_reader_that_stops_reading_is_no_error():
    """`shapepose-fg version | head -n 0`: no traceback, no sentence."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "shapepose_fg.cli.main", "version"]
    result = subprocess.run(
        command, check=False, timeout=60, stdout=writer, stderr=subprocess.PIPE, text=True
    )
    os.close(writer)
    assert result.stderr == ""
    assert result.returncode == 1


@pytest.mark.parametrize(
    ("command", "files", "said"),
    [
        ("calibrate", {"--output": "."}, "--output .: this is a folder; give the name of a file"),
        ("calibrate", {"--output": "a.json", "--report": "./a.json"}, "this is one file; give two"),
        ("synchronise", {"--output": "."}, "--output .: this is a folder"),
        ("refine-calibration", {"--output": "a.json", "--report": "a.json"}, "give two"),
    ],
)
def test_output_files_are_checked_before_the_work(
    recording, tmp_path, monkeypatch, capsys, command, files, said
):
    monkeypatch.chdir(tmp_path)
    given = ["--calibration", "calibration.json", "--detections", ".", "--fps", "25"]
    monkeypatch.setattr(
        "shapepose_fg.io.recording.read_recording", lambda *_, **__: pytest.fail("it is read")
    )
    assert run(command, *given, *(word for option in files.items() for word in option)) == 2
    assert said in capsys.readouterr().err


def test_a_reader_that_stops_before_the_summary_is_no_error(recording, monkeypatch, capsys):
    """And a full disk below the standard output is none of the results."""
    errors = [BrokenPipeError(32, "Broken pipe"), OSError(28, "No space left on device")]
    for error, code in zip(errors, (1, 2), strict=True):

        def refuse(_: object, error: OSError = error) -> None:
            raise error

        monkeypatch.setattr("shapepose_fg.cli.reconstruct.run.show", refuse)
        assert run(*recording, "--frames", "0:2", "--no-temporal", "--overwrite") == code
    said = capsys.readouterr().err
    assert "Broken pipe" not in said
    assert re.search(r"error: No space left on device; the results in \S+ are complete", said)


def test_settings_are_looked_at_before_the_recording(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "shapepose_fg.cli.reconstruct.run.read_recording", lambda *_: pytest.fail("it is read")
    )
    (tmp_path / "typo.toml").write_text("batch_frame = 3\n")
    for words, said in (
        (("--config", str(tmp_path / "typo.toml")), "typo.toml: batch_frame"),
        (
            ("--shapes", str(tmp_path / "s.npz"), "--no-temporal"),
            "--shapes: shapes need people over time",
        ),
        (("--chunk-frames", "20"), "--chunk-frames 20: must be 128"),
    ):
        assert run(*recording, *words) == 2
        assert said in capsys.readouterr().err


def test_processes_are_this_machine_s_or_the_cluster_s(recording, pipeline, capsys):
    assert run(*recording, "--workers", "2", "--cluster", "tcp://host:8786") == 2
    assert (
        "--workers and --cluster tcp://host:8786: processes are either of this"
        in capsys.readouterr().err
    )
    assert run(*recording, "--workers", "2", "--cluster", "local") == 0
    assert (pipeline["workers"], pipeline["cluster"]) == (2, "local")


@pytest.mark.slow
def test_chunks_and_a_cluster_reach_the_pipeline(recording, pipeline, capsys):
    assert run(*recording, "--chunk-frames", "200", "--cluster", "tcp://host:8786") == 0
    assert (pipeline["chunk_frames"], pipeline["cluster"]) == (200, "tcp://host:8786")
    capsys.readouterr()
    assert run(*recording, "--chunk-frames", "20", "--overwrite") == 2
    assert "--chunk-frames 20: must be 128" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (WorkLost("a worker process was killed"), "a worker process was killed"),
        (MemoryError(), "too little memory"),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"),
            "too little memory",
        ),
        (OSError(28, "No space left on device", "/x/y"), "/x/y: No space left on device"),
    ],
)
def test_what_the_system_does_to_a_run_is_one_sentence_with_the_way_on(
    recording, monkeypatch, capsys, error, words
):
    def killed(*_: object) -> None:
        raise error

    monkeypatch.setattr(shapepose_fg.cli.reconstruct.run, "reconstruct_parts", killed)
    with pytest.raises(SystemExit) as ended:
        main(recording)
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1
    assert (
        words in said and "0 of 5 frames are stored in" in said and "continue with --resume" in said
    )


@pytest.mark.parametrize("name", ["parts", ".detections", ".lock"])
def test_a_link_in_the_folder_of_results_is_not_followed(
    recording, pipeline, tmp_path, capsys, name
):
    other = tmp_path / "other"
    for folder in (other, tmp_path / "out"):
        folder.mkdir()
    (tmp_path / "out" / name).symlink_to(other)
    with pytest.raises(SystemExit) as ended:
        main(recording)
    said = capsys.readouterr().err
    assert (
        ended.value.code == 2
        and f"{name}: this" in said
        and "link" in said
        and said.count("error") == 1
    )
    assert list(other.iterdir()) == []


def test_an_export_follows_no_link_either(tmp_path, capsys):
    (tmp_path / "results").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "results" / "export").symlink_to(tmp_path / "other")
    with pytest.raises(SystemExit) as ended:
        main(["export", str(tmp_path / "results"), "csv"])
    assert ended.value.code == 2 and "export: this link" in capsys.readouterr().err


@pytest.fixture
def three(recording, tmp_path) -> list[str]:
    """The same of three cameras, of which the last has no detections."""
    file = tmp_path / "calibration.json"
    cameras = json.loads(file.read_text())
    cameras["behind"] = {
        "K": K,
        "RT": [1, 0, 0, -2, 0, 1, 0, 0, 0, 0, 1, 0],
        "imgSize": [1001, 801],
    }
    file.write_text(json.dumps(cameras))
    return recording


@pytest.mark.slow
@pytest.mark.parametrize("choice", [["--without", "behind"], ["--cameras", "right, left"]])
def test_some_of_the_cameras(three, pipeline, tmp_path, choice):
    """Whoever films with fewer cameras than were calibrated says which; a run that goes on has the
    same ones.
    """
    assert run(*three, *choice, "--no-check") == 0
    assert pipeline["rig"].names == ("left", "right")
    assert [
        each["name"] for each in json.loads((tmp_path / "out/cameras.json").read_text())["cameras"]
    ] == [
        "left",
        "right",
    ]


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ([], 'the detections of camera "behind" are missing'),
        (["--without", "behnid"], "there is no camera 'behnid'; there are left right behind"),
        (["--cameras", "left"], "at least 2 cameras are needed"),
        (["--cameras", ""], "no camera is selected"),
    ],
)
def test_cameras_that_cannot_be_chosen(three, capsys, choice, sentence):
    with pytest.raises(SystemExit) as ended:
        main([*three, *choice])
    assert ended.value.code == 2 and sentence in capsys.readouterr().err.replace("\n", " ")
