"""`detect` from the command line: what it says of people's folders and options, and real
recordings.
"""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.output_folder import only_run_in
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork, layouts
from shapepose_fg.detection2d.onnx_network import OnnxNetwork
from shapepose_fg.io.calibration import read_rig, write_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.lenses import lenses_of
from shapepose_fg.io.timestamps import read_timestamps
from shapepose_fg.simulation.scene import ring_of_cameras


@pytest.fixture
def kitchen(tmp_path, monkeypatch) -> Path:
    """calibration.json of three cameras, and a network that sees a right wrist at every white
    spot.
    """
    monkeypatch.chdir(tmp_path)
    rig = ring_of_cameras(3, np.random.default_rng(0))
    write_rig(rig, tmp_path / "calibration.json")
    Path("network.onnx").write_bytes(b"")

    def see(blob: np.ndarray) -> np.ndarray:
        height, width = blob.shape[2] // 8, blob.shape[3] // 8
        light = blob[0].min(axis=0).reshape(height, 8, width, 8).mean(axis=(1, 3)) / 255
        output = np.zeros((1, 57, height, width), dtype=np.float32)
        output[0, 4] = cv2.GaussianBlur(light.astype(np.float32), (0, 0), 1.0)
        return output

    opened = OnnxNetwork(Path("network.onnx"), "0" * 64, lambda blob: [see(blob)])
    network = HeatMapNetwork(opened, layouts()["tf-pose"])
    monkeypatch.setattr(HeatMapNetwork, "load", lambda *_, **__: network)
    return tmp_path


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["detect", *map(str, words)])
    return int(end.value.code or 0)


COMMON = ("--calibration", "calibration.json", "--network", "network.onnx", "--output", "out")


def picture(rig, name: str, frame: int, size: tuple[int, int]) -> np.ndarray:
    """Black, with a white spot where the point that frame's number has come to is seen."""
    camera = rig.cameras[rig.names.index(name)]
    xy = camera.distort(camera.project(np.array([[0.02 * frame, 0.0, 1.0]]))[0])[0]
    full = np.zeros((camera.image_size[1], camera.image_size[0], 3), dtype=np.uint8)
    cv2.circle(full, tuple(np.round(xy).astype(int).tolist()), 30, (255, 255, 255), -1)
    return np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA))


def film(path: Path, rig, name: str, frames: range, fps: float) -> None:
    size = tuple(side // 2 for side in rig.cameras[0].image_size)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for frame in frames:
        writer.write(picture(rig, name, frame, size))
    writer.release()


@pytest.mark.slow
def test_half_size_videos_at_two_rates_one_of_which_starts_late(kitchen, capsys):
    """Cameras at 50, 25 and 50 a second, the third 4 frames late: its point is where the others' is
    then.
    """
    rig = read_rig("calibration.json")
    a, b, c = rig.names
    Path("videos").mkdir()
    film(Path("videos") / f"{a}.avi", rig, a, range(0, 20), 50)
    film(Path("videos") / f"{b}.avi", rig, b, range(0, 20, 2), 25)
    film(Path("videos") / f"{c}.avi", rig, c, range(4, 20), 50)
    assert run(*COMMON, "--videos", "videos", "--start", f"{c}=4f") == 0
    said = capsys.readouterr()
    told = " ".join(said.err.split())
    assert told.count("of the same aspect ratio: they are assumed to be resized") == 3
    assert (
        f"camera {a}: frames without a picture of every camera are left out, 4 at the start" in told
    )
    (command,) = re.findall("next: (.*)", said.out)
    assert command == (
        f"shapepose-fg reconstruct --calibration {kitchen}/calibration.json --detections "
        f"{kitchen}/out --output {kitchen}/results"
    )
    table = read_detections("out", rig)
    assert len(table) == 8 and table.skeleton.name == "COCO_18"
    times, _ = read_timestamps("out/times.csv", rig, 8)
    np.testing.assert_allclose(times.frame_s, np.arange(8) / 25, atol=1e-6)
    for t in range(8):
        expected, _ = rig.project(np.array([0.02 * (4 + 2 * t), 0.0, 1.0]))
        assert table[t].view.tolist() == [0, 1, 2]
        # Half-size pictures and cells of 8: a quarter of a cell.
        np.testing.assert_allclose(table[t].xy, expected, atol=5)


@pytest.mark.slow
def test_files_of_unequal_length_are_detected_whole_where_nobody_says_when_they_began(
    kitchen, capsys
):
    """Two are shorter than the time between their starts: no moment would be left of what they
    share.
    """
    rig, lengths = read_rig("calibration.json"), (12, 5, 8)
    Path("videos").mkdir()
    for name, length in zip(rig.names, lengths, strict=True):
        film(Path("videos") / f"{name}.avi", rig, name, range(20 - length, 20), 25)
    assert run(*COMMON, "--videos", "videos") == 0
    said = capsys.readouterr()
    assert "left out" not in said.err and "5 to 12 frames" in " ".join(said.err.split())
    table = read_detections("out", rig)
    for view, length in enumerate(lengths):
        assert [(frame.view == view).sum() for frame in table] == [1] * length + [0] * (12 - length)
    (line,) = re.findall("next: (.*)", said.out)
    with pytest.raises(SystemExit) as end:
        main(shlex.split(line)[1:])
    assert end.value.code == 0, "it is typed as it is printed"


def test_folders_of_pictures_need_no_rate(kitchen, capsys):
    rig = read_rig("calibration.json")
    for name in rig.names:
        (Path("shots") / name).mkdir(parents=True)
        for frame in range(100, 104):
            cv2.imwrite(
                f"shots/{name}/img_{frame}.png", picture(rig, name, 0, rig.cameras[0].image_size)
            )
    Path(f"shots/{rig.names[1]}/img_102.png").unlink()
    assert run(*COMMON, "--images", "shots") == 0
    said = capsys.readouterr()
    assert (
        "1 of 4 pictures are missing" in said.err
        and "are read as frames without people" in " ".join(said.err.split())
    )
    assert "--timestamps" not in said.out and not Path("out/times.csv").exists()
    table = read_detections("out", rig)
    assert [frame.view.tolist() for frame in table] == [[0, 1, 2], [0, 1, 2], [0, 2], [0, 1, 2]]
    assert run(*COMMON, "--images", "shots") == 2
    assert "there are detections already" in capsys.readouterr().err


@pytest.mark.slow
def test_a_project_is_detected_in_and_goes_on_as_a_project(kitchen, capsys, monkeypatch):
    """Cameras, videos and places come from it; the next line is the project's, quoted, from any
    folder.
    """
    rig, project = read_rig("calibration.json"), kitchen / "my walk"
    (project / "calibration").mkdir(parents=True)
    (kitchen / "calibration.json").rename(project / "calibration" / "rig.json")
    (project / "Config.toml").write_text("[project]\nframe_rate = 'auto'\n")
    (project / "videos").mkdir()
    for name in rig.names:
        film(project / "videos" / f"{name}.avi", rig, name, range(6), 50)
    assert run("--project", "my walk", "--network", "network.onnx") == 0
    (command,) = re.findall("next: (.*)", capsys.readouterr().out)
    assert shlex.split(command) == ["shapepose-fg", "reconstruct", "--project", str(project)]
    assert {each.name for each in (project / "pose").iterdir()} >= {"times.csv", "footage.json"}
    monkeypatch.chdir("/")
    with pytest.raises(SystemExit) as end:
        main(shlex.split(command)[1:])
    assert end.value.code == 0
    told = json.loads((project / "shapepose-fg" / "run.json").read_text())
    assert told["time"]["fps"] == 50.0 and told["project"] == "my walk"
    assert "<title>my walk" in (project / "shapepose-fg" / "report.html").read_text(
        encoding="utf-8"
    )
    assert (project / "shapepose-fg" / "footage.json").is_file()


def test_one_camera_is_enough_to_detect(kitchen):
    rig = read_rig("calibration.json")
    write_rig(replace(rig, cameras=rig.cameras[:1]), kitchen / "calibration.json")
    film(kitchen / f"{rig.names[0]}.avi", rig, rig.names[0], range(3), 50)
    assert run(*COMMON, "--videos", f"{rig.names[0]}={rig.names[0]}.avi") == 0
    assert (kitchen / "out" / f"{rig.names[0]}.txt").is_file()


@pytest.mark.parametrize("words, problem", [
    (["--videos", "none"], "none: there is no such folder"),
    (["--videos", "shots", "--fps", "fast"], "--fps fast: must be a frame rate in Hz"),
    (["--videos", "shots", "--fps", "kitchen=5"], "no camera 'kitchen'"),
    (["--videos", "shots", "--start", "0.2s"], "--start 0.2s: must be CAMERA=VALUE"),
    (["--videos", "shots", "--start", "{a}=2"],
     "--start 2: must be seconds, such as 0.2s, or frames"),
    (["--videos", "shots", "--start", "{a}=2s"], "the frame rate is unknown; give --fps"),
    (["--videos", "shots", "--start", "{a}=2f", "--start", "{a}=3f"], "is given twice"),
    (["--videos", "shots", "--start", "{a}=50f"], "have no time in common; check --start"),
    (["--videos", "shots", "--image-placement", "bent"],
     "must be one of same crop crop-centre scale letterbox"),
    (["--videos", "shots", "--image-placement", "same"],
     "1280 x 720; give another --image-placement"),
    (["--videos", "shots"], "give --image-placement: letterbox"),
    (["--videos", "shots", "--image-placement", "scale", "--frames", "7:9"], "which has 1 frames"),
    (["--videos", "shots", "--long-side", "7"], "--long-side 7: must be at least 128"),
    (["--videos", "shots", "--backend", "abacus"],
     "'abacus' is not one of 'opencv', 'onnxruntime'"),
    (["--videos", "shots", "--network", "clever"], "no network of this name"),
    (["--videos", "shots", "--download", "clever"],
     "--download clever: there is no network of this name; give one of rtmpose-s"),
])  # fmt: skip
def test_what_cannot_be_detected_in_is_said_before_any_work(kitchen, capsys, words, problem):
    rig = read_rig("calibration.json")
    Path("shots").mkdir()
    for name in rig.names:
        cv2.imwrite(f"shots/{name}.png", np.zeros((50, 100, 3), np.uint8))
    words = [word.format(a=rig.names[0]) for word in words]
    if {"--fps", "--start"} & set(words):
        words += ["--image-placement", "scale"]
    assert run(*COMMON, *words) == 2
    assert problem in " ".join(capsys.readouterr().err.split())
    assert not Path("out").exists() or list(Path("out").iterdir()) == []


def test_a_second_run_into_the_same_folder_is_refused(kitchen, capsys):
    Path("shots").mkdir()
    for name in read_rig("calibration.json").names:
        cv2.imwrite(f"shots/{name}.png", np.zeros((720, 1280, 3), np.uint8))
    with only_run_in(Path("out"), ()):
        assert run(*COMMON, "--videos", "shots") == 2
    assert "out: another run writes its results here" in capsys.readouterr().err
    assert run(*COMMON, "--videos", "shots") == 0


@pytest.fixture(scope="session")
def network(shared_data) -> Path:
    file = shared_data.parent / "models" / "openpose_mobilenet_v2_small.onnx"
    if not file.is_file():
        pytest.skip(f"no network at {file}")
    return file


def command(*words: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(list(map(str, words)))
    return int(end.value.code or 0)


@pytest.mark.slow
def test_a_man_is_found_in_real_videos_of_rolled_cameras(shared_data, network, tmp_path, capsys):
    """Pose2Sim's demo as it lies, four frames: the man in each, with his head above his feet."""
    data = shared_data / "pose2sim_single"
    calibration, found, results = data / "Calib.qca.txt", tmp_path / "found", tmp_path / "results"
    words = (
        "--calibration",
        calibration,
        "--videos",
        data,
        "--network",
        network,
        "--output",
        found,
    )
    assert run(*words, "--frames", "10:14") == 0
    said = " ".join((told := capsys.readouterr()).err.split())
    for name in ("cam01", "cam02"):
        assert (
            f"camera {name}: the pictures have 1080 x 1920 pixels, but the calibration is for 1088"
            in said
        )
    assert "-14°" in told.out and "26°" in told.out
    words = (
        "--calibration",
        calibration,
        "--detections",
        found,
        "--timestamps",
        found / "times.csv",
    )
    assert command("reconstruct", *words, "--output", results) == 0
    people = Reconstruction.load(results)
    # The bystander is over 1.5 m from the middle of the cameras.
    away = np.nanmean(people.joints, axis=1)[:, :2] - read_rig(calibration).centres.mean(axis=0)[:2]
    man = people.rows(np.linalg.norm(away, axis=1) < 1.5)
    assert man.frame.tolist() == list(range(4))
    names = man.joint_names.tolist()
    nose, right, left = (
        man.joints[:, names.index(name), 2] for name in ("Nose", "RAnkle", "LAnkle")
    )
    # An adult who leans forward on a treadmill.
    assert ((nose - np.minimum(right, left) > 1.1) & (nose - np.minimum(right, left) < 1.8)).all()


@pytest.mark.slow
def test_four_people_around_a_pizza(shared_data, network, tmp_path):
    """CMU Panoptic's demo: five letterboxed pictures of one moment. At least three of four, and
    nobody else.
    """
    data = shared_data / "panoptic_pizza"
    camera = ("--calibration", data / "calibration.json", "--image-size", "1920x1080")
    found, results = tmp_path / "found", tmp_path / "results"
    words = (*camera, "--images", data, "--network", network, "--output", found)
    assert run(*words, "--image-placement", "letterbox") == 0
    assert command("reconstruct", *camera, "--detections", found, "--output", results) == 0
    people = Reconstruction.load(results)
    hips = people.joints[:, people.joint_names.tolist().index("MidHip")]
    assert 3 <= len(people) <= 4
    # They stand around a table of a metre, on one floor, apart.
    apart = np.linalg.norm(hips[:, None] - hips[None], axis=2)[np.triu_indices(len(hips), 1)]
    assert np.ptp(hips[:, 2]) < 0.2 and apart.min() > 0.4


def test_without_a_calibration_cameras_are_called_as_their_videos(kitchen, capsys):
    """Pixels are the pictures' own, and the next command is the one that finds where cameras
    stand.
    """
    rig = read_rig("calibration.json")
    Path("videos").mkdir()
    for name in rig.names:
        film(Path("videos") / f"phone {name}.avi", rig, name, range(6), 25)
    assert run("--videos", "videos", "--network", "network.onnx", "--output", "out") == 0
    said = capsys.readouterr()
    (command,) = re.findall("next: (.*)", said.out)
    words = shlex.split(command)
    assert (
        words[:2] == ["shapepose-fg", "calibrate"]
        and words[words.index("--field-of-view") + 1] == "65"
    )
    assert {
        "--focal",
        f"{kitchen}/out",
        f"{kitchen}/times.csv",
        f"{kitchen}/calibration.json",
    } <= set(words)
    seen = lenses_of(Path("out"), ["65"], None)
    assert list(seen.names) == [f"phone {name}" for name in rig.names]
    assert {camera.image_size for camera in seen.cameras} == {(640, 360)}
    table = read_detections("out", seen)
    for view, camera in enumerate(rig.cameras):
        whole, _ = camera.project(np.array([[0.02 * t, 0.0, 1.0] for t in range(6)]))
        found = np.array([table[t].xy[table[t].view == view][0] for t in range(6)])
        np.testing.assert_allclose(found, (whole + 0.5) / 2 - 0.5, atol=3)
    Path("nothing").mkdir()
    assert run("--videos", "nothing", "--network", "network.onnx", "--output", "other") == 2
    assert "there are no videos or pictures" in " ".join(capsys.readouterr().err.split())
