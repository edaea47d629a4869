"""Writes this project's rig file (cameras and, beside it, their trajectories), which
`io.calibration` reads.
"""

import json
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.storage.files import read_text, write_content
from shapepose_fg.core.trajectory import Trajectory

CAMERAS = "cameras.json"
"""Name of the rig file with the cameras of a result, beside its people.npz."""
RIG_FORMAT = "shapepose-fg rig 1"
"""Format tag of this project's rig files."""
POSE = ("time_s", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Columns of a pose: the eight numbers of TUM's format, in its order."""
_AXES = ("rx", "ry", "rz", "x", "y", "z")
COVARIANCE = tuple(f"{a}_{b}" for n, a in enumerate(_AXES) for b in _AXES[n:])
"""Columns of a covariance: its upper triangle, `rx_rx` to `z_z`, rad and m along the carrier's own
axes."""


def is_replaceable(file: Path) -> bool:
    """Whether `file` may be overwritten: it does not exist, or it is a rig file of this project.
    Calibrations of other programs may also be called cameras.json.
    """
    return not file.exists() or RIG_FORMAT in read_text(file, may_be_empty=True)


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write `rig` as this project's rig file, which `read_rig` reads back without loss.

    Trajectories are written to the folder `trajectories` beside it, as CSV with covariances and in
    TUM's format.
    """
    stems = [Path(each.name).stem for each in rig.trajectories]
    files = {
        each.name: f"trajectories/{stem if stems.count(stem) == 1 else f'{n}-{stem}'}.csv"
        for n, (each, stem) in enumerate(zip(rig.trajectories, stems, strict=True))
    }
    cameras = [
        {
            "name": camera.name,
            "image_size": list(camera.image_size),
            "K": camera.K.tolist(),
            "lens": camera.lens,
            "distortion": camera.distortion.tolist(),
        }
        | (
            {"trajectory": files[camera.carrier], "bTc": camera.bTc.tolist()}
            if camera.carrier
            else {"wTc": camera.wTc.tolist()}
        )
        | ({"readout_s": camera.readout_s} if camera.readout_s > 0 else {})
        for camera in rig.cameras
    ]
    content = {"format": RIG_FORMAT, "unit": "m", "up": rig.up, "cameras": cameras}
    if rig.moves:
        content["trajectories"] = {
            files[each.name]: {"drift": each.drift, "refined": each.refined}
            for each in rig.trajectories
        }
        (Path(path).parent / "trajectories").mkdir(parents=True, exist_ok=True)
        for each in rig.trajectories:
            file = Path(path).parent / files[each.name]
            write_trajectory(each, file)
            write_trajectory(each, file.with_suffix(".tum"))
    write_content(Path(path), json.dumps(content, indent=1, allow_nan=False))


def write_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as CSV with a header and covariances; or, for a `.tum` file, in TUM's
    format without covariances.
    """
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(trajectory.wTb[:, :3, :3]).as_quat(canonical=True)
    numbers = np.column_stack([trajectory.time_s, trajectory.wTb[:, :3, 3], quaternions])
    if path.suffix == ".tum":
        write_content(path, "".join(" ".join(map(repr, row)) + "\n" for row in numbers.tolist()))
        return
    header = list(POSE)
    if trajectory.covariance is not None:
        row, column = np.triu_indices(6)
        numbers, header = (
            np.column_stack([numbers, trajectory.covariance[:, row, column]]),
            [*POSE, *COVARIANCE],
        )
    text = "".join(",".join(map(repr, row)) + "\n" for row in numbers.tolist())
    write_content(path, ",".join(header) + "\n" + text)
