"""Videos and pictures: whose they are, what is in them, and what is wrong with them."""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.footage.clocks import typed_rate, typed_start
from shapepose_fg.io.footage.footage import PictureFiles, Video, open_footage, opencv_path
from shapepose_fg.io.footage.placement import (
    CameraFootage,
    Placement,
    PlacementKind,
    place,
    read_used_footage,
    write_used_footage,
)
from shapepose_fg.io.footage.places import find_footage


def video(
    path: Path,
    frames: int = 12,
    size: tuple[int, int] = (96, 64),
    fps: float = 25,
    codec: str = "mp4v",
) -> Path:
    """A video whose frame i has the grey level 10 + 15 i."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
    for frame in range(frames):
        writer.write(np.full((size[1], size[0], 3), 10 + 15 * frame % 200, dtype=np.uint8))
    writer.release()
    return path


def picture(path: Path, level: int = 100, size: tuple[int, int] = (32, 16)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0], 3), level, dtype=np.uint8))
    return path


def level(read: np.ndarray | None) -> int:
    assert read is not None
    return round(float(read.mean()))


def test_a_video_s_frames_in_any_order(tmp_path):
    told = []
    read = Video.open(video(tmp_path / "a.mp4"), lambda done, total: told.append((done, total)))
    assert read.size == (96, 64) and read.notes == ()
    np.testing.assert_allclose(read.time_s, np.arange(12) / 25, atol=1e-6)
    for frame in (0, 1, 1, 5, 11, 3):  # coded with losses: a few of fifteen levels
        assert abs(level(read.at(frame)) - (10 + 15 * frame)) <= 5
    assert read.at(12) is None


def test_a_video_that_was_cut_is_told_of(tmp_path):
    whole = video(tmp_path / "whole.avi", 60, codec="MJPG")
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    read = Video.open(cut)
    assert 15 < len(read.time_s) < 45
    assert read.notes == (
        f"{cut}: only {len(read.time_s)} of the 60 frames in its header can be read and are used;"
        " the file is truncated or damaged: copy the video again",
    )


def test_damaged_videos_are_refused(tmp_path, capfd):
    whole = video(tmp_path / "whole.mp4").read_bytes()
    bad = tmp_path / "bad.mp4"
    for content in (b"", b"no video", whole[: len(whole) // 2]):
        bad.write_bytes(content)
        with pytest.raises(
            InputError, match=r"bad\.mp4: cannot be read as a video; give another copy"
        ):
            open_footage(bad)
    assert "OpenCV" not in (err := capfd.readouterr().err) and "WARN" not in err
    with pytest.raises(InputError, match="there is no such video"):
        open_footage(tmp_path / "none.mp4")


@pytest.mark.parametrize("playlist", [
    "ffconcat version 1.0\nfile secret.mp4\n",
    "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.mp4\n#EXT-X-ENDLIST\n",
])  # fmt: skip
def test_a_playlist_leads_to_no_other_file(tmp_path, playlist):
    video(tmp_path / "secret.mp4")
    (tmp_path / "a.mp4").write_text(playlist)
    with pytest.raises(InputError, match="cannot be read as a video"):
        open_footage(tmp_path / "a.mp4")
    assert open_footage(tmp_path / "secret.mp4").size == (96, 64)


def test_pictures_are_told_by_the_last_number_in_their_names(tmp_path):
    for number in (7, 8, 10, 9):
        picture(tmp_path / "cam" / f"take2_{number}.png", 10 * number)
    (tmp_path / "cam" / "notes.txt").write_text("nothing")
    read = open_footage(tmp_path / "cam")
    assert isinstance(read, PictureFiles)
    assert read.number.tolist() == [7, 8, 9, 10] and read.time_s is None
    assert [level(read.at(place)) for place in range(4)] == [70, 80, 90, 100]
    (tmp_path / "cam" / "take2_8.png").unlink()
    assert open_footage(tmp_path / "cam").notes == (
        f"{tmp_path / 'cam'}: 1 of 4 pictures are missing",
    )
    picture(tmp_path / "cam" / "take2_9.png", size=(8, 8))
    assert open_footage(tmp_path / "cam").at(1) is None  # of another size
    assert open_footage(picture(tmp_path / "view_3.jpg")).number.tolist() == [0]


def test_pictures_without_frames_are_refused(tmp_path):
    picture(tmp_path / "cam" / "one.png")
    assert len(open_footage(tmp_path / "cam").number) == 1
    picture(tmp_path / "cam" / "2.png")
    with pytest.raises(InputError, match=r"one\.png: its name has no frame"):
        open_footage(tmp_path / "cam")
    (tmp_path / "cam" / "one.png").rename(tmp_path / "cam" / "02.png")
    with pytest.raises(InputError, match=r"2\.png: frame 2 is also in 02\.png"):
        open_footage(tmp_path / "cam")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no pictures in this folder"):
        open_footage(tmp_path / "empty")
    (tmp_path / "3.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="cannot be read as a picture"):
        open_footage(tmp_path / "3.png")


CAMERAS = ("cam1", "cam2")


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"")
    return folder


@pytest.mark.parametrize("names, found", [
    (("cam1.mp4", "cam2.MOV", "cam1.txt"), ("cam1.mp4", "cam2.MOV")),
    (("cam1/0.png", "cam2/0.png", "cam3/0.png"), ("cam1", "cam2")),
    (("take_cam1.avi", "take_cam2.avi"), ("take_cam1.avi", "take_cam2.avi")),
    (("video01.mp4", "video02.mp4"), ("video01.mp4", "video02.mp4")),
    (("videos/cam1.mp4", "videos/cam2.mp4", "calibration.toml"),
     ("videos/cam1.mp4", "videos/cam2.mp4")),
    (("view_1.jpg", "view_2.jpg"), ("view_1.jpg", "view_2.jpg")),
])  # fmt: skip
def test_footage_is_found_as_people_lay_it_out(tmp_path, names, found):
    places, notes = find_footage([str(touched(tmp_path, *names))], CAMERAS)
    assert places == [tmp_path / name for name in found]
    assert (len(notes) == 1) == ("cam1" not in (Path(found[0]).stem, found[0]))


def test_footage_camera_by_camera(tmp_path):
    touched(tmp_path, "left.mp4", "r=1.mp4")
    given = [f"cam2={tmp_path / 'r=1.mp4'}", f"cam1={tmp_path / 'left.mp4'}"]
    assert find_footage(given, CAMERAS) == ([tmp_path / "left.mp4", tmp_path / "r=1.mp4"], [])


def test_footage_that_is_not_found_is_named(tmp_path):
    folder = str(touched(tmp_path / "some", "cam1.mp4", "other.mp4"))
    with pytest.raises(
        InputError, match=r"nothing in it is named after camera cam2; it contains cam1\.mp4 other"
    ):
        find_footage([folder], CAMERAS)
    touched(tmp_path / "some", "cam2.mp4", "cam2/1.png")
    with pytest.raises(InputError, match=r"cam2 and cam2\.mp4 all match camera cam2"):
        find_footage([folder], CAMERAS)
    for given, problem in (
        ([str(tmp_path / "none")], "there is no such folder"),
        ([f"{folder}/cam1.mp4"], "this is one file"),
        (["cam9=x.mp4", "cam1=y.mp4"], "no camera 'cam9'; there are cam1 cam2"),
        (
            [f"cam1={folder}/cam1.mp4"],
            "there is no footage for camera cam2; add --videos cam2=PATH",
        ),
        (["cam1=x.mp4", "cam1=y.mp4"], "camera cam1 is given twice"),
        (["cam1=x.mp4", "cam2=y.mp4"], "x.mp4: there is no such file or folder"),
        ([folder, "cam2=y.mp4"], "must be CAMERA=VALUE, such as --videos cam1=VALUE"),
    ):
        with pytest.raises(InputError, match=problem):
            find_footage(given, CAMERAS)


@pytest.mark.parametrize("picture_size, kind, note", [
    ((1920, 1080), PlacementKind.SAME, None),
    ((1912, 1080), PlacementKind.CROP, "assumed to be cropped on the right or at the bottom"),
    ((1920, 1088), PlacementKind.CROP, "crop-centre"),
    ((960, 540), PlacementKind.SCALE, "of the same aspect ratio: they are assumed to be resized"),
    ((3840, 2160), PlacementKind.SCALE, "assumed to be resized"),
])  # fmt: skip
def test_sizes_that_can_only_mean_one_thing_are_placed(picture_size, kind, note):
    placement, said = place("c", picture_size, (1920, 1080), None)
    assert placement.kind is kind
    assert said is None if note is None else note in (said or "")


@pytest.mark.parametrize("picture_size, problem", [
    ((960, 512),
     ("camera c: the pictures have 960 x 512 pixels, but the calibration is for 1920 x 1080; "
        "give --image-placement")),
    ((1080, 1920), "rotated by 90 degrees"),
])  # fmt: skip
def test_other_sizes_are_the_user_s_to_explain(picture_size, problem):
    with pytest.raises(InputError, match=problem):
        place("c", picture_size, (1920, 1080), None)


def test_letterboxed_pixels_are_where_the_recording_s_own_formula_puts_them():
    """CMU Panoptic's demo: u' = s (u - 960) + 480, v' = s (v - 540) + 256, s = 512 / 1080; to half
    a pixel.
    """
    placement, _ = place("c", (960, 512), (1920, 1080), PlacementKind.LETTERBOX)
    u = np.array([[0.0, 0], [960, 540], [1919, 1079], [300, 700]])
    s = 512 / 1080
    np.testing.assert_allclose(
        placement.to_picture(u), s * (u - [960, 540]) + [480, 256], atol=0.5 * (1 - s) + 1e-9
    )
    np.testing.assert_allclose(placement.to_calibrated(placement.to_picture(u)), u, atol=1e-9)
    left, top, right, bottom = placement.region
    assert (top, bottom) == (-0.5, 511.5) and abs((right - left) / (bottom - top) - 16 / 9) < 1e-9


@pytest.mark.parametrize("kind", PlacementKind)
def test_placements_go_both_ways_and_stay_in_the_picture(kind):
    size = (640, 480) if kind is PlacementKind.SAME else (600, 500)
    placement = Placement(kind, size, (640, 480))
    xy = np.random.default_rng(0).uniform(0, 480, (9, 2))
    np.testing.assert_allclose(placement.to_calibrated(placement.to_picture(xy)), xy, atol=1e-9)
    left, top, right, bottom = placement.region
    assert left >= -0.5 and top >= -0.5 and right <= size[0] - 0.5 and bottom <= size[1] - 0.5


def test_what_was_used_is_read_back(tmp_path):
    placement = Placement(PlacementKind.LETTERBOX, (960, 512), (1920, 1080))
    used = [CameraFootage("c", tmp_path / "c.mp4", placement, np.array([3, 4, -1, 6]))]
    file = tmp_path / "footage.json"
    write_used_footage(file, used, {"network": {"sha256": "0"}})
    (back,) = read_used_footage(file)
    assert (back.name, back.path, back.placement) == ("c", tmp_path / "c.mp4", placement)
    assert back.places.tolist() == [3, 4, -1, 6]
    text = file.read_text()
    for spoilt, problem in (
        (
            text.replace("footage 1", "footage 7"),
            "format must be 'shapepose-fg footage 1', got text",
        ),
        (text.replace('"letterbox"', '"folded"'), r"cameras\[0\]\.placement must be"),
        (
            text.replace("960", "0"),
            r"cameras\[0\]\.picture_size\[0\] must be greater than 0, got 0",
        ),
        (text[:50], "is not JSON"),
    ):
        file.write_text(spoilt)
        with pytest.raises(InputError, match=problem):
            read_used_footage(file)


GOOD_RATES = {"0.01": 0.01, "100000": 1e5, "29.97": 29.97}


@pytest.mark.parametrize("text", [*GOOD_RATES, "0.005", "0", "-25", "1e5.", "100000.5", "nan"])
def test_rates_are_a_hundredth_to_a_hundred_thousand_frames_a_second(text):
    if text in GOOD_RATES:
        assert typed_rate(text) == GOOD_RATES[text]
        return
    with pytest.raises(InputError, match=f"--fps {text}: must be a frame rate in Hz"):
        typed_rate(text)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [(None, 0.0), ("0.2s", 0.2), ("-3f", -0.12), (" .5 s ", 0.5), ("12 f", 0.48)],
)
def test_starts_are_seconds_or_the_camera_s_own_frames(text, seconds):
    assert typed_start(text, 0.04, True) == pytest.approx(seconds)


def test_videos_named_in_another_unicode_form(tmp_path):
    folder = touched(tmp_path, "Gro\u0308ße.mp4", "left.mp4")
    assert [path.name for path in find_footage([str(folder)], ("Gr\u00f6ße", "left"))[0]] == [
        "Gro\u0308ße.mp4",
        "left.mp4",
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_video_whose_name_is_not_utf_8_is_refused(tmp_path):
    """OpenCV would end the process with a segmentation fault."""
    file = Path(os.fsdecode(os.fsencode(tmp_path) + b"/gr\xfc\xdfe.mp4"))
    file.write_bytes(b"")
    with pytest.raises(InputError, match="this path is not UTF-8"):
        open_footage(file)
    assert opencv_path(tmp_path / "größe.mp4") == str(tmp_path / "größe.mp4")
