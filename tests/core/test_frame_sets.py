import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_sets import CameraClock, align, own_frames


def clock(name: str, fps: float, frames: int, start_s: float = 0.0) -> CameraClock:
    return CameraClock(name, start_s + np.arange(frames) / fps, 1 / fps)


def test_cameras_that_run_together_stay_as_they_are():
    moments = align([clock("a", 30, 10), clock("b", 30, 10)], True)
    assert moments.picture.tolist() == [[i, i] for i in range(10)]
    assert moments.notes == () and moments.synchronised


def test_a_camera_that_starts_later_and_ends_earlier_cuts_the_others():
    moments = align([clock("a", 30, 100), clock("b", 30, 50, start_s=0.5)], True)
    assert moments.picture[0].tolist() == [15, 0] and moments.picture[-1].tolist() == [64, 49]
    assert moments.notes == (
        (
            "camera a: frames without a picture of every camera are left out, 15 at the start "
            "and 35 at the end"
        ),
    )


def test_of_a_faster_camera_the_nearest_frames_are_taken():
    """100 against 30 a second: the nearest is at most 5 ms away, and it is said."""
    moments = align([clock("slow", 30, 30), clock("fast", 100, 100)], True)
    assert len(moments) == 30
    assert moments.time_s is not None
    off = np.ptp(moments.time_s, axis=1)
    assert off.max() == pytest.approx(1 / 300, abs=1e-9)
    np.testing.assert_array_equal(moments.picture[:, 1], np.round(np.arange(30) * 100 / 30))
    assert moments.notes == (
        (
            "camera fast: pictures are up to 3.3 ms from the time of their synchronised frame (2.2 "
            "ms on average)"
        ),
    )
    assert not moments.synchronised


def test_half_a_frame_is_the_most():
    """b lost frames 4 to 6; a third of a frame late otherwise."""
    late = clock("b", 10, 12, start_s=0.033)
    late = CameraClock("b", np.delete(late.time, [4, 5, 6]), late.period)
    moments = align([clock("a", 10, 12), late], True)
    assert moments.picture[:, 1].tolist() == [0, 1, 2, 3, -1, -1, -1, 4, 5, 6, 7, 8]
    assert (
        "3 of 12 synchronised frames have no picture within half a frame (the first is frame 4)"
        in moments.notes[0]
    )
    assert moments.time_s is not None and np.isfinite(moments.time_s).all()
    assert moments.time_s[4, 1] == moments.time_s[4, 0]


def test_the_camera_with_most_frames_tells_the_moments():
    gappy = CameraClock("a", np.array([0.0, 1, 2, 5, 6]), 1.0)
    moments = align([gappy, CameraClock("b", np.arange(7.0), 1.0)], False)
    assert moments.picture[:, 0].tolist() == [0, 1, 2, -1, -1, 3, 4]
    assert moments.time_s is None


def test_frame_rates_that_vary_are_followed_by_time():
    rng = np.random.default_rng(0)
    phone = np.cumsum(rng.uniform(0.025, 0.042, 200))
    moments = align(
        [CameraClock("phone", phone, float(np.median(np.diff(phone)))), clock("b", 30, 180)], True
    )
    assert moments.time_s is not None
    both = (moments.picture >= 0).all(axis=1)
    assert np.abs(np.diff(moments.time_s[both], axis=1)).max() <= 1 / 60 + 1e-3
    assert both.mean() > 0.9


def test_a_picture_stands_for_one_moment():
    """29.97 among 30 a second for 100 s: after 16.7 s a picture is as near to one moment as to the
    next.
    """
    moments = align([clock("a", 30, 3000), clock("b", 30000 / 1001, 2997)], True)
    used = moments.picture[moments.picture[:, 1] >= 0, 1]
    assert len(moments) == 3000 and (np.diff(used) == 1).all() and len(used) == 2997
    assert moments.time_s is not None and (np.diff(moments.time_s, axis=0) > 0).all()
    assert np.ptp(moments.time_s, axis=1).max() < 1 / 59


def test_cameras_without_a_moment_in_common_are_named():
    with pytest.raises(
        InputError, match=r"camera a ends at 0\.3 s and camera b starts at 9 s: they have no"
    ):
        align([clock("a", 10, 4), clock("b", 10, 4, start_s=9.0)], True)


def test_where_nothing_says_when_cameras_began_every_picture_is_kept():
    """The second is shorter, the third twice as fast: of it every second picture belongs to
    none.
    """
    moments = own_frames(
        [clock("a", 25, 10), clock("b", 25, 4, start_s=0.2), clock("c", 50, 20)], True
    )
    own = np.arange(10)
    np.testing.assert_array_equal(
        moments.picture, np.stack([own, np.where(own < 4, own, -1), 2 * own], axis=1)
    )
    assert moments.time_s is not None and not moments.synchronised
    assert np.isnan(moments.time_s[4:, 1]).all() and np.isfinite(moments.time_s[:, [0, 2]]).all()
    assert "4 to 10 frames" in moments.notes[0] and "--start" in moments.notes[0]


def test_files_that_run_together_are_the_same_either_way():
    clocks = [clock("a", 30, 10), clock("b", 30, 10)]
    one, two = align(clocks, True), own_frames(clocks, True)
    np.testing.assert_array_equal(one.picture, two.picture)
    np.testing.assert_array_equal(one.time_s, two.time_s)
    assert one.notes == two.notes == () and two.synchronised
