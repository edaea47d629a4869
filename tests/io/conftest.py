"""Two cameras, and detections of them as files."""

import json
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.skeleton import BODY_25

K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])


@pytest.fixture
def rig() -> Rig:
    """Cameras "left" and "right", 1001 x 801 pixels; the second has a lens that distorts."""
    shifted = np.eye(4)
    shifted[0, 3] = 1.0
    left = Camera("left", K, np.eye(4), (1001, 801))
    right = Camera("right", K, shifted, (1001, 801), np.array([-0.2, 0.05, 0.001, -0.001, 0.0]))
    return Rig((left, right), "-y")


class TextRecording:
    """Random candidates of one view, and the text that 4D Association would write for them."""

    def __init__(self, seed: int, counts: list[dict[int, int]]) -> None:
        rng = np.random.default_rng(seed)
        self.joints = [
            [rng.uniform(0.1, 0.9, size=(3, count.get(joint, 0))) for joint in range(25)]
            for count in counts
        ]
        self.affinities = []
        for frame in self.joints:
            matrices = []
            for a, b in BODY_25.limbs:
                matrix = rng.uniform(0.1, 0.9, size=(frame[a].shape[1], frame[b].shape[1]))
                matrices.append(np.where(rng.random(matrix.shape) < 0.5, matrix, 0.0))
            self.affinities.append(matrices)

    def text(self) -> str:
        """The file."""
        lines = [f"4\t{len(self.joints)}"]
        for joints, matrices in zip(self.joints, self.affinities, strict=True):
            for rows in joints:
                lines += [str(rows.shape[1]), *(" ".join(map(repr, row.tolist())) for row in rows)]
            for matrix in matrices:
                lines += [" ".join(map(repr, row.tolist())) for row in matrix]
        return "\n".join(lines) + "\n"


# Frame 0: two hips, three necks, a wrist. Frame 1: nobody. Frame 2: one nose and two right hips and
# knees.
COUNTS = [{8: 2, 1: 3, 4: 1}, {}, {0: 1, 9: 2, 10: 2}]


@pytest.fixture
def recordings() -> dict[str, TextRecording]:
    """What each of the two cameras saw in three frames; nobody in frame 1."""
    return {"left": TextRecording(0, COUNTS), "right": TextRecording(1, COUNTS[::-1])}


@pytest.fixture
def text_folder(tmp_path: Path, recordings: dict[str, TextRecording]) -> Path:
    """The recordings as files of 4D Association."""
    folder = tmp_path / "recording" / "detection"
    folder.mkdir(parents=True)
    for name, recording in recordings.items():
        (folder / f"{name}.txt").write_text(recording.text())
    return folder


def keypoints(seed: int, seen: list[int]) -> list[float]:
    """75 numbers of a person of whom the joints `seen` were seen."""
    values = np.zeros((25, 3))
    rng = np.random.default_rng(seed)
    values[seen, :2] = rng.uniform(100, 700, size=(len(seen), 2))
    values[seen, 2] = rng.uniform(0.3, 0.9, size=len(seen))
    return values.ravel().tolist()


@pytest.fixture
def openpose_folder(tmp_path: Path) -> Path:
    """Three frames of OpenPose: two people, nobody, one person; files are numbered from 7."""
    for name in ("left", "right"):
        folder = tmp_path / "openpose" / name
        folder.mkdir(parents=True)
        frames = [
            [keypoints(0, [0, 1, 8, 9]), keypoints(1, [1, 8, 12, 13])],
            [],
            [keypoints(2, list(range(25)))],
        ]
        for number, people in enumerate(frames, 7):
            content = {
                "version": 1.3,
                "people": [{"person_id": [-1], "pose_keypoints_2d": p} for p in people],
            }
            (folder / f"video_{number:012d}_keypoints.json").write_text(json.dumps(content))
    return tmp_path / "openpose"
