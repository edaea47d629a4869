"""Marker files: TRC as text, C3D read back by ezc3d, CSV by the standard library."""

import csv
import io
import sys
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, COCO_17, HALPE_26, SMPL_24
from shapepose_fg.io.export.markers import (
    Markers,
    MarkerSet,
    c3d_bytes,
    opensim_names,
    write_c3d,
    write_trc,
)
from shapepose_fg.io.export.motion_files import write_amass, write_bvh
from shapepose_fg.io.export.registry import Job, read_take
from shapepose_fg.io.export.tables import csv_text
from shapepose_fg.io.export.take import Take

from .conftest import AWAY, FIRST, FPS, FRAMES, GUESSED, LOST


@pytest.fixture(scope="module")
def job(saved, tmp_path_factory) -> Job:
    return Job(read_take(saved), tmp_path_factory.mktemp("markers"))


def read_trc(path) -> tuple[list[list[str]], list[str], np.ndarray]:
    """Header cells, marker names, and rows (F, 2 + 3 M) of a TRC file."""
    lines = path.read_text().splitlines()
    header = [line.split("\t") for line in lines[:5]]
    names = header[3][2::3][: int(header[2][3])]
    return header, names, np.array([line.split("\t") for line in lines[5:] if line], dtype=float)


def of_person(result, who: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and joints in the axes of OpenSim: z up becomes (y, z, x)."""
    rows = result.rows(result.person == who)
    return rows.frame, rows.joints[..., [1, 2, 0]]


def test_trc_holds_the_joints_in_metres_and_leaves_frames_without_markers_out(job, result):
    written = write_trc(job)
    assert [path.name for path in written.files] == ["person_3.trc", "person_7.trc"]
    for who, path in zip((3, 7), written.files, strict=True):
        header, names, rows = read_trc(path)
        frames, joints = of_person(result, who)
        assert header[0] == ["PathFileType", "4", "(X/Y/Z)", path.name]
        assert header[2] == ["25", "25", str(len(frames)), "25", "m", "25", "100", str(len(frames))]
        assert header[3][:2] == ["Frame#", "Time"] and header[4][2:5] == ["X1", "Y1", "Z1"]
        assert names[BODY_25.index("MidHip")] == "CHip"
        assert set(names) - {"CHip"} == set(BODY_25.joints) - {"MidHip"}
        np.testing.assert_array_equal(rows[:, 0], frames)
        np.testing.assert_allclose(rows[:, 1], frames / FPS, atol=1e-6)
        # Six digits of a metre.
        np.testing.assert_allclose(rows[:, 2:].reshape(joints.shape), joints, atol=5.1e-7)
    assert not set(AWAY) & set(rows[:, 0].astype(int).tolist())
    at = BODY_25.index(LOST[2])
    assert np.isnan(rows[rows[:, 0] == LOST[0], 2 + 3 * at : 5 + 3 * at]).all()


def test_c3d_read_back_by_ezc3d(job, result):
    ezc3d = pytest.importorskip("ezc3d")
    for who, path in zip((3, 7), write_c3d(job).files, strict=True):
        file = ezc3d.c3d(str(path))
        point = file["parameters"]["POINT"]
        assert point["UNITS"]["value"] == ["mm"] and point["RATE"]["value"][0] == FPS
        assert point["LABELS"]["value"] == list(opensim_names(BODY_25.joints))
        assert file["header"]["points"]["first_frame"] == FIRST
        xyz = file["data"]["points"][:3].transpose(2, 1, 0)
        residual = file["data"]["meta_points"]["residuals"][0].T
        frames, joints = of_person(result, who)
        there, truly = np.zeros((FRAMES, 25), dtype=bool), np.full((FRAMES, 25, 3), np.nan)
        truly[frames - FIRST] = joints
        there[frames - FIRST] = np.isfinite(joints).all(axis=2)
        np.testing.assert_array_equal(residual >= 0, there)
        np.testing.assert_array_equal(residual[~there], -1)
        # Single precision: a few micrometres at some metres.
        np.testing.assert_allclose(xyz[there], 1e3 * truly[there], atol=1e-3)
        rows = result.rows(result.person == who)
        sigma = 1e3 * np.sqrt(np.trace(rows.covariance, axis1=2, axis2=3) / 3)
        given = np.isfinite(sigma)
        np.testing.assert_array_equal(
            residual[frames - FIRST][given], np.rint(sigma[given]).clip(1)
        )


def test_c3d_keeps_sigmas_that_a_byte_cannot_hold(tmp_path):
    """Whole millimetres: a sigma of nothing is not unknown, one of 30 cm does not wrap around to 44
    mm.
    """
    ezc3d = pytest.importorskip("ezc3d")
    sigma = np.array([[0.0001, 0.0014, 0.2, 0.3, np.nan, 0.01]])
    xyz = np.ones((1, 6, 3))
    xyz[0, 5] = np.nan
    markers = Markers(tuple("ABCDEF"), xyz, sigma)
    (tmp_path / "one.c3d").write_bytes(c3d_bytes(markers, 0, 30.0))
    residuals = ezc3d.c3d(str(tmp_path / "one.c3d"))["data"]["meta_points"]["residuals"]
    assert residuals.ravel().tolist() == [1, 1, 200, 255, 0, -1]


def test_c3d_keeps_millimetres_far_from_the_origin(job, result, tmp_path):
    """Of 400 km a float of 32 bits keeps centimetres: points are from an origin that the file and a
    note give.
    """
    ezc3d = pytest.importorskip("ezc3d")
    place = np.array([400_000.0, -150_000.25, 1200.5])
    away = replace(
        job.take.people,
        joints=job.take.people.joints + place,
        transl=job.take.people.transl + place,
    )
    written = write_c3d(Job(replace(job.take, people=away), tmp_path))
    file = ezc3d.c3d(str(tmp_path / "person_3.c3d"))
    origin = np.array(file["parameters"]["POINT"]["ORIGIN_M"]["value"])
    points = np.moveaxis(file["data"]["points"][:3], 0, 2) / 1e3
    frames, joints = of_person(result, 3)
    names = file["parameters"]["POINT"]["LABELS"]["value"]
    assert len(names) == joints.shape[1] and len(frames) == points.shape[1]
    np.testing.assert_array_equal(origin, np.rint(origin))
    truth = joints + place[[1, 2, 0]]
    np.testing.assert_allclose(np.swapaxes(points, 0, 1) + origin, truth, atol=1e-4)
    listed = " ".join(f"{each:.0f}" for each in origin)
    assert [
        note for note in written.notes if f"c3d: coordinates are relative to {listed} m " in note
    ]
    assert write_c3d(job).notes == [] or not any(
        "coordinates" in note for note in write_c3d(job).notes
    )


def moving(count: int, first: int, person: int = 3) -> Take:
    """A person in `count` frames from `first` on, of whom one joint is known: its x is the frame's
    place, mm.
    """
    joints = np.zeros((count, 1, 3))
    joints[:, 0, 0] = 1e-3 * np.arange(count)
    nothing = {
        "betas": (count, 10),
        "global_orient": (count, 3),
        "body_pose": (count, 23, 3),
        "transl": (count, 3),
    }
    people = Reconstruction(
        frame=np.arange(first, first + count),
        person=np.full(count, person),
        joint_names=np.array(["Nose"]),
        joints=joints,
        covariance=np.full((count, 1, 3, 3), np.nan),
        confidence=np.ones((count, 1)),
        **{name: np.full(shape, np.nan) for name, shape in nothing.items()},
        status=np.full(count, "body undetermined"),
    )
    return Take.of(people, "z", fps=100.0)


def test_c3d_is_cut_where_its_numbers_end(tmp_path):
    """The count of frames has 16 bits: of 65,536 frames ezc3d kept 65,535 without a word."""
    ezc3d = pytest.importorskip("ezc3d")
    written = write_c3d(Job(moving(65_536, 0), tmp_path))
    assert [path.name for path in written.files] == [
        "person_3_frames_0-65534.c3d",
        "person_3_frames_65535-65535.c3d",
    ]
    files = [ezc3d.c3d(str(path)) for path in written.files]
    assert [file["header"]["points"]["first_frame"] for file in files] == [0, 0]
    x = np.concatenate([file["data"]["points"][2, 0] for file in files])
    np.testing.assert_allclose(x, np.arange(65_536), rtol=1e-6)
    assert len(written.notes) == 1
    assert (
        "person_3_frames_65535-65535.c3d numbers its frames from 1, not 65536" in written.notes[0]
    )


@pytest.mark.parametrize(("first", "header"), [(65_533, 65_533), (65_534, 0), (70_000, 0)])
def test_c3d_s_first_frame_does_not_wrap_around(tmp_path, first, header):
    ezc3d = pytest.importorskip("ezc3d")
    written = write_c3d(Job(moving(2, first), tmp_path))
    file = ezc3d.c3d(str(tmp_path / "person_3.c3d"))
    assert (
        file["header"]["points"]["first_frame"] == header and file["data"]["points"].shape[2] == 2
    )
    assert [f"not {first + 1}:" in note for note in written.notes] == ([] if header else [True])


@pytest.mark.parametrize("write", [write_c3d, write_amass, write_bvh])
def test_times_that_no_file_of_one_rate_holds_are_one_sentence(tmp_path, write):
    take = moving(3, 0)
    odd = replace(take, times_s=np.array([0, 0.01, 1e9]))
    with pytest.raises(InputError, match=r"people\.npz: the times cover 1000000000 s"):
        write(Job(odd, tmp_path))


def test_what_no_view_saw_can_be_left_out(saved, tmp_path):
    write_trc(Job(read_take(saved, seen_only=True), tmp_path))
    _, names, rows = read_trc(tmp_path / "person_3.trc")
    at = names.index(GUESSED[1])
    assert np.isnan(rows[:, 2 + 3 * at]).all() and np.isfinite(rows[:, 2 + 3 * at - 1]).all()


def test_markers_on_the_body(saved, tmp_path, true_bodies):
    write_trc(Job(read_take(saved), tmp_path, markers=MarkerSet.BODY))
    _, names, rows = read_trc(tmp_path / "person_3.trc")
    assert tuple(names) == SMPL_24
    joints, _ = true_bodies(3, FIRST + 4)
    np.testing.assert_allclose(rows[4, 2:].reshape(24, 3), joints[:, [1, 2, 0]], atol=1e-6)


def test_names_are_those_of_pose2sim_s_models():
    assert opensim_names(HALPE_26.joints)[HALPE_26.joints.index("MidHip")] == "Hip"
    assert opensim_names(COCO_17.joints)[COCO_17.joints.index("MidHip")] == "CHip"


def test_csv_read_back(saved, result):
    """Every cell, in the recording's own axes; lines by frame, person and joint."""
    lines = list(csv.DictReader(io.StringIO(csv_text(read_take(saved)))))
    columns = (
        "frame time_s person joint x_m y_m z_m sigma_m sigma_x_m sigma_y_m sigma_z_m vx_m_s vy_m_s "
        "vz_m_s known confidence"
    )
    assert list(lines[0]) == columns.split()
    row, joint = np.nonzero(np.isfinite(result.joints).all(axis=2))
    order = np.lexsort((joint, result.person[row], result.frame[row]))
    row, joint = row[order], joint[order]
    frames, persons = result.frame[row], result.person[row]
    names = [(int(line["frame"]), int(line["person"]), line["joint"]) for line in lines]
    assert names == list(
        zip(frames.tolist(), persons.tolist(), result.joint_names[joint].tolist(), strict=True)
    )
    variance = np.diagonal(result.covariance[row, joint], axis1=1, axis2=2)
    expected = {"time_s": frames / FPS, "sigma_m": np.sqrt(variance.mean(axis=1))}
    expected |= {"confidence": result.confidence[row, joint]}
    for n, axis in enumerate("xyz"):
        expected[f"{axis}_m"] = result.joints[row, joint, n]
        expected[f"sigma_{axis}_m"] = np.sqrt(variance[:, n])
        expected[f"v{axis}_m_s"] = result.velocity[row, joint, n]
    for name, column in expected.items():
        half_a_digit = 5.1e-5 if name == "confidence" else 5.1e-7
        np.testing.assert_allclose(
            [float(line[name]) for line in lines], column, atol=half_a_digit, err_msg=name
        )
    guessed = (persons == GUESSED[0]) & (result.joint_names[joint] == GUESSED[1])
    assert [line["known"] for line in lines] == np.where(guessed, "body", "seen").tolist()


def test_a_missing_package_is_one_sentence_with_the_command(job, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(
        InputError, match=r'ezc3d is not installed; pip install "shapepose-fg\[export\]"'
    ):
        write_c3d(job)
