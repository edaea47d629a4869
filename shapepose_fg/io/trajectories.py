"""Trajectories of carriers of cameras: TUM's format, CSV with optional covariances, and MCAP."""

from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.decompositions import is_rotation, nearest_rotation, rigid
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.frame_times import MOST_FPS
from shapepose_fg.core.rig_file import COVARIANCE, POSE
from shapepose_fg.core.trajectory import MOST_METRES, UNIT_LENGTH, Trajectory
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.number_table import read_number_table, refuse_first

_STRAY = {"timestamp", "frame", *POSE[1:]}
"""Columns of Stray Scanner's odometry.csv; it may have further ones, some of them empty."""
_LENS = ("fx", "fy", "cx", "cy")
"""Columns of the lens in a log, pixels."""
_MATRIX = ("time_s", *(f"r{row}{column}" for row in "123" for column in "123t"))
"""Columns of ARKit Data Logger's ARKit_camera_pose.txt."""


def read_trajectory(path: str | Path, name: str = "") -> Trajectory:
    """Read the poses of a carrier: world from carrier, metres, seconds on the clock of the
    pictures.

    The file has eight numbers per line (TUM: time x y z qx qy qz qw), separated by blanks or
    commas; or a header with the columns `POSE` in any order and optionally those of `COVARIANCE`,
    at least its diagonal. `#` begins a comment. Or it is an MCAP file of ROS 2 messages;
    `FILE.mcap#FRAME` if more than one frame moves in it. Logs of phones are recognised (ARKit,
    ARCore: docs/moving_cameras.md), and are then poses of the camera: x right, y down, z forward in
    the picture as the sensor has it. InputError, one sentence that names file, line and cure.
    """
    from scipy.spatial.transform import Rotation

    file, _, frame = str(path).partition(".mcap")
    if file != str(path) and frame[:1] in ("", "#"):
        from shapepose_fg.io.ros.mcap_files import read_frame

        return read_frame(Path(f"{file}.mcap"), frame[1:], name or str(path))
    path = Path(path)

    def heads(line: int, words: list[str]) -> tuple[list[str], bool]:
        header = not is_number(words[0])
        matrix = not header and len(words) == len(_MATRIX)
        names = words if header else list(_MATRIX if matrix else POSE)
        if not matrix and not set(names) >= _STRAY:
            _check_columns(path, line, names)
        return names, header

    names, numbers, lines = read_number_table(path, heads, "write seconds and metres", _may_lack)
    if len(numbers) < 2:
        raise InputError(
            f"{path}: a trajectory needs 2 poses or more, got {len(numbers)}; write a line for each"
        )
    names, numbers, lines, bTc = _of_phone(path, names, numbers, lines)
    columns = {each: numbers[:, place] for place, each in enumerate(names)}
    pose = np.column_stack([columns[each] for each in POSE])
    far, length = np.abs(pose[:, 1:4]).max(axis=1), np.linalg.norm(pose[:, 4:], axis=1)
    what = f" is more than {MOST_METRES:g} m away"
    refuse_first(path, lines, far > MOST_METRES, what, "write metres")
    refuse_first(
        path,
        lines,
        ~(np.abs(length - 1) < UNIT_LENGTH),
        lambda row: f": the quaternion qx qy qz qw must have length 1, got {length[row]:.4g}",
        "write time x y z qx qy qz qw, qw last",
    )
    late, what = np.diff(pose[:, 0]) < 1 / MOST_FPS, " must be later than the pose before"
    refuse_first(path, lines[1:], late, what, "sort by time")
    wTb = rigid(Rotation.from_quat(pose[:, 4:]).as_matrix(), pose[:, 1:4]) @ bTc
    covariance = None
    if any(each in columns for each in COVARIANCE):
        zero = np.zeros(len(pose))
        upper = np.column_stack([columns.get(each, zero) for each in COVARIANCE])
        covariance = np.zeros((len(pose), 6, 6))
        row, column = np.triu_indices(6)
        covariance[:, row, column] = covariance[:, column, row] = upper
        refuse_first(
            path,
            lines,
            np.linalg.eigvalsh(covariance)[:, 0] < -1e-9,
            ": the covariance must have no negative eigenvalue",
            "write variances about the carrier's axes, rad² and m²",
        )
    with naming(path, "correct it in the file"):
        return Trajectory(name or path.stem, pose[:, 0], wTb, covariance)


def read_log_lens(path: Path) -> Array | None:
    """(3, 3) intrinsics in a phone's log, pixels of the pictures as the sensor has them: medians of
    the columns fx fy cx cy (Stray Scanner's odometry.csv), or a 3 x 3 matrix (its
    camera_matrix.csv); None for other tables.
    """

    def heads(line: int, words: list[str]) -> tuple[list[str], bool]:
        return words, not is_number(words[0])

    units = "give a log with columns fx fy cx cy"
    names, numbers, _ = read_number_table(path, heads, units, _may_lack)
    if numbers.shape == (3, 3):
        return numbers
    if not set(_LENS) <= set(names) or len(numbers) == 0:
        return None
    fx, fy, cx, cy = (float(np.median(numbers[:, names.index(each)])) for each in _LENS)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _may_lack(name: str) -> bool:
    """Whether a column of a phone's log may be empty."""
    return name.startswith("distortion_center")


def _of_phone(
    path: Path, names: list[str], numbers: Array, lines: Index
) -> tuple[list[str], Array, Index, Array]:
    """The columns `POSE` of a phone's log, and the camera on what it logs (4, 4); tables of other
    kinds as they are.

    Stray Scanner (ARKit) has a header with `timestamp` and `frame`, and OpenCV's axes. ARKit Data
    Logger has a time and a 3 x 4 matrix, ARCore Data Logger time qx qy qz qw x y z; the camera
    looks along -z, y up. Times may be nanoseconds, and pictures logged twice.
    """
    from scipy.spatial.transform import Rotation

    bTc = np.diag([1.0, -1, -1, 1])
    if set(names) >= _STRAY:
        numbers, bTc = (
            numbers[:, [names.index(each) for each in ("timestamp", *POSE[1:])]],
            np.eye(4),
        )
    elif names == list(_MATRIX):
        matrix = numbers[:, 1:].reshape(-1, 3, 4)
        if not is_rotation(matrix[..., :3]):
            raise InputError(f"{path}: rows must hold a time and a rotation beside a translation")
        turn = Rotation.from_matrix(nearest_rotation(matrix[..., :3])).as_quat()
        numbers = np.column_stack([numbers[:, 0], matrix[..., 3], turn])
    elif names == list(POSE) and _is_unit(numbers[:, 1:5]) and not _is_unit(numbers[:, 4:]):
        numbers = numbers[:, [0, 5, 6, 7, 1, 2, 3, 4]]
    else:
        return names, numbers, lines, np.eye(4)
    # Time between two poses above which times are nanoseconds, s.
    if np.median(np.diff(numbers[:, 0])) > 1e3:
        numbers = numbers * np.r_[1e-9, np.ones(7)]
    later = np.append(True, np.diff(np.maximum.accumulate(numbers[:, 0])) > 0)
    return list(POSE), numbers[later], lines[later], bTc


def _is_unit(quaternions: Array) -> bool:
    return bool((np.abs(np.linalg.norm(quaternions, axis=1) - 1) < UNIT_LENGTH).all())


def _check_columns(path: Path, line: int, names: list[str]) -> None:
    """Raise InputError if these are not the columns of a trajectory."""
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
