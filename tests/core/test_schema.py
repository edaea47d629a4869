"""Tables of arrays: what a column says of itself is what is checked, kept and read back."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import SavedTable
from shapepose_fg.core.storage.npz import write_npz
from shapepose_fg.core.storage.schema import Column, Table


class Gait(IntEnum):
    STANDS = 0
    WALKS_ON = 1


@dataclass(frozen=True)
class Walk(Table):
    frame: Annotated[np.ndarray, Column("N", np.int64, most=100)]
    feet: Annotated[np.ndarray, Column("F", np.str_)]
    place: Annotated[np.ndarray, Column("N F 3", unit="m", most=1e3)]
    gait: Annotated[np.ndarray, Column("N F", np.uint8, missing=Gait.STANDS, codes=Gait)] = None


def walk(rows: int = 2) -> Walk:
    frame = np.arange(rows)
    return Walk(
        frame,
        np.array(["left", "right"]),
        np.arange(rows * 6.0).reshape(rows, 2, 3),
        np.ones((rows, 2), int),
    )


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("place", np.zeros((2, 3, 3)), r"place must be \(2, 2, 3\), got \(2, 3, 3\)"),
        ("place", np.zeros((2, 2, 3), int), "place must hold float64 values, got int64"),
        ("frame", np.array([0.0, 1.0]), "frame must hold int64 values, got float64"),
        ("feet", np.zeros((1, 2), str), r"feet must be \(1,\), got \(1, 2\)"),
        ("gait", np.full((2, 2), 2), "gait must hold codes below 2, got 2"),
        ("gait", np.full((2, 2), 300), "gait must hold 0 to 255, got 300 to 300"),
    ],
)
def test_what_does_not_fit_is_named(column, value, message):
    with pytest.raises(ValueError, match=message):
        Walk(
            **{name: getattr(walk(), name) for name in ("frame", "feet", "place", "gait")}
            | {column: value}
        )


def test_rows_are_picked_and_joined():
    whole = walk(4)
    assert Walk.ROWS == ["frame", "place", "gait"] and Walk.shared() == ["feet"]
    parts = [whole.rows(whole.frame < 1), whole.rows(np.array([3, 1]))]
    joined = Walk.concatenate(parts)
    assert joined.frame.tolist() == [0, 3, 1]
    np.testing.assert_array_equal(joined.place, whole.place[[0, 3, 1]])
    assert len(Walk.without_rows(feet=np.array(["left"]))) == 0
    with pytest.raises(ValueError, match="parts must have the same feet"):
        Walk.concatenate([whole, Walk(whole.frame, np.array(["a", "b"]), whole.place)])


def saved(tmp_path, columns) -> SavedTable:
    with (tmp_path / "walk.npz").open("wb") as stream:
        write_npz(stream, columns)
    return SavedTable(tmp_path / "walk.npz", Walk, "walk again")


def test_a_file_gives_the_table_back_and_earlier_files_lack_what_came_later(tmp_path):
    columns = walk(5).columns()
    assert list(columns) == ["frame", "place", "gait", "feet", "gait_names"]
    assert columns["gait_names"].array().tolist() == ["stands", "walks on"]
    some = saved(tmp_path, columns).read(np.array([1, 4]))
    np.testing.assert_array_equal(some.place, walk(5).place[[1, 4]])
    old = saved(tmp_path, {name: columns[name] for name in ("frame", "place", "feet")}).read(None)
    assert (old.gait == Gait.STANDS).all() and old.gait.dtype == np.uint8


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (
            "place",
            np.full((2, 2, 3), 2e3),
            r"place must be at most 1000 or unknown \(NaN\), got 2000",
        ),
        ("frame", np.array([0, -1]), "frame must not be negative, got -1"),
        (
            "place",
            np.zeros((3, 2, 3)),
            r"place must have an entry for each row, as many as frame, got the shape \(3",
        ),
        ("gait_names", np.array(["stands", "runs"]), "gait_names are not those of this version"),
        ("place", np.array([["a"] * 2] * 2), r"place must be \(2, 2, 3\), got \(2, 2\)"),
    ],
)
def test_a_bad_file_is_one_sentence_with_the_cure(tmp_path, column, value, message):
    with pytest.raises(InputError, match=rf"walk\.npz: {message}.*; walk again"):
        saved(tmp_path, {**walk().columns(), column: value}).read(None)
