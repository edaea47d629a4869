"""A saved result of which some rows are read: they are those of the whole, and the others take no
memory.
"""

import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.export.registry import read_take
from shapepose_fg.results.track_summary import list_saved_tracks, list_tracks
from shapepose_fg.viz.report.writing import report_of

PEOPLE, FRAMES, VIEWS = 3, 400, ("a", "b")


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    """1200 rows of random numbers, with observations; person 2 is there in every third frame
    only.
    """
    rng = np.random.default_rng(0)
    frame, person = np.divmod(np.arange(PEOPLE * FRAMES), PEOPLE)
    there = (person != 2) | (frame % 3 == 0)
    frame, person = frame[there], person[there]
    N, J, V = len(frame), len(BODY_25), len(VIEWS)
    gate = rng.integers(0, 2, (N, J, V)).astype(np.uint8)
    seen = gate != Gate.NOT_SEEN
    pixels = np.where(seen[..., None], rng.uniform(0, 900, (N, J, V, 2)), np.nan).astype(np.float32)
    table = ObservationTable(
        frame=frame,
        person=person,
        joint_names=np.array(BODY_25.joints),
        view_names=np.array(VIEWS),
        candidate=np.where(seen, 0, -1).astype(np.int32),
        xy=pixels,
        confidence=np.where(seen, 0.5, 0).astype(np.float32),
        residual_px=pixels / 100,
        gate=gate,
    )
    joints = rng.normal(size=(N, J, 3))
    return Reconstruction(
        frame=frame,
        person=person,
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=rng.normal(size=(N, J, 3, 3)),
        confidence=rng.uniform(size=(N, J)),
        betas=rng.normal(size=(N, 10)),
        global_orient=rng.normal(size=(N, 3)),
        body_pose=rng.normal(size=(N, 23, 3)),
        transl=rng.normal(size=(N, 3)),
        status=np.array(["ok", "body undetermined"])[rng.integers(0, 2, N)],
        time_s=frame / 25,
        known=np.full((N, J), Known.SEEN, dtype=np.uint8),
        run={"frames": [0, FRAMES], "time": {"fps": 25.0}},
        observations=table,
    )


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("saved")
    result.save(path)
    return path


def same(found: Reconstruction, expected: Reconstruction) -> None:
    for name in (*Reconstruction.ROWS, "joint_names"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.observations is not None and expected.observations is not None
    for name in (*ObservationTable.ROWS, "view_names"):
        np.testing.assert_array_equal(
            getattr(found.observations, name), getattr(expected.observations, name)
        )


@pytest.mark.slow
def test_frames_and_people_are_those_of_the_whole(folder, result):
    whole = Reconstruction.load(folder)
    same(whole, result)
    with Reconstruction.open(folder / "people.npz") as opened:
        assert len(opened) == len(result) and opened.run == whole.run
        # Rising, backwards, over the borders of what is unpacked at a time, and beyond the end.
        for start, stop in ((0, 7), (100, 350), (399, 1000), (3, 4), (250, 250)):
            inside = (result.frame >= start) & (result.frame < stop)
            same(opened.frames(start, stop), result.rows(inside))
        for numbers in ([2], [0, 2], [9]):
            same(opened.people(numbers), result.rows(np.isin(result.person, numbers)))
        assert opened.people([1], observations=False).observations is None
        # On, back, over the border of what is read at a time, and where nobody is.
        for frame in (0, 1, 127, 128, 300, 5, 399, 1000):
            same(opened.at(frame), result.at(frame))
        some, every = opened.thinned(most_rows=300)
        assert every == 4
        same(some, result.rows(result.frame % 4 == 0))
    with pytest.raises(InputError, match=r"people\.npz"):
        opened.frames(0, 1)


def test_snippets_for_a_result_in_memory_hold_for_an_open_one(folder, result):
    """README's and using.md's: columns, rows that a mask chooses."""
    with Reconstruction.open(folder) as opened:
        for name in (*Reconstruction.ROWS, "joint_names"):
            np.testing.assert_array_equal(getattr(opened, name), getattr(result, name))
        same(opened.rows(opened.status == "ok"), result.rows(result.status == "ok"))
        same(opened.rows(opened.time_s < 2.0), result.rows(result.frame < 50))
        with pytest.raises(AttributeError, match="has no attribute 'colour'"):
            _ = opened.colour


@pytest.mark.slow
def test_rows_in_the_middle_take_the_memory_of_these_rows(folder, result):
    """All rows are over 30 MB; ten of them may take what is unpacked at a time, 4 MB."""
    big = Reconstruction.concatenate(
        [replace(result.rows(np.arange(900)), run={}).relabelled(np.full(900, n)) for n in range(8)]
    )
    big.save(folder / "big")
    whole = sum(getattr(big, name).nbytes for name in Reconstruction.ROWS)
    assert whole > 30e6
    with Reconstruction.open(folder / "big") as opened:
        tracemalloc.start()
        found = opened.rows(np.arange(5000, 5010))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    same(found, big.rows(np.arange(5000, 5010)))
    assert peak < 8e6


def test_what_does_not_fit_in_memory_is_a_sentence(folder, monkeypatch):
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=1_000_000))
    with pytest.raises(
        InputError, match=r"people\.npz: 934 rows need .* and 1\.0 MB are free; read fewer"
    ):
        Reconstruction.load(folder)
    with pytest.raises(InputError, match=r"rows need"):
        read_take(folder, up="z")
    with Reconstruction.open(folder) as opened:
        assert len(opened.frames(0, 20)) > 0


def test_many_people_in_many_frames_are_a_sentence(folder, monkeypatch):
    """A place for everybody in every frame: 12,000 people in as many frames took a gigabyte from 83
    KB.
    """
    monkeypatch.setattr("shapepose_fg.io.export.take._BODY_BYTES", 10**12)
    with pytest.raises(
        InputError, match=r"people\.npz: \d+ people over \d+ frames need .* \(--frames, --person\)"
    ):
        read_take(folder, up="z")


def test_a_file_that_was_changed_is_one_sentence(folder, tmp_path, result):
    """Damage in a column is found where the rows are read, and a file of other rows when it is
    opened.
    """
    result.save(tmp_path)
    content = bytearray((tmp_path / "people.npz").read_bytes())
    for place in range(len(content) // 8, len(content) // 2, 997):
        content[place] ^= 0x55
    (tmp_path / "people.npz").write_bytes(bytes(content))
    # A column whose head is damaged is found when the file is opened.
    with (
        pytest.raises(InputError, match=r"^.*people\.npz: ") as caught,
        Reconstruction.open(tmp_path) as opened,
    ):
        opened.frames(390, 400)
    assert "\n" not in str(caught.value)
    result.rows(np.arange(5)).save(tmp_path)
    (tmp_path / "run.json").write_text('{"run_id": "another"}')
    with pytest.raises(InputError, match=r"of another run"):
        Reconstruction.open(tmp_path)


def test_a_part_is_exported_listed_and_shown_as_the_whole_would_be(folder, result, monkeypatch):
    take = read_take(folder, up="z", frames=range(30, 60), persons=(0, 2))
    inside = np.isin(result.person, (0, 2)) & (result.frame >= 30) & (result.frame < 60)
    same(take.people, result.rows(inside))
    monkeypatch.setattr("shapepose_fg.results.track_summary.MOST_ROWS", 500)
    with Reconstruction.open(folder) as opened:
        listed = list_saved_tracks(opened)
    without = [
        [replace(track, stature_m=0.0) for track in each] for each in (listed, list_tracks(result))
    ]
    assert without[0] == without[1]  # without a body nobody has a height
    monkeypatch.setattr("shapepose_fg.viz.report.writing.MOST_ROWS", 300)
    page = report_of(folder, up="z").read_text()
    assert "every 4th frame" in page
    thin = list_tracks(result.rows(result.frame % 4 == 0), every=4)
    assert [track.gaps for track in thin] == [
        0,
        0,
        33,
    ]  # person 2 is in every twelfth frame: 34 of them
