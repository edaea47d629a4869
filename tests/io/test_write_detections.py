"""Detections written for other systems, read back by our readers and by one that knows the format's
text alone.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.write_detections import write_association, write_openpose
from shapepose_fg.proposal.people_2d import group_people
from shapepose_fg.simulation import built_in_scene, simulate

LIMBS = (
    "1-8 9-10 10-11 8-9 8-12 12-13 13-14 1-2 2-3 3-4 2-17 1-5 5-6 6-7 5-18 1-0 0-15 0-16 15-17 "
    "16-18 14-19 19-20 14-21 11-22 22-23 11-24"
)
"""As the description of the format lists them."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Three cameras with names, sizes and lenses of their own."""
    cameras = built_in_scene(0, people=0, cameras=3, frames=0).rig.cameras
    changes = (
        {"name": "left", "distortion": np.array([-0.12, 0.03, 1e-3, -5e-4, 0.0])},
        {"name": "0", "image_size": (1281, 722)},
        {"name": "wide angle", "distortion": np.array([-0.05, 0, 0, 0, 0])},
    )
    return Rig(
        tuple(replace(camera, **change) for camera, change in zip(cameras, changes, strict=True)),
        up="z",
    )


@pytest.fixture(scope="module")
def recording() -> Recording:
    """What the simulated detector sees of four people, then of nobody, then of four again."""
    some = simulate(built_in_scene(0, cameras=3, frames=2))
    return Recording(BODY_25, [some[0], Detections.empty(), some[1]])


def in_order(found: Detections) -> Detections:
    """The same candidates sorted by view, then joint, then as they stood; pairs too, by their
    candidates.
    """
    order = np.lexsort((found.joint, found.view))
    place = np.argsort(order)
    pairs = place[found.pairs]
    links = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return Detections(
        found.view[order],
        found.joint[order],
        found.xy[order],
        found.confidence[order],
        pairs[links],
        found.affinity[links],
    )


def test_our_reader_finds_the_same_in_the_association_text(
    rig: Rig, recording: Recording, tmp_path: Path
):
    write_association(recording, rig, tmp_path)
    again = read_rig(tmp_path / "calibration.json")
    assert again.names == rig.names and again.up == "z"
    for one, other in zip(again.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(one.K, other.K, rtol=1e-15)
        np.testing.assert_allclose(one.wTc, other.wTc, atol=1e-12)
        np.testing.assert_array_equal(one.distortion, other.distortion)
        assert one.image_size == other.image_size
    table = read_detections(tmp_path, again)
    assert len(table) == 3
    for found, truth in zip(table, map(in_order, recording), strict=True):
        back = in_order(found)
        np.testing.assert_array_equal(back.view, truth.view)
        np.testing.assert_array_equal(back.joint, truth.joint)
        # Half of the seventh decimal of 1280 px is 6e-5 px; undoing the lens stretches it a little.
        np.testing.assert_allclose(back.xy, truth.xy, atol=1e-4)
        np.testing.assert_allclose(back.confidence, truth.confidence, atol=5.01e-7)
        np.testing.assert_array_equal(back.pairs, truth.pairs)
        np.testing.assert_allclose(back.affinity, truth.affinity, atol=5.01e-7)
    assert len(table[0].affinity) > 100 and len(table[1]) == 0


def read_by_the_description(text: str) -> list[tuple[list, list]]:
    """Per frame the candidates (x, y, score) of each joint, and the matrix of each limb.

    From the format's description alone: the skeleton's type and the number of frames; per frame,
    for each of 25 joints n, then n x, n y, n scores; then for each of 26 limbs the matrix, row by
    row.
    """
    words = iter(text.split())
    assert next(words) == "4"
    frames = []
    for _ in range(int(next(words))):
        joints, matrices = [], []
        for _ in range(25):
            n = int(next(words))
            xs, ys, scores = ([float(next(words)) for _ in range(n)] for _ in range(3))
            joints.append(list(zip(xs, ys, scores, strict=True)))
        for limb in LIMBS.split():
            a, b = map(int, limb.split("-"))
            matrices.append([[float(next(words)) for _ in joints[b]] for _ in joints[a]])
        frames.append((joints, matrices))
    assert next(words, None) is None
    return frames


def test_a_reader_that_is_not_ours_finds_the_same(rig: Rig, recording: Recording, tmp_path: Path):
    write_association(recording, rig, tmp_path)
    calibration = json.loads((tmp_path / "calibration.json").read_text())
    compared = 0
    for view, camera in enumerate(rig.cameras):
        entry = calibration[camera.name]
        width, height = entry["imgSize"]
        rotation = np.array(entry["RT"]).reshape(3, 4)
        np.testing.assert_allclose(rotation[:, :3] @ camera.centre + rotation[:, 3], 0, atol=1e-12)
        frames = read_by_the_description(
            (tmp_path / "detection" / f"{camera.name}.txt").read_text()
        )
        assert len(frames) == len(recording)
        for (joints, matrices), found in zip(frames, recording, strict=True):
            rows = [
                np.flatnonzero((found.view == view) & (found.joint == joint)) for joint in range(25)
            ]
            for mine, read in zip(rows, joints, strict=True):
                assert len(read) == len(mine)
                if len(read) == 0:
                    continue
                x, y, score = np.array(read).T
                pixels = np.column_stack([x * (width - 1), y * (height - 1)])
                np.testing.assert_allclose(pixels, camera.distort(found.xy[mine]), atol=1e-4)
                np.testing.assert_allclose(score, found.confidence[mine], atol=5.01e-7)
            scores = np.zeros((len(found), len(found)))
            scores[tuple(found.pairs.T)] = found.affinity
            for limb, matrix in zip(LIMBS.split(), matrices, strict=True):
                a, b = (rows[int(joint)] for joint in limb.split("-"))
                expected = scores[np.ix_(a, b)]
                np.testing.assert_allclose(
                    np.array(matrix).reshape(expected.shape), expected, atol=5.01e-7
                )
                compared += np.count_nonzero(expected)
    assert compared == sum(len(found.affinity) for found in recording) > 300


def test_what_lies_far_outside_the_picture_is_left_out(
    rig: Rig, recording: Recording, tmp_path: Path
):
    xy = recording[0].xy.copy()
    rows = np.flatnonzero(recording[0].view == 1)
    rows = rows[np.argsort(~np.isin(rows, recording[0].pairs))]  # those with affinities lie outside
    xy[rows] = np.linspace((-330, 100), (1000, 100), len(rows))
    moved = Recording(BODY_25, [replace(recording[0], xy=xy)])
    write_association(moved, rig, tmp_path)
    back = read_detections(tmp_path, rig)[0]  # the reader refuses what is 25 % outside or more
    there = xy[recording[0].view == 1, 0] > -0.25 * 1281
    assert 0 < np.sum(~there) < 10
    assert np.sum(back.view == 1) == np.sum(there)
    assert len(back.affinity) < len(recording[0].affinity)


def test_openpose_files_hold_the_people_that_affinities_make(
    rig: Rig, recording: Recording, tmp_path: Path
):
    write_openpose(recording, rig, tmp_path)
    table = read_detections(tmp_path, rig)
    assert len(table) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "left", "wide angle"]
    for found, truth in zip(table, recording, strict=True):
        people = [rows for rows in group_people(truth) if len(rows) >= 3]
        assert len(found) == sum(map(len, people))
        for rows in people:
            same = np.array([
                np.flatnonzero(
                    (found.view == truth.view[row])
                    & (found.joint == truth.joint[row])
                    # three decimals, and the lens
                    & (np.abs(found.xy - truth.xy[row]).max(axis=1) < 1.5e-3)
                )
                for row in rows
            ])  # fmt: skip
            assert same.shape == (len(rows), 1)
            inside = np.isin(found.pairs, same[:, 0])
            np.testing.assert_array_equal(
                inside[:, 0], inside[:, 1]
            )  # no pair leads from one person to another
        assert (found.affinity == 1).all()


def test_groups_are_people_where_the_detector_is_perfect():
    from shapepose_fg.simulation import DetectorConfig

    scene = built_in_scene(0, frames=1)
    found = simulate(scene, DetectorConfig.perfect())[0]
    groups = [rows for rows in group_people(found) if len(rows) >= 3]
    views = np.array([found.view[rows[0]] for rows in groups])
    np.testing.assert_array_equal(np.bincount(views), [4] * 6)
    true_xy = scene.rig.project(scene.truth_at(0))[0]
    for rows in groups:
        assert len(set(found.view[rows].tolist())) == 1
        error = np.linalg.norm(
            true_xy[found.view[rows], :, found.joint[rows]] - found.xy[rows][:, None], axis=-1
        )
        assert error.max(axis=0).min() < 1e-6  # all of one person


def test_a_stronger_pair_is_grouped_first_and_nobody_gets_two_of_a_kind():
    neck, hip, wrist = 1, 8, 4
    joint = np.array([neck, hip, hip, wrist, neck])
    pairs = np.array([[0, 1], [0, 2], [4, 2]])
    found = Detections(
        np.zeros(5, int), joint, np.zeros((5, 2)), np.ones(5), pairs, np.array([0.5, 0.7, 0.6])
    )
    groups = sorted(sorted(rows.tolist()) for rows in group_people(found))
    # 0-2 wins; 4-2 would give two necks, 0-1 two hips.
    assert groups == [[0, 2], [1], [3], [4]]


def test_misuse_and_leftovers_are_refused(rig: Rig, recording: Recording, tmp_path: Path):
    with pytest.raises(ValueError, match="z up"):
        write_association(recording, Rig(rig.cameras, up="y"), tmp_path)
    fisheye = replace(rig.cameras[0], distortion=np.zeros(4), lens="fisheye")
    with pytest.raises(
        ValueError, match="five distortion coefficients, but camera left has another lens"
    ):
        write_association(recording, replace(rig, cameras=(fisheye, *rig.cameras[1:])), tmp_path)
    with pytest.raises(ValueError, match="no frame"):
        write_association(Recording(BODY_25, []), rig, tmp_path)
    other = Skeleton("three", ("a", "b", "c"), ((0, 1),), (-1, 0, 1), (0, 1, 2), (0, 1, 2))
    with pytest.raises(ValueError, match="only BODY_25"):
        write_openpose(Recording(other, recording.frames), rig, tmp_path)
    write_openpose(recording, rig, tmp_path)
    with pytest.raises(InputError, match="frames of another recording"):
        write_openpose(recording, rig, tmp_path)
