"""Pictures in rerun's camera views: without distortion, so that what is drawn over them lies on
them.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.cli.pictures import opened
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.export.registry import read_take
from shapepose_fg.io.export.rerun_app import new_stream
from shapepose_fg.io.export.rerun_log import log_pictures, undistorting
from shapepose_fg.io.footage.placement import Placement, PlacementKind
from shapepose_fg.viz.overlay.result_pictures import pictures_of

from .conftest import FIRST

BENT = np.array([-0.25, 0.08, 0.001, -0.002, 0.0])
"""A lens that moves the corners of the picture by tens of pixels."""


def dotted(camera: Camera, placement: Placement, points: np.ndarray) -> np.ndarray:
    """What the camera takes of white dots at `points` (N, 3), through its lens."""
    width, height = placement.picture_size
    picture = np.zeros((height, width, 3), dtype=np.uint8)
    xy = placement.to_picture(camera.distort(camera.project(points)[0]))
    for x, y in xy:
        cv2.circle(
            picture, (round(16 * x), round(16 * y)), 16 * 4, (255, 255, 255), -1, cv2.LINE_AA, 4
        )
    return picture


def centres(picture: np.ndarray) -> np.ndarray:
    """(N, 2) the middles of a picture's dots."""
    grey = picture[..., 0]
    count, label = cv2.connectedComponents((grey > 60).astype(np.uint8))
    row, column = np.indices(grey.shape)
    found = []
    for dot in range(1, count):
        weight = np.where(label == dot, grey, 0).astype(float)
        found.append([(weight * column).sum() / weight.sum(), (weight * row).sum() / weight.sum()])
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PlacementKind.SAME, PlacementKind.SCALE])
def test_points_lie_where_the_camera_without_its_lens_sees_them(scene, kind):
    camera = replace(scene.rig.cameras[0], distortion=BENT)
    width, height = camera.image_size
    size = (width, height) if kind == PlacementKind.SAME else (width * 3 // 4, height * 3 // 4)
    placement = Placement(kind, size, (width, height))
    ends = np.array([[-1.0, 0, 0.3], [1, 0, 0.5], [0, -1, 1.6], [0, 1, 1.2], [0, 0, 1.0]])
    maps = undistorting(camera, placement)
    straight = cv2.remap(dotted(camera, placement, ends), *maps, cv2.INTER_LINEAR)
    truly, _ = camera.project(ends)
    assert np.abs(camera.distort(truly) - truly).max() > 3  # a lens that matters
    found = centres(straight)
    away = np.linalg.norm(found[:, None] - truly[None], axis=2).min(axis=0)
    # Dots of 4 pixels, bent by the lens and drawn to a sixteenth of a pixel.
    assert len(found) == len(ends) and away.max() < 0.3


@pytest.fixture
def filmed(result, scene, tmp_path):
    """The result with a lens in camera cam0, and its pictures of frames 0 to 101, of which 100 was
    lost.
    """
    rig = Rig(
        (replace(scene.rig.cameras[0], distortion=BENT), *scene.rig.cameras[1:]), scene.rig.up
    )
    result.save(tmp_path)
    write_rig(rig, tmp_path / "cameras.json")
    (tmp_path / "cam0").mkdir()
    placement = Placement(PlacementKind.SAME, rig.cameras[0].image_size, rig.cameras[0].image_size)
    for frame in (*range(100), FIRST + 1):
        picture = dotted(
            rig.cameras[0], placement, result.joints[result.frame == max(frame, FIRST)][0]
        )
        cv2.imwrite(
            str(tmp_path / "cam0" / f"{frame:06d}.png"),
            picture if frame > FIRST else picture[:, :] // 2,
        )
    return tmp_path


@pytest.mark.slow
def test_pictures_are_logged_in_their_frames(filmed, result, tmp_path, capsys):
    rerun = pytest.importorskip("rerun")
    take = read_take(filmed, frames=range(FIRST, FIRST + 3))
    assert take.rig is not None
    pictures = pictures_of(
        take.people.run, take.rig, ["cam0"], [f"cam0={filmed / 'cam0'}"], open_one=opened
    )
    stream, told = new_stream(), []
    stream.save(tmp_path / "pictures.rrd")
    log_pictures(stream, take, pictures, lambda done, total: told.append((done, total)))
    stream.flush()
    del stream
    assert told == [(1, 3), (2, 3), (3, 3)]
    chunks = [chunk for chunk in rerun.chunk.RrdReader(tmp_path / "pictures.rrd").stream()]
    tables = [
        each.to_record_batch()
        for each in chunks
        if each.entity_path == "/world/cameras/cam0/picture"
    ]
    rows = {
        row["frame"]: row
        for table in tables
        for row in table.to_pylist()
        if row.get("EncodedImage:blob")
    }
    # The file of frame 100 is missing: that of frame 101 stays in frame 101, and it is said.
    assert sorted(rows) == [FIRST + 1]
    assert f"{filmed / 'cam0'}: 1 of 102 pictures are missing" in capsys.readouterr().err
    blob = np.array(rows[FIRST + 1]["EncodedImage:blob"][0], dtype=np.uint8)
    picture = cv2.imdecode(blob, cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape[1::-1] == take.rig.cameras[0].image_size
    truly, _ = take.rig.cameras[0].project(result.joints[result.frame == FIRST + 1][0])
    found = centres(picture)
    away = np.linalg.norm(found[:, None] - truly[None], axis=2).min(axis=1)
    # Dots of joints that touch have one middle for two.
    assert np.median(away) < 0.5


@pytest.mark.slow
def test_frames_that_are_other_frames_of_the_camera(filmed):
    """The result's frame 1 is frame 3 of the camera; its frame 2 none, its frame 3 one that was not
    filmed.
    """
    take = read_take(filmed)
    assert take.rig is not None
    moments = {"cam0": np.array([0, 3, -1, 5000, FIRST + 1])}
    videos = [f"cam0={filmed / 'cam0'}"]
    ((used, footage),) = pictures_of(
        take.people.run, take.rig, ["cam0"], videos, moments=moments, open_one=opened
    )
    assert footage.number[used.places[[0, 1, 4]]].tolist() == [0, 3, FIRST + 1]
    assert used.places[[2, 3]].tolist() == [-1, -1]


def test_pictures_whose_numbers_are_no_frames_are_refused(filmed):
    take = read_take(filmed)
    assert take.rig is not None
    (filmed / "cam0" / f"{FIRST + 1:06d}.png").rename(filmed / "cam0" / "20261122061.png")
    with pytest.raises(
        InputError, match="pictures are numbered from 0 to 20261122061; number them by the frames"
    ):
        pictures_of({}, take.rig, ["cam0"], [f"cam0={filmed / 'cam0'}"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--videos", "cam0=gone.mp4"], "gone.mp4: there is no such file"),
        (["--images", "cam9=x"], "there is no camera 'cam9'"),
    ],
)
def test_pictures_that_are_not_there_are_one_sentence(saved, capsys, words, message):
    pytest.importorskip("rerun")
    with pytest.raises(SystemExit) as end:
        main(["view", str(saved), *words])
    assert end.value.code == 2
    assert message in capsys.readouterr().err
