"""Times from a text file: what people write, and one sentence for what cannot be used."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.timestamps import read_timestamps, write_timestamps
from shapepose_fg.simulation.scene import ring_of_cameras


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Cameras cam0 and cam1."""
    return ring_of_cameras(2, np.random.default_rng(0))


def read(tmp_path: Path, text: str, rig: Rig, frames: int = 3):
    (tmp_path / "times.csv").write_text(text)
    times, moments = read_timestamps(tmp_path / "times.csv", rig, frames)
    assert moments is None
    return times


@pytest.mark.parametrize(
    "text",
    [
        "0\n0.04\n0.12\n",
        "time_s\n0\n0.04\n0.12\n",
        "# taken with a phone\n\n0.0 # first\n4e-2\n.12",
        "frame,time_s\n0,0\n1,0.04\n2,0.12\n",
        # in any order, frames that the recording lacks
        "time_s frame note\n0.12 2 5\n0 0 5\n0.04 1 5\n9 3 5\n",
    ],
)
def test_one_time_for_all_cameras(tmp_path, rig, text):
    times = read(tmp_path, text, rig)
    np.testing.assert_allclose(times.time_s, [0, 0.04, 0.12])
    assert times.source == str(tmp_path / "times.csv")


def test_a_time_for_each_camera(tmp_path, rig):
    times = read(
        tmp_path,
        "frame, cam1, other, cam0\n0, 0.01, 9, 0\n1, 0.05, 9, 0.04\n2, 0.13, 9, 0.12\n",
        rig,
    )
    np.testing.assert_allclose(times.time_s, [[0, 0.01], [0.04, 0.05], [0.12, 0.13]])


def test_cameras_that_are_called_by_numbers(tmp_path):
    cameras = ring_of_cameras(2, np.random.default_rng(0)).cameras
    rig = Rig(
        tuple(replace(each, name=name) for each, name in zip(cameras, ("1", "2"), strict=True)), "z"
    )
    times = read(tmp_path, "2 1\n0.01 0\n0.05 0.04\n0.13 0.12\n", rig)
    np.testing.assert_allclose(times.time_s, [[0, 0.01], [0.04, 0.05], [0.12, 0.13]])
    np.testing.assert_allclose(read(tmp_path, "1\n2\n3\n", rig).time_s, [1, 2, 3])


def test_cameras_that_began_apart_are_put_together_by_their_times(tmp_path, rig):
    """cam1 began 2.1 frames later, and lacks its frame 3."""
    text = "cam0 cam1\n0 .084\n.04 .124\n.08 .164\n.12 -\n.16 .244\n.2 .284\n.24 -\n"
    (tmp_path / "times.csv").write_text(text)
    times, moments = read_timestamps(tmp_path / "times.csv", rig, 7)
    assert moments is not None and moments.picture.tolist() == [
        [2, 0],
        [3, 1],
        [4, 2],
        [5, -1],
        [6, 4],
    ]
    expected = [[0.08, 0.084], [0.12, 0.124], [0.16, 0.164], [0.2, 0.2], [0.24, 0.244]]
    np.testing.assert_allclose(times.time_s, expected)
    assert "1 of 5 synchronised frames have no picture within half a frame" in " ".join(
        moments.notes
    )


def test_what_is_written_is_read(tmp_path, rig):
    given = np.array([[0.5, 0.51], [0.54, 0.55]])
    write_timestamps(tmp_path / "times.csv", rig.names, given)
    np.testing.assert_allclose(
        read_timestamps(tmp_path / "times.csv", rig, 2)[0].time_s, given - 0.5, atol=1e-6
    )
    with pytest.raises(InputError, match="has a blank, a comma or #; rename it in the calibration"):
        write_timestamps(tmp_path / "times.csv", ["left one", "b"], given)


def test_a_recording_without_frames(tmp_path, rig):
    assert len(read(tmp_path, "time_s\n", rig, frames=0)) == 0


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the file is empty; write or copy it again"),
        ("0\n1\n", "must hold a time for each of the 3 frames, got 2; add a column frame"),
        ("0\n1\n2\n3\n", "must hold a time for each of the 3 frames, got 4"),
        ("0\n2\n1\n", "line 3 must be later than the frame before; sort frames by time"),
        ("cam0 cam1\n0 0\n1 1\n2 1\n", "line 4 must be later than the frame before"),
        ("0\nsoon\n1\n", "line 2 must hold numbers, got 'soon'; write seconds like 0.033"),
        ("0\nnan\n1\n", "line 2 must hold numbers, got 'nan'"),
        ("0\ninf\n1\n", "line 2 must hold numbers, got 'inf'"),
        (
            "0 0\n1 1\n2 2\n",
            "line 1 must hold 1 numbers, got 2; correct the line, or name the columns",
        ),
        ("cam0 cam1\n0 0\n1\n2 2\n", "line 3 must hold 2 numbers, got 1; correct the line"),
        (
            "cam0 cam2\n0 0\n1 1\n2 2\n",
            "times of camera cam1 are missing; the columns are cam0 cam2; name a column time_s",
        ),
        ("time_s time_s\n0 0\n", "column time_s occurs twice; give each its own name"),
        (
            "frame time_s\n0 0\n2 1\n",
            "the time of frame 1 is missing; the recording has frames 0 to 2; add its line",
        ),
        ("frame time_s\n0 0\n0 1\n", "frame 0 occurs twice; keep one line"),
        ("frame time_s\n0 0\n0.5 1\n", "line 3 must name a frame, 0 or more, got 0.5; correct it"),
        ("frame time_s\n1 0\n0 1\n2 2\n", "line 2 must be later than the frame before"),
        ("0\n33\n67\n", "frames are 33.5 s apart; write seconds"),
        (
            "cam0 cam1\n0 1000\n1 1001\n2 1002\n",
            (
                "camera cam0 ends at 2 s and camera cam1 starts at 1000 s: they have no time in "
                "common; give times"
            ),
        ),
        ("cam0 cam1\n0 -\n1 -\n2 -\n", "camera cam1 has no times; leave it out with --without"),
        ("frame cam0 cam1\n0 0 0\n- 1 1\n2 2 2\n", "line 3 must hold numbers, got '-'"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(tmp_path, rig, text, sentence):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, rig)
    assert str(caught.value).startswith(f"{tmp_path / 'times.csv'}: ") and sentence in str(
        caught.value
    )


def test_damaged_files_are_one_sentence_or_none(tmp_path, rig):
    whole, rng = b"frame,cam0,cam1\n0,0,0.01\n1,0.04,0.05\n2,0.08,0.09\n", np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[int(rng.integers(len(whole)))] = int(rng.integers(256))
        (tmp_path / "times.csv").write_bytes(bytes(damaged))
        try:
            times, moments = read_timestamps(tmp_path / "times.csv", rig, 3)
            assert np.isfinite(times.time_s).all() and (
                moments is None or len(moments) == len(times)
            )
        except InputError as error:
            assert "\n" not in str(error)
