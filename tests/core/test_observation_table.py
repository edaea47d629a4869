"""What each row was solved from: the table's checks, its file, and how candidates are counted."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate, ObservationTable


def table() -> ObservationTable:
    """One person in frames 4 and 6, two joints, two views: a wrist that view B does not see in
    frame 6.
    """
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
        np.testing.assert_array_equal(
            np.linalg.norm(file["residual_px"], axis=-1)[1], [[5, 5], [5, np.nan]]
        )
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
    back = ObservationTable.concatenate(
        [every.rows(np.array([0])), every.rows(np.array([False, True]))]
    )
    np.testing.assert_array_equal(back.residual_px, every.residual_px)
    assert len(ObservationTable.concatenate([])) == len(ObservationTable.empty()) == 0
    with pytest.raises(ValueError, match="parts must have the same view_names"):
        ObservationTable.concatenate([every, replace(every, view_names=np.array(["A", "C"]))])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("gate", np.full((2, 2, 2), 7), "gate must hold codes below 6, got 7"),
        (
            "gate",
            np.ones((2, 2, 2), int),
            "xy and gate must agree on what was seen, but do not at row 1, wrist, view B",
        ),
        (
            "candidate",
            np.full((2, 2, 2), 3),
            "candidate and gate must agree .* row 1, wrist, view B",
        ),
        (
            "xy",
            np.zeros((2, 2, 2, 2)),
            "xy and gate must agree on what was seen, but do not at row 1, wrist, view B",
        ),
        ("confidence", np.ones((2, 2, 2)), "confidence and gate must agree"),
        ("candidate", np.zeros((2, 2, 2)), "candidate must hold int32 values, got float64"),
        ("candidate", np.full((2, 2, 2), 2**40), "candidate must hold -2147483648 to 2147483647"),
        ("xy", np.zeros((2, 2, 2)), r"xy must be \(2, 2, 2, 2\), got \(2, 2, 2\)"),
        ("confidence", np.full((2, 2, 2), np.nan), "confidence must be finite"),
        ("confidence", np.full((2, 2, 2), -1.0), "confidence must not be negative"),
        ("residual_px", np.full((2, 2, 2, 2), np.inf), "residual_px must be at most"),
        ("probability", np.full((2, 2, 2), 1.5), "probability must be at most 1"),
        ("view_names", np.array(["A", "A"]), "view_names must differ from each other"),
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
    with pytest.raises(
        InputError, match=f"observations.npz: {message}.*; give the observations.npz"
    ):
        ObservationTable.load(file)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (None, "there is no such file; give the observations.npz of a reconstruction"),
        ({"gate_names": None}, "column gate_names is missing"),
        ({"xy": None}, "column xy is missing"),
        ({"gate_names": np.array(["used"])}, "gate_names are not those of this version"),
        ({"frame": np.array(3)}, "must have an entry for each row"),
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


def test_the_table_of_solved_rows(five_cameras, two_people, seen_exactly):
    """Detections without error, joints moved by hand: residuals are what the cameras say, reasons
    as they must.
    """
    from shapepose_fg.core.observations import Observations

    seen = seen_exactly(five_cameras, two_people)
    candidate = np.full((2, 25, 5), -1)
    for person in range(
        2
    ):  # the first detection of a joint in a view is the one, the second the other
        for joint in range(25):
            for view in range(5):
                rows = np.flatnonzero((seen.joint == joint) & (seen.view == view))
                xy = five_cameras.project(two_people[person, joint][None])[0][view, 0]
                candidate[person, joint, view] = rows[
                    np.linalg.norm(seen.xy[rows] - xy, axis=1).argmin()
                ]
    candidate[0, 3, 2] = -1
    observations = replace(Observations.of(candidate, seen, two_people), frame=np.array([7, 7]))
    joints = two_people.copy()
    joints[0, 4] += 0.1
    joints[1, 5] = np.nan
    away = five_cameras.centres[0] - joints[1, 6]
    joints[1, 6] = joints[1, 6] + 1.5 * away  # beyond the first camera, and so behind it
    gate = np.full((2, 25, 5), Gate.USED)
    gate[0, 4, 1], gate[1, 5], gate[1, 6, 0] = Gate.TOO_FAR, Gate.TOO_FAR, Gate.TOO_FAR
    solved = ObservationTable.of(
        observations,
        np.append(seen.place, -1)[candidate],
        joints,
        gate,
        five_cameras,
        [f"joint {index}" for index in range(25)],
    )
    assert solved.gate[0, 3, 2] == Gate.NOT_SEEN and solved.candidate[0, 3, 2] == -1
    assert solved.gate[0, 4].tolist() == [1, 2, 1, 1, 1]
    assert (solved.gate[1, 5] == Gate.NOT_PLACED).all() and np.isnan(solved.residual_px[1, 5]).all()
    assert (
        solved.gate[1, 6, 0] == Gate.BEHIND_CAMERA and np.isnan(solved.residual_px[1, 6, 0]).all()
    )
    still = np.ones((2, 25, 5), dtype=bool)
    still[0, 3, 2] = still[0, 4] = still[1, 5] = still[1, 6] = False
    np.testing.assert_allclose(solved.residual_px[still], 0, atol=1e-4)
    moved = (
        five_cameras.project(joints[0, 4][None])[0]
        - five_cameras.project(two_people[0, 4][None])[0]
    )[:, 0]
    np.testing.assert_allclose(solved.residual_px[0, 4], moved, rtol=1e-4, atol=1e-4)
    # The detection that the table names is the one at that place: a reader of the file finds it
    # again.
    for view in range(5):
        own = np.flatnonzero(seen.view == view)
        picked = solved.candidate[0, 10, view]
        np.testing.assert_allclose(seen.xy[own[picked]], solved.xy[0, 10, view], rtol=1e-6)


def test_every_gate_has_a_name_of_its_own():
    assert len({gate.name for gate in Gate}) == len(Gate) == max(Gate) + 1


def test_a_file_of_before_reads_as_certain(tmp_path):
    file = tmp_path / "observations.npz"
    given = replace(table(), probability=np.full((2, 2, 2), 0.25))
    given.save(file)
    assert (ObservationTable.load(file).probability == 0.25).all()
    with np.load(file) as archive:
        np.savez(file, **{name: archive[name] for name in archive if name != "probability"})
    old = ObservationTable.load(file)
    np.testing.assert_array_equal(old.probability, old.gate > 0)
    again = old.observations(np.zeros((2, 2, 3)), np.zeros(2))
    assert (again.probability == 1).all() and given.observations(
        np.zeros((2, 2, 3)), np.zeros(2)
    ).probability.min() == 0.25
