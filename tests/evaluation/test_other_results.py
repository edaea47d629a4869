"""Results of other systems, read: 4D Association's text and TRC."""

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, HALPE_26
from shapepose_fg.evaluation.other_results import SHELF_JOINTS, SKEL_15, SKEL_17, SKEL_19, read_people, read_trc
from shapepose_fg.evaluation.shelf import shelf_joints
from shapepose_fg.io.export.markers import Markers, opensim_names, trc_text
from tests.conftest import STANDING


def skeleton_text(people: dict[int, dict[int, np.ndarray]], frames: int, count: int) -> str:
    """Frames of people (id: (J, 4)) as the C++ writes matrices: columns padded with blanks."""
    lines = [f"{count}\t{frames}"]
    for frame in range(frames):
        lines.append(str(len(people.get(frame, {}))))
        for number, rows in people.get(frame, {}).items():
            lines += [str(number), *(" ".join(f"{value:>10.6g}" for value in row) for row in rows.T)]
    return "\n".join(lines) + "\n"


def with_confidence(joints: np.ndarray) -> np.ndarray:
    return np.concatenate([joints, np.ones((len(joints), 1))], axis=1)


def named(names: tuple[str, ...]) -> np.ndarray:
    """The standing person's joints of these names."""
    return STANDING[[BODY_25.index(name) for name in names]]


@pytest.mark.parametrize("names", [SKEL_15, SKEL_17, SKEL_19], ids=len)
def test_each_joint_of_the_text_gets_its_place(tmp_path, names):
    path = tmp_path / "skel.txt"
    rows = with_confidence(named(names))
    lost = rows.copy()
    lost[names.index("RWrist"), 3] = 0.0  # a joint without confidence is not known, wherever it is
    path.write_text(skeleton_text({0: {0: rows, 7: lost}, 2: {7: rows}}, 3, len(names)))
    people = read_people(path)
    assert people.frame.tolist() == [0, 0, 2]
    assert people.person.tolist() == [0, 7, 7]
    there = [BODY_25.index(name) for name in names]
    np.testing.assert_allclose(people.joints[0, there], STANDING[there], atol=1e-6)
    assert np.isnan(people.joints[0, np.setdiff1d(np.arange(25), there)]).all()
    assert np.isnan(people.joints[1, BODY_25.index("RWrist")]).all()
    assert np.isfinite(people.joints[1, there].sum(axis=1)).sum() == len(names) - 1


def test_the_system_s_nineteen_joints_are_in_the_order_of_its_source():
    """Its table from BODY_25 (joint: place), as its source has it."""
    places = (4, 1, 5, 11, 15, 6, 12, 16, 0, 2, 7, 13, 3, 8, 14, -1, -1, 9, 10, 17, -1, -1, 18, -1, -1)
    for joint, place in enumerate(places):
        if place >= 0:
            assert SKEL_19[place] == BODY_25.joints[joint]
    assert len(SKEL_19) == 19


def test_fifteen_joints_are_told_apart_and_a_perfect_result_scores_100(tmp_path, capsys):
    truth, result = tmp_path / "gt.txt", tmp_path / "result.txt"
    rows = with_confidence(shelf_joints(STANDING[None])[0])
    truth.write_text(skeleton_text({0: {0: rows}}, 1, 15))
    result.write_text(truth.read_text())
    assert tuple(read_people(result).joint_names) == SHELF_JOINTS
    with pytest.raises(SystemExit):
        main(["evaluate", "shelf", str(result), "--ground-truth", str(truth), "--json"])
    assert '"pcp_average": 100.0' in capsys.readouterr().out
    # The same person in 19 joints: the protocol's mapping makes neck and head, exactly.
    result.write_text(skeleton_text({0: {0: with_confidence(named(SKEL_19))}}, 1, 19))
    with pytest.raises(SystemExit):
        main(["evaluate", "shelf", str(result), "--ground-truth", str(truth), "--json"])
    assert '"pcp_average": 100.0' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("16 1\n0\n", "line 1 says 16 joints; 15, 17 and 19 are known"),
        ("19 99999999999\n", "line 1 must say how many joints and frames"),
        ("19 2\n0\n", "ends after line 2, before the number of people in frame 1"),
        ("19 1\n1\n0\n" + "1 " * 18 + "\n", "line 4 must hold 19 values of x in frame 0, got 18"),
        ("19 1\n1\n0\n" + "inf " * 19 + "\n", "line 4 must hold 19 values of x"),
        ("19 1\n1\n0\n" + ("9e9 " * 19 + "\n") * 4, "a joint is 9e.09 m from the origin"),
        ("19 1\n1\n99999999999999999999\n", "line 3 gives the id"),
    ],
)
def test_a_broken_text_is_one_clear_sentence(tmp_path, text, message):
    path = tmp_path / "skel.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_people(path)


def markers(joints: np.ndarray, names: tuple[str, ...]) -> Markers:
    """Joints (T, M, 3) of a world with z up, as TRC has them: x, y, z become y, z, x."""
    return Markers(names, joints[..., [1, 2, 0]], np.zeros(joints.shape[:2]))


def test_what_we_write_is_read_back(tmp_path):
    """Two people, one of them in frames 3 and 5 only; six digits of a metre."""
    moves = np.arange(6)[:, None, None] * np.array([0.05, 0.0, 0.0])
    first, second = STANDING + moves, STANDING + np.array([1.0, 2.0, 0.0]) - moves
    second[[0, 1, 2, 4]] = np.nan
    second[5, 4] = np.nan
    frames, times = np.arange(10, 16), np.arange(6) / 25
    for name, joints in (("b", second), ("a", first)):
        text = trc_text(markers(joints, opensim_names(BODY_25.joints)), frames, times, 25.0, f"{name}.trc")
        (tmp_path / f"{name}.trc").write_text(text)
    people = read_people(tmp_path)
    assert people.frame.tolist() == [10, 11, 12, 13, 13, 14, 15, 15]
    assert people.person.tolist() == [0, 0, 0, 0, 1, 0, 0, 1]
    np.testing.assert_allclose(people.joints[people.person == 0], first, atol=1e-6)
    np.testing.assert_allclose(people.joints[people.person == 1], second[[3, 5]], atol=1e-6)
    alone = read_people(tmp_path / "b.trc")
    np.testing.assert_allclose(alone.joints, second[[3, 5]], atol=1e-6)


HEADER = (
    "PathFileType\t4\t(X/Y/Z)\tx.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "25\t25\t3\t{count}\t{unit}\t25\t0\t3\n"
    "Frame#\tTime\t{names}\n"
    "\t\tX1\tY1\tZ1\n"
)


def trc(rows: str, *, names: str = "Hip\t\t\tHead", unit: str = "mm", count: int = 2) -> str:
    return HEADER.format(count=count, unit=unit, names=names) + rows


@pytest.mark.parametrize(("up", "world"), [("z", [3.0, 1.0, 2.0]), ("y", [3.0, 2.0, -1.0])])
def test_units_axes_names_and_gaps(tmp_path, up: Axis, world):
    """1 to the right, 2 up and 3 to the front of a TRC file, millimetres; Pose2Sim's hip; blank cells."""
    path = tmp_path / "x.trc"
    path.write_text(trc("\n7\t0.28\t1000\t2000\t3000\t\t\t\n9\t0.36\t1000\t\t3000\t1\t1\t1\t\n"))
    read = read_trc(path, up)
    assert read.joint_names == ("MidHip", "Head")
    assert read.frame.tolist() == [7, 9]
    np.testing.assert_allclose(read.joints[0, 0], world)
    assert np.isnan(read.joints[0, 1]).all()
    assert np.isnan(read.joints[1, 0]).all()
    people = read_people(path, up)
    np.testing.assert_allclose(people.joints[0, BODY_25.index("MidHip")], world)


def test_halpe_s_joints_are_found_by_name(tmp_path):
    names = opensim_names(HALPE_26.joints)
    body = np.stack([STANDING[BODY_25.index(j)] if j in BODY_25.joints else [9.0, 9, 9] for j in HALPE_26.joints])
    (tmp_path / "x.trc").write_text(
        trc_text(markers(body[None], names), np.array([0]), np.zeros(1), 30.0, "x.trc")
    )
    np.testing.assert_allclose(read_people(tmp_path / "x.trc").joints[0], STANDING, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (trc("0\t0\t1\t2\t3\n", unit="ft"), "line 3 has the unit 'ft'"),
        (trc("0\t0\t1\t2\t3\n", count=3), "line 4 names 2 markers, line 3 says 3"),
        (trc("0\t0\t1\t2\t3\n", count=10**8), "line 3 says '100000000' markers"),
        (trc("0\t0\t1\tx\t3\n"), "line 6 holds 'x', which is no number"),
        (trc("0\t0\t1\t1e999\t3\n"), "line 6 holds '1e999', which is no number"),
        (trc("0\t0\t1\t2\t3\t4\t5\t6\t7\n"), "line 6 holds more than 2 markers"),
        (trc("0\n"), "line 6 must begin with the number of a frame and its time"),
        (trc("1\t0\n0\t0\n"), "line 7 is of frame 0: frames must rise"),
        (trc("0\t0\t1\t2\t3\n", names="Hip\t\t\tHip"), "line 4 gives two markers one name"),
        (trc("0\t0\t1\t2\t3\n", names="C7\t\t\tT10"), "line 4 names no joint of BODY_25"),
        (trc("0\t0\t1\t2\t9e12\n"), "m from the origin; check the unit"),
        ("PathFileType\t4\n", "does not begin as a TRC file does"),
    ],
)
def test_a_broken_trc_is_one_clear_sentence(tmp_path, text, message):
    path = tmp_path / "x.trc"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_people(path)


def test_people_are_not_read_twice(tmp_path):
    for name in ("x_P0.trc", "x_P0_filt_butterworth.trc"):
        (tmp_path / name).write_text(trc("0\t0\t1\t2\t3\n"))
    with pytest.raises(InputError, match="as triangulated and as filtered"):
        read_people(tmp_path)


def test_shelf_s_annotation_is_a_perfect_result(shared_data, capsys):
    path = str(shared_data / "shelf" / "gt_dev.txt")
    with pytest.raises(SystemExit):
        main(["evaluate", "shelf", path, "--ground-truth", path, "--json"])
    assert '"mpjpe_mm": 0.0' in capsys.readouterr().out
