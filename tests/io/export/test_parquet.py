"""Parquet: what pyarrow reads back is the result, column by column."""

import json
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.export import tables

arrow_parquet = pytest.importorskip("pyarrow.parquet")


def exported(folder, *options: object):
    """The table, and what the file says of itself."""
    with pytest.raises(SystemExit) as caught:
        main(["export", str(folder), "parquet", *map(str, options)])
    assert caught.value.code == 0
    table = arrow_parquet.read_table(folder / "export" / "people.parquet")
    return table, {key.decode(): json.loads(value) for key, value in table.schema.metadata.items()}


def column(table, name: str) -> np.ndarray:
    """A column with the shape that its metadata gives."""
    values = table.column(name).combine_chunks()
    shape = json.loads(table.schema.field(name).metadata[b"shape"])
    if len(shape) == 0:
        return values.to_numpy(zero_copy_only=False)
    return values.flatten().to_numpy().reshape(-1, *shape)


def same(table, people: Reconstruction) -> None:
    assert table.num_rows == len(people)
    for name in people.ROWS:
        found, expected = column(table, name), getattr(people, name)
        assert found.dtype == expected.dtype or expected.dtype.kind == "U"
        np.testing.assert_array_equal(found, expected)
    assert people.observations is not None
    for name in ObservationTable.ROWS[2:]:
        found, expected = column(table, f"observations.{name}"), getattr(people.observations, name)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_all_columns_come_back_in_groups_of_rows(saved, tmp_path, monkeypatch):
    people = Reconstruction.load(saved)
    people.save(tmp_path)
    monkeypatch.setattr(tables, "ROWS_AT_ONCE", 7)
    table, about = exported(tmp_path)
    same(table, people)
    assert arrow_parquet.ParquetFile(tmp_path / "export" / "people.parquet").num_row_groups == -(
        -len(people) // 7
    )
    assert about["joint_names"] == people.joint_names.tolist() and about["run"] == people.run
    assert about["known_names"][1] == "seen" and about["gate_names"][1] == "used"
    assert about["view_names"] == people.observations.view_names.tolist()
    # A part of the columns, as other programs take it.
    some = arrow_parquet.read_table(
        tmp_path / "export" / "people.parquet", columns=["frame", "person"]
    )
    assert some.column_names == ["frame", "person"]


def test_frames_and_people_are_chosen_and_a_result_without_identities_or_rows_is_written(
    saved, tmp_path
):
    people = Reconstruction.load(saved)
    alone = replace(people, run=people.run | {"configuration": {"temporal": False}})
    alone.save(tmp_path)
    table, _ = exported(tmp_path, "--frames", "103:110", "--person", "7")
    same(table, people.rows((people.person == 7) & (people.frame >= 103) & (people.frame < 110)))
    people.rows(np.zeros(0, dtype=int)).save(tmp_path)
    table, _ = exported(tmp_path)
    assert table.num_rows == 0 and column(table, "joints").shape == (0, 25, 3)
