"""Trajectories of carriers of cameras: TUM's format, CSV with optional covariances, and MCAP."""

from pathlib import Path

import numpy as np

from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.frame_times import MOST_FPS
from shapepose_fg.core.rig_file import COVARIANCE, POSE
from shapepose_fg.core.trajectory import MOST_METRES, UNIT_LENGTH, Trajectory
from shapepose_fg.io.number_table import read_number_table
from shapepose_fg.io.validation import is_number


def read_trajectory(path: str | Path, name: str = "") -> Trajectory:
    """Read the poses of a carrier: world from carrier, metres, seconds on the clock of the
    pictures.

    The file has eight numbers per line (TUM: time x y z qx qy qz qw), separated by blanks or
    commas; or a header with the columns `POSE` in any order and optionally those of `COVARIANCE`,
    at least its diagonal. `#` begins a comment. Or it is an MCAP file of ROS 2 messages;
    `FILE.mcap#FRAME` if more than one frame moves in it. InputError, one sentence that names file,
    line and cure.
    """
    from scipy.spatial.transform import Rotation

    file, _, frame = str(path).partition(".mcap")
    if file != str(path) and frame[:1] in ("", "#"):
        from shapepose_fg.io.ros.mcap_files import read_frame

        return read_frame(Path(f"{file}.mcap"), frame[1:], name or str(path))
    path = Path(path)

    def heads(line: int, words: list[str]) -> tuple[list[str], bool]:
        header = not is_number(words[0])
        names = words if header else [*map(str, POSE)]
        _check_columns(path, line, names)
        return names, header

    names, numbers, lines = read_number_table(path, heads, "write seconds and metres")
    if len(numbers) < 2:
        raise InputError(
            f"{path}: a trajectory needs 2 poses or more, got {len(numbers)}; write a line for each"
        )
    columns = {each: numbers[:, place] for place, each in enumerate(names)}
    pose = np.column_stack([columns[each] for each in POSE])
    far = np.abs(pose[:, 1:4]).max(axis=1) > MOST_METRES
    if far.any():
        raise InputError(
            f"{path}: line {lines[far][0]} is more than {MOST_METRES:g} m away; write metres"
        )
    length = np.linalg.norm(pose[:, 4:], axis=1)
    wrong = ~(np.abs(length - 1) < UNIT_LENGTH)
    if wrong.any():
        got = (
            f"line {lines[wrong][0]}: the quaternion qx qy qz qw must have length 1, got "
            f"{length[wrong][0]:.4g}"
        )
        raise InputError(f"{path}: {got}; write time x y z qx qy qz qw, qw last")
    late = np.flatnonzero(np.diff(pose[:, 0]) < 1 / MOST_FPS)
    if len(late) > 0:
        raise InputError(
            f"{path}: line {lines[late[0] + 1]} must be later than the pose before; sort by time"
        )
    wTb = rigid(Rotation.from_quat(pose[:, 4:]).as_matrix(), pose[:, 1:4])
    covariance = None
    if any(each in columns for each in COVARIANCE):
        zero = np.zeros(len(pose))
        upper = np.column_stack([columns.get(each, zero) for each in COVARIANCE])
        covariance = np.zeros((len(pose), 6, 6))
        row, column = np.triu_indices(6)
        covariance[:, row, column] = covariance[:, column, row] = upper
        odd = np.linalg.eigvalsh(covariance)[:, 0] < -1e-9
        if odd.any():
            what = f"line {lines[odd][0]}: the covariance must have no negative eigenvalue"
            raise InputError(
                f"{path}: {what}; write variances about the carrier's axes, rad² and m²"
            )
    with naming(path, "correct it in the file"):
        return Trajectory(name or path.stem, pose[:, 0], wTb, covariance)


def _check_columns(path: Path, line: int, names: list[str]) -> None:
    """InputError if these are not the columns of a trajectory."""
    known = {*POSE, *COVARIANCE}
    odd = next((name[:20] for name in names if name not in known or names.count(name) > 1), None)
    missing = next((name for name in POSE if name not in names), None)
    if odd is not None or missing is not None:
        what = (
            f"column {odd!r} is unknown or occurs twice"
            if odd is not None
            else f"column {missing} is missing"
        )
        raise InputError(
            f"{path}: line {line}: {what}; name the columns {' '.join(POSE)}, and for "
            "covariances rx_rx ..."
        )
    diagonal = [name for name in COVARIANCE if len(set(name.split("_"))) == 1]
    lacks = next((name for name in diagonal if name not in names), None)
    if lacks is not None and any(name in names for name in COVARIANCE):
        raise InputError(
            f"{path}: line {line}: the covariance lacks {lacks}; give {' '.join(diagonal)} at least"
        )
