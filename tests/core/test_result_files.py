"""The files of a result: written column by column, together, and known to belong together."""

import io
import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import shapepose_fg.core.result_files
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.result_files import write_result
from shapepose_fg.core.storage.files import write_content, write_together
from shapepose_fg.core.storage.npz import Pieces, write_npz
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of


def written(columns) -> bytes:
    stream = io.BytesIO()
    write_npz(stream, columns)
    return stream.getvalue()


def test_pieces_leave_the_same_bytes_as_a_whole_and_numpy_reads_them():
    """Pieces of odd lengths, beyond the megabyte that the compressor is given at a time."""
    rng = np.random.default_rng(0)
    arrays = {
        "joints": rng.normal(size=(3001, 25, 3)),
        "status": np.array(["ok", "too few views"] * 7),
    }
    arrays |= {
        "none": np.zeros((0, 3), dtype=np.uint8),
        "id": np.array("abc"),
        "turned": rng.normal(size=(4, 6)).T,
    }
    cuts = {
        "joints": [0, 1, 1700, 1700, 3001],
        "status": [0, 14],
        "none": [0, 0],
        "turned": [0, 2, 6],
    }
    pieces = {
        name: Pieces(
            array.dtype,
            array.shape,
            lambda array=array, at=at: (array[a:b] for a, b in pairwise(at)),
        )
        for name, at in cuts.items()
        for array in [arrays[name]]
    }
    content = written(arrays)
    assert written({name: pieces.get(name, array) for name, array in arrays.items()}) == content
    with np.load(io.BytesIO(content), allow_pickle=False) as read:
        assert read.files == list(arrays)
        for name, array in arrays.items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)


def test_pieces_that_are_not_the_shape_are_refused():
    with pytest.raises(ValueError, match="make up 2 rows"):
        written({"x": Pieces(np.dtype(float), (3,), lambda: [np.zeros(2)])})
    with pytest.raises(ValueError, match=r"a piece of \(3, 2\) must not be \(3, 4\)"):
        written({"x": Pieces(np.dtype(float), (3, 2), lambda: [np.zeros((3, 4))])})


@pytest.fixture
def two_results(tmp_path):
    """Folders `a` and `b` with results of one and of two people."""
    for name, count in (("a", 1), ("b", 2)):
        truth_of(built_in_scene(people=count, frames=2)).save(tmp_path / name)
    return tmp_path


def test_files_of_two_results_are_not_taken_together(two_results):
    a, b = two_results / "a", two_results / "b"
    shutil.copy(a / "run.json", b / "run.json")
    with pytest.raises(
        InputError,
        match=r"b/run\.json: this file is of another run than the people\.npz beside"
        r" it",
    ):
        Reconstruction.load(b)
    # Files of earlier versions have no id.
    run = json.loads((b / "run.json").read_text())
    del run["run_id"]
    (b / "run.json").write_text(json.dumps(run))
    assert len(Reconstruction.load(b)) == 4


def test_the_id_is_that_of_the_people_whatever_is_said_of_them(two_results):
    a = two_results / "a"
    people = Reconstruction.load(a)
    before = (a / "people.npz").read_bytes()
    assert "run_id" not in people.run
    people.with_run(seconds={"vote": 2.0}).save(a)
    assert (a / "people.npz").read_bytes() == before
    people.relabelled(people.person + 1).save(a)
    with np.load(a / "people.npz") as file, np.load(io.BytesIO(before)) as old:
        assert file["run_id"] != old["run_id"] and str(file["run_id"]) == _id(a)
    assert set(people.status) == {Status.OK}


def _id(folder) -> str:
    return json.loads((folder / "run.json").read_text())["run_id"]


def test_a_disk_that_is_full_at_any_write_leaves_the_old_files_and_is_named(
    two_results, monkeypatch
):
    """A write fails behind so many bytes; all three files are as they were, and nothing else is
    there.
    """
    a = two_results / "a"
    old = {file.name: file.read_bytes() for file in a.iterdir()}
    new = Reconstruction.load(two_results / "b")
    whole = sum((two_results / "b" / name).stat().st_size for name in ("people.npz", "run.json"))
    for room in (0, 1000, whole - 10):
        left = room

        def limited(files, check, write_together=write_together):
            def full(write):
                class Full:
                    def __init__(self, stream):
                        self.stream = stream

                    def write(self, data):
                        nonlocal left
                        left -= len(data)
                        if left < 0:
                            raise OSError(28, "No space left on device")
                        return self.stream.write(data)

                    def __getattr__(self, name):
                        return getattr(self.stream, name)

                return lambda stream: write(Full(stream))

            write_together({path: full(write) for path, write in files.items()}, check)

        monkeypatch.setattr(shapepose_fg.core.result_files, "write_together", limited)
        with pytest.raises(OSError, match="No space left on device") as caught:
            write_result(a, new.columns(), None, new.run)
        assert caught.value.filename in (str(a / "people.npz"), str(a / "run.json"))
        assert {file.name: file.read_bytes() for file in a.iterdir()} == old


def test_the_error_of_a_read_only_disk_names_the_file_itself(tmp_path, monkeypatch):
    """Removing the temporary file fails, too, and its name is no file of the user's."""

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match="Read-only file system") as caught:
        write_content(tmp_path / "times.csv", "frame, time")
    assert caught.value.filename == str(tmp_path / "times.csv")
