"""What each row was solved from: the table's checks, its file, and how candidates are counted."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.errors import InputError
from shapepose_fg.observation_table import Gate, ObservationTable, place_in_view


def table() -> ObservationTable:
    """One person in frames 4 and 6, two joints, two views: a wrist that view B does not see in frame 6."""
    gate = np.array([[[1, 1], [1, 2]], [[1, 3], [1, 0]]])
    seen = gate > 0
    return ObservationTable(
        frame=np.array([4, 6]),
        person=np.array([2, 2]),
        joint_names=np.array(["elbow", "wrist"]),
        view_names=np.array(["A", "B"]),
        candidate=np.where(seen, 7, -1),
        xy=np.where(seen[..., None], 100.25, np.nan) * np.ones(2),
        confidence=np.where(seen, 0.5, 0.0),
        residual_px=np.where(seen[..., None], [3.0, -4.0], np.nan),
        gate=gate,
    )


def test_the_file_reads_with_numpy_alone(tmp_path):
    table().save(tmp_path / "observations.npz")
    with np.load(tmp_path / "observations.npz", allow_pickle=False) as file:
        reason = file["gate_names"][file["gate"]]
        assert reason[0].tolist() == [["used", "used"], ["used", "too far"]]
        assert reason[1].tolist() == [["used", "contradicts body"], ["used", "not seen"]]
        assert file["candidate"].tolist() == [[[7, 7], [7, 7]], [[7, 7], [7, -1]]]
        np.testing.assert_array_equal(np.linalg.norm(file["residual_px"], axis=-1)[1], [[5, 5], [5, np.nan]])
    loaded = ObservationTable.load(tmp_path / "observations.npz")
    for name in (*ObservationTable.ROWS, "joint_names", "view_names"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(table(), name), err_msg=name)


def test_reasons_are_counted():
    counted = table().reasons()
    assert counted["used"] == 5 and counted["too far"] == 1 and counted["contradicts body"] == 1
    assert sum(counted.values()) == 7 == (table().candidate >= 0).sum()
    assert table().used.sum() == 5


def test_rows_and_back_together():
    every = table()
    back = ObservationTable.concatenate([every.rows(np.array([0])), every.rows(np.array([False, True]))])
    np.testing.assert_array_equal(back.residual_px, every.residual_px)
    assert len(ObservationTable.concatenate([])) == len(ObservationTable.empty()) == 0
    with pytest.raises(ValueError, match="parts must have the same view_names"):
        ObservationTable.concatenate([every, replace(every, view_names=np.array(["A", "C"]))])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("gate", np.full((2, 2, 2), 7), "gate must hold codes below 7, got 7"),
        (
            "gate",
            np.ones((2, 2, 2), int),
            "candidate and gate must agree on what was seen, at row 1, wrist, view B",
        ),
        ("candidate", np.full((2, 2, 2), -1), "candidate and gate must agree .* row 0, elbow, view A"),
        ("xy", np.zeros((2, 2, 2, 2)), "xy and gate must agree on what was seen, at row 1, wrist, view B"),
        ("confidence", np.ones((2, 2, 2)), "confidence and gate must agree"),
        ("candidate", np.zeros((2, 2, 2)), "candidate must hold int32 values, got float64"),
        ("candidate", np.full((2, 2, 2), 2**40), "candidate must hold -2147483648 to 2147483647"),
        ("xy", np.zeros((2, 2, 2)), r"xy must be \(2, 2, 2, 2\), got \(2, 2, 2\)"),
    ],
)
def test_wrong_columns(tmp_path, column, value, message):
    with pytest.raises(ValueError, match=message):
        replace(table(), **{column: value})
    file = tmp_path / "observations.npz"
    table().save(file)
    with np.load(file) as archive:
        columns = dict(archive)
    np.savez(file, **(columns | {column: value}))
    with pytest.raises(InputError, match=f"observations.npz: {message}.*; give the observations.npz"):
        ObservationTable.load(file)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (None, "there is no such file; give the observations.npz of a reconstruction"),
        ({"gate_names": None}, "column gate_names is missing"),
        ({"xy": None}, "column xy is missing"),
        ({"gate_names": np.array(["used"])}, "gate_names are not those of this version"),
    ],
)
def test_bad_files(tmp_path, changed, sentence):
    file = tmp_path / "observations.npz"
    if changed is not None:
        table().save(file)
        with np.load(file) as archive:
            columns = dict(archive) | changed
        np.savez(file, **{name: column for name, column in columns.items() if column is not None})
    with pytest.raises(InputError) as caught:
        ObservationTable.load(file)
    assert str(caught.value).startswith(f"{file}: ") and sentence in str(caught.value)


def test_a_detection_s_place_among_those_of_its_view():
    assert place_in_view(np.array([0, 0, 0, 1, 1, 4])).tolist() == [0, 1, 2, 0, 1, 0]
    assert place_in_view(np.array([2, 0, 2, 1, 2, 0])).tolist() == [0, 0, 1, 0, 2, 1]
    assert place_in_view(np.zeros(0, int)).tolist() == []


def test_every_gate_has_a_name_of_its_own():
    assert len({gate.name for gate in Gate}) == len(Gate) == max(Gate) + 1
