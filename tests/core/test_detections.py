import numpy as np
import pytest

from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.skeleton import BODY_25


def one_limb() -> dict[str, np.ndarray]:
    return {
        "view": np.array([0, 0, 1]),
        "joint": np.array([1, 8, 1]),
        "xy": np.array([[10.0, 20.0], [10.0, 60.0], [15.0, 25.0]]),
        "confidence": np.array([0.9, 0.8, 0.7]),
        "pairs": np.array([[0, 1]]),
        "affinity": np.array([0.6]),
    }


def test_holds_candidates_and_affinities():
    detections = Detections(**one_limb())
    assert len(detections) == 3
    first, second = detections.pairs[0]
    assert detections.view[first] == detections.view[second]
    assert (detections.joint[first], detections.joint[second]) in BODY_25.limbs


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("joint", np.array([1, 8]), r"joint must be \(3,\), got \(2,\)"),
        ("xy", np.zeros((3, 3)), r"xy must be \(3, 2\), got \(3, 3\)"),
        ("confidence", np.zeros((3, 1)), r"confidence must be \(3,\), got \(3, 1\)"),
        ("pairs", np.zeros((2, 2), dtype=np.intp), r"pairs must be \(1, 2\), got \(2, 2\)"),
        ("affinity", np.zeros(2), r"pairs must be \(2, 2\), got \(1, 2\)"),
    ],
)
def test_refuses_arrays_of_different_lengths(name, value, wanted):
    with pytest.raises(ValueError, match=wanted):
        Detections(**(one_limb() | {name: value}))


def test_a_frame_in_which_nobody_was_seen():
    empty = Detections.empty()
    assert len(empty) == 0 and empty.xy.shape == (0, 2) and empty.pairs.shape == (0, 2)
    # Indices must index: an empty float array would not.
    assert BODY_25.limbs and np.array(BODY_25.joints)[empty.joint].shape == (0,)


def test_a_recording_is_its_frames_in_order():
    frames = [Detections.empty(), Detections(**one_limb())]
    recording = Recording(BODY_25, frames)
    assert len(recording) == 2 and recording.skeleton is BODY_25
    assert recording[1] is frames[1]
    assert [len(frame) for frame in recording] == [0, 3]


def test_only_some_candidates_keep_the_affinities_between_them():
    pairs = np.array([[0, 1], [1, 2], [2, 3]])
    whole = Detections(
        np.zeros(4, dtype=int),
        np.arange(4),
        np.arange(8.0).reshape(4, 2),
        np.full(4, 0.5),
        pairs,
        np.array([0.1, 0.2, 0.3]),
    )
    some = whole.only(np.array([True, False, True, True]))
    np.testing.assert_array_equal(some.joint, [0, 2, 3])
    np.testing.assert_array_equal(some.xy, [[0, 1], [4, 5], [6, 7]])
    np.testing.assert_array_equal(some.pairs, [[1, 2]])
    np.testing.assert_array_equal(some.affinity, [0.3])


def test_a_detection_knows_its_place_among_those_of_its_view():
    view = np.array([2, 0, 2, 1, 2, 0])
    none = np.zeros((0, 2), dtype=np.intp)
    every = Detections(view, np.zeros(6, int), np.zeros((6, 2)), np.ones(6), none, np.zeros(0))
    assert every.place.tolist() == [0, 0, 1, 0, 2, 1]
    assert every.rows(np.array([4, 5, 0])).place.tolist() == [2, 1, 0], (
        "also where others are left out"
    )
    assert Detections.empty().place.tolist() == []
