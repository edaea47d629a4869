"""When frames were taken: rates, given times, what is refused, and a recording from cut to cut."""

import numpy as np
import pytest

from shapepose_fg.core.frame_times import FrameTimes, check_cuts, rate_of, segments


def test_times_from_a_rate():
    times = FrameTimes.from_fps(25, 4)
    np.testing.assert_allclose(times.frame_s, [0, 0.04, 0.08, 0.12])
    assert times.of_views(3).shape == (4, 3)
    assert times.as_dict() == {"source": "fps", "fps": pytest.approx(25), "per_camera": False}
    assumed = FrameTimes.assumed(4)
    assert assumed.as_dict() == {"source": "assumed", "fps": pytest.approx(30), "per_camera": False}
    for frames in (0, 1):
        assert FrameTimes.assumed(frames).as_dict()["fps"] is None


def test_a_dropped_frame_is_a_gap_and_cameras_may_have_times_of_their_own():
    times = FrameTimes(np.array([0, 1, 2, 4, 5]) / 50)
    assert times.as_dict()["fps"] == pytest.approx(50)  # the median: one gap changes nothing
    apart = FrameTimes(np.array([0.0, 0.1])[:, None] + [0.0, 0.02])
    np.testing.assert_allclose(apart.frame_s, [0.01, 0.11])
    np.testing.assert_allclose(apart.of_views(2)[:, 1], [0.02, 0.12])
    assert apart.as_dict()["per_camera"]


@pytest.mark.parametrize(
    "fps", [25, 30, 50, 60, 120, 240, 12.5, 30000 / 1001, 24000 / 1001, 60000 / 1001]
)
def test_a_rate_is_recovered_exactly_from_times_of_few_digits(fps):
    """Microseconds, also with frames dropped; milliseconds over some seconds; and times that
    jitter.
    """
    times, rng = np.arange(5000) / fps, np.random.default_rng(0)
    kept = np.delete(times[:100], [3, 50, 51, 70])
    shaken = times + rng.uniform(-0.1, 0.1, len(times)) / fps
    for each in (times[:3], times[:90].round(6), kept.round(6), times.round(3), shaken):
        assert rate_of(each) == fps
    assert FrameTimes(times[:200].round(6)).as_dict()["fps"] == fps


def test_a_rate_of_no_camera_stays_what_it_is_and_29_97_is_30000_by_1001():
    assert rate_of(np.arange(500) / 29.8123) == pytest.approx(29.8123, abs=1e-6)
    for typed, exact in (
        (29.97, 30000 / 1001),
        (23.976, 24000 / 1001),
        (59.94, 60000 / 1001),
        (29.8, 29.8),
    ):
        assert FrameTimes.from_fps(typed, 200).as_dict()["fps"] == exact
        np.testing.assert_array_equal(
            FrameTimes.from_fps(typed, 200).frame_s, np.arange(200) / exact
        )


@pytest.mark.parametrize(
    ("time_s", "message"),
    [
        ([0.0, 0.1, 0.1], "time_s must increase by more than .* but does not at frame 2"),
        ([[0.0, 0.0], [0.1, -0.1]], "but does not at frame 1"),
        ([0.0, 1e-300, 0.1], "but does not at frame 1"),
        ([0.0, np.nan], "time_s must be finite, but is not at frame 1"),
        (np.zeros((2, 2, 2)), r"time_s must be \(T,\) or \(T, V\), got \(2, 2, 2\)"),
    ],
)
def test_times_that_cannot_be(time_s, message):
    with pytest.raises(ValueError, match=message):
        FrameTimes(np.array(time_s))


def test_times_of_another_recording():
    with pytest.raises(ValueError, match="each of the 5 frames, got 4"):
        FrameTimes.from_fps(30, 4).check(5, 2)
    with pytest.raises(ValueError, match="each of the 3 cameras, got 2"):
        FrameTimes(np.array([[0.0, 0.0]])).check(1, 3)
    for fps in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="fps must be"):
            FrameTimes.from_fps(fps, 4)


def test_a_recording_from_cut_to_cut():
    cuts = check_cuts([3, 10, 12], 20)
    assert segments(range(0, 20), cuts) == [range(0, 3), range(3, 10), range(10, 12), range(12, 20)]
    assert segments(range(3, 11), cuts) == [range(3, 10), range(10, 11)]
    assert segments(range(4, 9), cuts) == [range(4, 9)]
    assert segments(range(4, 4), cuts) == []
    assert check_cuts((), 0) == ()
    for wrong in ([0], [20], [3, 3], [5, 2], [1.5], [[1]]):
        with pytest.raises(
            ValueError, match="cuts must be increasing frame numbers between 1 and 19"
        ):
            check_cuts(wrong, 20)
