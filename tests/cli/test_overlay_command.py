"""`overlay` from the command line, over pictures that are made here."""

import json
import resource
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.footage.placement import (
    CameraFootage,
    Placement,
    PlacementKind,
    write_used_footage,
)
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.viz.overlay import drawing

FRAMES = 3


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    """results/ of three frames of two people, and half-size videos of grey that gets lighter, one a
    frame late.
    """
    folder = tmp_path_factory.mktemp("overlay")
    scene = built_in_scene(frames=FRAMES, people=2)
    people = reconstruct(simulate(scene), scene.rig, times=FrameTimes.from_fps(scene.fps, FRAMES))
    (folder / "detections").mkdir()
    people.with_run(inputs={str(folder / "detections" / "any.txt"): "0"}).save(folder / "results")
    write_rig(scene.rig, folder / "results" / "cameras.json")
    (folder / "videos").mkdir()
    used = []
    for v, camera in enumerate(scene.rig.cameras):
        size = camera.image_size[0] // 2, camera.image_size[1] // 2
        path = folder / "videos" / f"{camera.name}.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, size)
        for frame in range(FRAMES + 1):
            writer.write(np.full((size[1], size[0], 3), 40 + 40 * frame, dtype=np.uint8))
        writer.release()
        placement = Placement(PlacementKind.SCALE, size, camera.image_size)
        places = np.arange(FRAMES) + (v == 0)
        used.append(CameraFootage(camera.name, path, placement, places))
    write_used_footage(folder / "detections" / "footage.json", used, {})
    return folder


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["overlay", *map(str, words)])
    return int(end.value.code or 0)


def frames_of(path: Path) -> list[np.ndarray]:
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return frames


def test_a_grid_of_all_cameras_that_plays(solved, tmp_path, capsys):
    """Pictures are found by what detect wrote: that of the first camera is a frame late, and so
    drawn lighter.
    """
    assert run(solved / "results", "--output", tmp_path, "--width", 960) == 0
    assert capsys.readouterr().out == f"written  {tmp_path / 'grid.mp4'}\n"
    frames = frames_of(tmp_path / "grid.mp4")
    assert len(frames) == FRAMES
    assert frames[0].shape[1] == 960
    assert [path.name for path in tmp_path.iterdir()] == ["grid.mp4"]
    corner = [
        int(np.median(frame[-12:, :60])) for frame in frames
    ]  # of the last row's first camera
    np.testing.assert_allclose(corner, [40, 80, 120], atol=8)
    first = [int(np.median(frame[40:52, :20])) for frame in frames]
    np.testing.assert_allclose(first, [80, 120, 160], atol=8)


def test_two_runs_may_write_the_same_video(solved, tmp_path, monkeypatch):
    """The one that ends last stays."""
    write, runs = drawing.draw_label, list[int]()

    def second_run(*arguments: object, **options: object) -> object:
        if not runs:
            runs.append(-1)
            runs.append(run(solved / "results", "--output", tmp_path, "--width", 640))
        return write(*arguments, **options)

    monkeypatch.setattr(drawing, "draw_label", second_run)
    assert run(solved / "results", "--output", tmp_path, "--width", 960) == 0 and runs == [-1, 0]
    assert [path.name for path in tmp_path.iterdir()] == ["grid.mp4"]
    assert frames_of(tmp_path / "grid.mp4")[0].shape[1] == 960


def test_a_video_that_does_not_fit_on_the_disk_is_an_error(solved, tmp_path, capfd):
    """OpenCV itself says nothing; a limit on file sizes stands for the full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        assert run(solved / "results", "--output", tmp_path, "--width", 960) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    wanted = f"error: {tmp_path / 'grid.mp4'}: the video could not be written to its end; check"
    assert wanted in " ".join(capfd.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_stills_of_each_camera_show_people_where_they_are(solved, tmp_path):
    people = Reconstruction.load(solved / "results")
    names = [
        camera["name"]
        for camera in json.loads((solved / "results/cameras.json").read_text())["cameras"]
    ]
    assert (
        run(
            solved / "results",
            "--output",
            tmp_path,
            "--each",
            "--stills",
            "0,2",
            "--cameras",
            ",".join(names[:2]),
        )
        == 0
    )
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == sorted(f"{name}_{frame:06d}.jpg" for name in names[:2] for frame in (0, 2))
    scene = built_in_scene(frames=FRAMES, people=2)
    picture = cv2.imread(str(tmp_path / f"{names[1]}_000002.jpg"))
    assert picture.shape[1::-1] == tuple(side // 2 for side in scene.rig.cameras[1].image_size)
    xy, _ = scene.rig.cameras[1].project(people.at(2).joints[:, 8])
    for x, y in np.round((xy + 0.5) / 2 - 0.5).astype(int):
        patch = picture[y - 4 : y + 5, x - 4 : x + 5].reshape(-1, 3).astype(int)
        assert np.ptp(patch, axis=1).max() > 40  # colour, where the picture is grey


@pytest.mark.slow
def test_bodies_and_videos_that_are_given(solved, tmp_path, capsys):
    rest = [
        "--output",
        tmp_path,
        "--stills",
        "1",
        "--width",
        "640",
        "--no-skeletons",
        "--no-points",
    ]
    assert run(solved / "results", "--bodies", *rest) == 0
    with_bodies = cv2.imread(str(tmp_path / "grid_000001.jpg"))
    assert run(solved / "results", *rest) == 0
    without = cv2.imread(str(tmp_path / "grid_000001.jpg"))
    share = (np.abs(with_bodies.astype(int) - without).max(axis=2) > 25).mean()
    assert 0.005 < share < 0.4
    assert run(solved / "results", *rest, "--videos", solved / "videos") == 0
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "grid_000001.jpg")), without)


@pytest.mark.parametrize("words, problem", [
    (["--stills", "7"], "--stills 7: must be frames 0 to 2"),
    (["--stills", "1", "--frames", "0:1"], "give one of them"),
    (["--frames", "2:9"], "which has 3 frames"),
    (["--cameras", "kitchen"], "there is no camera 'kitchen'"),
    (["--detections", "none"], "none: there is no such file; give the folder"),
    (["--videos", "none"], "none: there is no such folder"),
    (["--width", "7"], "--width 7: must be at least 160"),
])  # fmt: skip
def test_what_cannot_be_drawn_is_said(solved, tmp_path, capsys, words, problem):
    assert run(solved / "results", "--output", tmp_path, *words) == 2
    assert problem in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_without_footage_json_pictures_are_counted_and_it_is_said(solved, tmp_path, capsys):
    people = Reconstruction.load(solved / "results")
    people.with_run(inputs={}).save(tmp_path / "results")
    (tmp_path / "results" / "cameras.json").write_bytes(
        (solved / "results" / "cameras.json").read_bytes()
    )
    assert run(tmp_path / "results") == 2
    assert "the pictures of camera" in " ".join(capsys.readouterr().err.split())
    name = people.observations.view_names[1]
    video = solved / "videos" / f"{name}.avi"
    assert run(tmp_path / "results", "--videos", f"{name}={video}", "--frames", "0:2") == 0
    told = " ".join(capsys.readouterr().err.split())
    assert f"frame 0 of the result is assumed to be the first picture of {name}" in told
    assert "of the same aspect ratio: they are assumed to be resized" in told
    assert len(frames_of(tmp_path / "results" / "overlay" / "grid.mp4")) == 2


def test_footage_of_another_calibration_is_not_drawn_on(solved, tmp_path, capsys):
    """detect was run with another rig: its places of pixels are not those of this result."""
    content = json.loads((solved / "detections" / "footage.json").read_text())
    content["cameras"][0]["calibrated_size"][0] *= 2
    (tmp_path / "footage.json").write_text(json.dumps(content))
    words = [
        "--output",
        tmp_path / "out",
        "--stills",
        "0",
        "--width",
        "640",
        "--detections",
        tmp_path,
    ]
    assert run(solved / "results", *words) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert f"camera {content['cameras'][0]['name']} was calibrated for pictures of" in printed
    assert "give --detections with the folder of this result, or --image-placement" in printed
    assert run(solved / "results", *words, "--image-placement", "scale") == 0
