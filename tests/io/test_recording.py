"""Detections of cameras with clocks of their own: put together by their times, and told apart
again.
"""

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.recording import read_moments, read_recording, write_moments
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.simulation import built_in_scene, simulate

COLUMNS = ("view", "joint", "xy", "confidence", "pairs", "affinity")
FPS, LATE = 25.0, 5
"""Camera 1 was started so many frames after the others."""
FRAMES = BLOCK_FRAMES + 30


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, cameras=3, frames=20)


@pytest.fixture(scope="module")
def together(scene, tmp_path_factory):
    """The recording as it would be if all cameras had been started together, as it is read."""
    once = simulate(scene)
    frames = [once[frame % len(once)] for frame in range(FRAMES)]
    write_association(
        Recording(once.skeleton, frames), scene.rig, folder := tmp_path_factory.mktemp("whole")
    )
    return read_detections(folder, scene.rig)


@pytest.fixture(scope="module")
def apart(scene, together, tmp_path_factory):
    """Files of the cameras as they were filmed, and times.csv."""
    folder = tmp_path_factory.mktemp("apart")
    nobody = together[0].only(np.zeros(len(together[0]), dtype=bool))
    frames = []
    for frame in range(FRAMES):
        now, later = together[frame], together[frame + LATE] if frame + LATE < FRAMES else nobody
        frames.append(joined(now.only(now.view != 1), later.only(later.view == 1)))
    write_association(Recording(together.skeleton, frames), scene.rig, folder)
    times = np.arange(FRAMES)[:, None] / FPS + np.array([0.0, LATE / FPS + 0.004, 0.0])
    write_timestamps(folder / "detection" / "times.csv", scene.rig.names, times)
    return folder / "detection"


def joined(one: Detections, other: Detections) -> Detections:
    columns = [np.concatenate([getattr(one, name), getattr(other, name)]) for name in COLUMNS[:4]]
    pairs = np.concatenate([one.pairs, other.pairs + len(one)])
    return Detections(*columns, pairs, np.concatenate([one.affinity, other.affinity]))


def sets(seen: Detections) -> tuple[np.ndarray, np.ndarray]:
    """Candidates in an order of their own, and pairs by what they join."""
    rows = np.column_stack([seen.view, seen.joint, seen.xy, seen.confidence])
    links = np.column_stack([rows[seen.pairs[:, 0]], rows[seen.pairs[:, 1]], seen.affinity])
    return (each[np.lexsort(each.T)] for each in (rows, links))


@pytest.mark.slow
def test_frames_are_what_all_cameras_saw_at_one_time(scene, together, apart, tmp_path):
    recording, times = read_recording(apart, scene.rig, None, tmp_path / "kept")
    assert len(recording) == FRAMES - LATE and times is not None
    np.testing.assert_allclose(np.ptp(times.time_s, axis=1), 0.004, atol=2e-6)
    assert recording.picture is not None and recording.picture[0].tolist() == [LATE, 0, LATE]
    for frame in (0, 1, BLOCK_FRAMES - 1, BLOCK_FRAMES, len(recording) - 1):
        for found, expected in zip(
            sets(recording[frame]), sets(together[frame + LATE]), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=1e-4)  # the digits that files have
    assert any(
        "frames without a picture of every camera are left out" in note for note in recording.notes
    )


@pytest.mark.slow
def test_cameras_may_have_different_numbers_of_frames(scene, apart, tmp_path):
    """The last frames of camera 1, which are of later than the others, taken out of its file."""
    for file in apart.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    name = scene.rig.names[1]
    shorter, whole = FRAMES - LATE, read_detections(apart, scene.rig)
    assert all((whole[frame].view != 1).all() for frame in range(shorter, FRAMES))
    part = Recording(whole.skeleton, [whole[frame] for frame in range(shorter)])
    write_association(part, scene.rig, tmp_path / "short")
    (tmp_path / f"{name}.txt").write_bytes(
        (tmp_path / "short" / "detection" / f"{name}.txt").read_bytes()
    )
    common, _ = read_recording(tmp_path, scene.rig, None, tmp_path / "kept", fps=FPS)
    assert len(common) == shorter and f"the {shorter} common ones" in common.notes[-1]
    found, _ = read_recording(tmp_path, scene.rig, None, tmp_path / "again")
    expected, _ = read_recording(apart, scene.rig, None, tmp_path / "whole")
    assert len(found) == len(expected)
    for frame in range(len(found)):
        for name in COLUMNS:
            np.testing.assert_allclose(
                getattr(found[frame], name), getattr(expected[frame], name), atol=1e-4
            )


def test_moments_are_read_as_they_were_written(scene, tmp_path):
    picture = np.array([[5, 0, 5], [6, -1, 6]])
    write_moments(tmp_path / "moments.csv", scene.rig, picture)
    found = read_moments(tmp_path / "moments.csv")
    assert list(found) == list(scene.rig.names)
    np.testing.assert_array_equal(np.column_stack(list(found.values())), picture)
    for damage in (
        "",
        "frame, a\n0\n",
        "frame, a\n1, 0\n",
        "frame, a\n0, x\n",
        "frame, a\n0, -2\n",
        "a\n",
    ):
        (tmp_path / "moments.csv").write_text(damage)
        with pytest.raises(InputError, match=r"moments\.csv"):
            read_moments(tmp_path / "moments.csv")
