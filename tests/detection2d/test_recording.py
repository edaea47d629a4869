"""Painted people through the whole of `detect` but the network, which is a function here."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import shapepose_fg.detection2d.recording as recording
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_sets import CameraClock, align
from shapepose_fg.detection2d.recording import CameraDetector, DetectionRun, run_detection
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.footage.footage import open_footage
from shapepose_fg.io.footage.placement import FOOTAGE, Placement, PlacementKind, read_used_footage
from shapepose_fg.io.timestamps import read_timestamps
from tests.detection2d.conftest import paint

FRAMES = 5


@pytest.fixture(scope="module")
def apart(rolled_rig) -> np.ndarray:
    """(25, 3) points in the room that no view has nearer to each other than 24 pixels: discs that
    do not touch.
    """
    rng = np.random.default_rng(0)
    points = np.zeros((0, 3))
    while len(points) < 25:
        tried = np.concatenate([points, rng.uniform([-0.9, -0.9, 0.1], [0.8, 0.9, 1.7], (1, 3))])
        xy, _ = rolled_rig.project(tried)
        distance = np.linalg.norm(xy[:, :-1] - xy[:, -1:], axis=-1)
        inside = (xy[:, -1] > 20).all() and (xy[:, -1] < np.array([620, 460])).all()
        if inside and (len(points) == 0 or distance.min() > 24):
            points = tried
    return points


def standing(points: np.ndarray, frame: int) -> np.ndarray:
    """(1, 25, 3) somebody who walks a centimetre a frame, with the joints of a scarecrow in a
    storm.
    """
    return points[None] + [0.01 * frame, 0, 0]


@pytest.fixture(scope="module")
def pictures(rolled_rig, apart, tmp_path_factory) -> Path:
    """A folder with a folder of pictures for each camera."""
    folder = tmp_path_factory.mktemp("pictures")
    for camera in rolled_rig.cameras:
        (folder / camera.name).mkdir()
        for frame in range(FRAMES):
            cv2.imwrite(
                str(folder / camera.name / f"{frame:03d}.png"),
                paint(camera, standing(apart, frame)),
            )
    return folder


def run_of(rig: Rig, pictures: Path, output: Path, network, long_side: int = 640) -> DetectionRun:
    network = replace(network, long_side=long_side)
    footage = [open_footage(pictures / name) for name in rig.names]
    placements = [Placement(PlacementKind.SAME, each.size, each.size) for each in footage]
    detectors = [
        CameraDetector.of(camera, rig.up_vector, each, placement, network)
        for camera, each, placement in zip(rig.cameras, footage, placements, strict=True)
    ]
    clocks = [CameraClock(name, np.arange(FRAMES) / 25, 1 / 25) for name in rig.names]
    return DetectionRun(detectors, align(clocks, True), output)


def test_joints_are_found_where_each_lens_puts_them(
    rolled_rig, apart, pictures, tmp_path, painted_network
):
    """Read by our own reader, undistorted, against the projection; one camera is rolled by 30
    degrees.
    """
    told = []
    run = run_of(rolled_rig, pictures, tmp_path, painted_network)
    _, unreadable = run_detection(run, lambda done, total: told.append((done, total)))
    assert told[-1] == (3 * FRAMES, 3 * FRAMES)
    assert unreadable == [0, 0, 0]
    table = read_detections(tmp_path, rolled_rig)
    assert len(table) == FRAMES and table.skeleton.name == "BODY_25"
    for frame in range(FRAMES):
        found, (xy, _) = table[frame], rolled_rig.project(standing(apart, frame)[0])
        for view in range(3):
            for joint in range(25):
                mine = found.xy[(found.view == view) & (found.joint == joint)]
                # Cells are 8 to 9 pixels: a third of one.
                assert np.linalg.norm(mine - xy[view, joint], axis=1).min(initial=99) < 3, (
                    frame,
                    view,
                    joint,
                )
    assert read_timestamps(tmp_path / "times.csv", rolled_rig, FRAMES)[
        0
    ].time_s.tolist() == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    used = read_used_footage(tmp_path / FOOTAGE)
    assert [each.name for each in used] == ["a", "b", "c"]
    assert used[1].places.tolist() == list(range(FRAMES))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.txt",
        "b.txt",
        "c.txt",
        FOOTAGE,
        "times.csv",
    ]


class Stopped(Exception):
    pass


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_end(
    rolled_rig, pictures, tmp_path, painted_network, monkeypatch
):
    monkeypatch.setattr(recording, "BLOCK", 2)
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    run_detection(run_of(rolled_rig, pictures, whole, painted_network))

    def stop(done: int, total: int) -> None:
        if done == 11:
            raise Stopped

    with pytest.raises(Stopped):
        run_detection(run_of(rolled_rig, pictures, parted, painted_network), stop)
    assert [path.name for path in parted.iterdir()] == ["unfinished"]
    seen = []
    run = run_of(rolled_rig, pictures, parted, painted_network)
    for camera in run.cameras:
        at = camera.footage.at
        camera.footage.at = lambda place, at=at: seen.append(place) or at(place)
    run_detection(run)
    assert min(seen) == 2  # frames 0 and 1 were kept
    for name in ("a.txt", "b.txt", "c.txt", "times.csv", FOOTAGE):
        assert (parted / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_runs_do_not_mix(rolled_rig, pictures, tmp_path, painted_network):
    def stop(done: int, total: int) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        run_detection(run_of(rolled_rig, pictures, tmp_path, painted_network), stop)
    with pytest.raises(
        InputError,
        match=r"another detection.long_side \(\d+ then, 320 now\); start it with the same options",
    ):
        run_detection(run_of(rolled_rig, pictures, tmp_path, painted_network, long_side=320))
    with pytest.raises(InputError, match="`detect` was interrupted and has not finished these"):
        read_detections(tmp_path, rolled_rig)
    moved = tmp_path / "moved"
    shutil.copytree(pictures, moved)
    with pytest.raises(InputError, match=r"the interrupted run had another cameras\.a\.path"):
        run_detection(run_of(rolled_rig, moved, tmp_path, painted_network))
    run_detection(run_of(rolled_rig, pictures, tmp_path, painted_network))
    with pytest.raises(InputError, match=r"a\.txt: there are detections already; delete them"):
        run_detection(run_of(rolled_rig, pictures, tmp_path, painted_network))
    (tmp_path / "other" / "unfinished").mkdir(parents=True)
    (tmp_path / "other" / "unfinished" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="this is not a run of this program"):
        run_detection(run_of(rolled_rig, pictures, tmp_path / "other", painted_network))
    assert (tmp_path / "other" / "unfinished" / "thesis.txt").read_text() == "mine"


def test_where_a_picture_cannot_be_read_nobody_is_seen(
    rolled_rig, pictures, tmp_path, painted_network
):
    spoilt = tmp_path / "spoilt"
    shutil.copytree(pictures, spoilt)
    (spoilt / "b" / "002.png").write_bytes(b"\x89PNG but no more")
    _, unreadable = run_detection(run_of(rolled_rig, spoilt, tmp_path / "out", painted_network))
    assert unreadable == [0, 1, 0]
    table = read_detections(tmp_path / "out", rolled_rig)
    assert 1 not in table[2].view and {0, 2} <= set(table[2].view.tolist())
    assert 1 in table[1].view


def test_no_camera_s_name_leads_out_of_the_folder(rolled_rig):
    """Its detections are a file called so: the camera itself is refused."""
    with pytest.raises(ValueError, match="must not contain a path"):
        replace(rolled_rig.cameras[0], name="../a")
