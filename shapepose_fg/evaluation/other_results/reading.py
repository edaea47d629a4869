"""People in 3D as some system wrote them: which format it is, and all of them as a `Reconstruction`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import open_regular
from shapepose_fg.evaluation.other_results.skeleton_text import SHELF_JOINTS, joint_names, read_skeleton_text
from shapepose_fg.evaluation.other_results.trc import is_trc, read_trc

_FAR_M = 1e5
"""Nobody is so far from the origin of a room, metres: another unit, or a damaged file."""
_FILTERED = "_filt_"
"""What Pose2Sim adds to the names of files that it has filtered."""


def read_people(path: Path | str, up: Axis = "z") -> Reconstruction:
    """People from a people.npz or its folder, 4D Association's text, a TRC file, or a folder of TRC files.

    Joints are BODY_25's, NaN where the file has none of that name; people in Shelf's 15 joints keep these. In a
    folder of TRC files each is a person, numbered in the order of the names. Nothing but joints (and times, or
    confidences) is known of people from others. `up` is the axis of the world that a TRC file's y becomes.
    InputError, one sentence, for what cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".trc")
        if len(files) > 0 and not (path / "people.npz").exists():
            return _from_trc(_one_kind(path, files), up)
        return Reconstruction.load(path)
    beginning = _beginning(path)
    if is_trc(beginning):
        return _from_trc([path], up)
    if _two_numbers(beginning):
        return _from_text(path)
    return Reconstruction.load(path)


def _beginning(path: Path) -> str:
    """The first line of a file, if it is text; nothing where it cannot be read: who reads it says why."""
    try:
        with open_regular(path) as stream:
            return stream.read(200).decode("utf-8-sig", errors="replace").partition("\n")[0]
    except (InputError, OSError):
        return ""


def _two_numbers(line: str) -> bool:
    words = line.split()
    return len(words) == 2 and all(word.isdecimal() for word in words)


def _one_kind(folder: Path, files: Sequence[Path]) -> Sequence[Path]:
    """The files, if they are all filtered or all not: else everybody would be there twice."""
    filtered = [_FILTERED in file.name for file in files]
    if any(filtered) and not all(filtered):
        raise InputError(
            f"{folder}: there are people as triangulated and as filtered ({_FILTERED}); put one kind into a folder"
            " of its own"
        )
    return files


def _from_trc(paths: Sequence[Path], up: Axis) -> Reconstruction:
    read = [read_trc(path, up) for path in paths]
    for path, one in zip(paths, read, strict=True):
        if not any(name in BODY_25.joints for name in one.names):
            raise InputError(
                f"{path}: line 4 names no joint of BODY_25 (Neck, RHip, ...); write the joints, not other markers"
            )
    joints = [_placed(one.xyz, one.names, path) for path, one in zip(paths, read, strict=True)]
    frame = np.concatenate([one.frame for one in read])
    person = np.repeat(np.arange(len(read)), [len(one.frame) for one in read])
    return _people(
        frame, person, np.concatenate(joints), None, np.concatenate([one.time_s for one in read]), BODY_25.joints
    )


def _from_text(path: Path) -> Reconstruction:
    text = read_skeleton_text(path)
    names = joint_names(path, text)
    if names == SHELF_JOINTS:
        return _people(text.frame, text.person, _near(text.joints, path), text.confidence, None, SHELF_JOINTS)
    joints = _placed(text.joints, names, path)
    confidence = np.zeros(joints.shape[:2])
    confidence[:, [BODY_25.index(name) for name in names]] = text.confidence
    return _people(text.frame, text.person, joints, confidence, None, BODY_25.joints)


def _placed(xyz: NDArray[np.float64], names: Sequence[str], path: Path) -> NDArray[np.float64]:
    """(N, 25, 3) the joints (N, M, 3) of these names in BODY_25's order."""
    joints = np.full((len(xyz), len(BODY_25), 3), np.nan)
    for place, name in enumerate(names):
        if name in BODY_25.joints:
            joints[:, BODY_25.index(name)] = xyz[:, place]
    return _near(joints, path)


def _near(joints: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """The joints, if they are in some room."""
    far = np.abs(np.nan_to_num(joints)) > _FAR_M
    if far.any():
        raise InputError(f"{path}: a joint is {np.nanmax(np.abs(joints)):.3g} m from the origin; check the unit")
    return joints


def _people(
    frame: NDArray[np.int64],
    person: NDArray[np.integer],
    joints: NDArray[np.float64],
    confidence: NDArray[np.float64] | None,
    time_s: NDArray[np.float64] | None,
    names: Sequence[str],
) -> Reconstruction:
    """Rows sorted by frame and person, with nothing but these columns."""
    order = np.lexsort((person, frame))
    N, J = joints.shape[:2]
    return Reconstruction(
        frame=frame[order],
        person=person[order].astype(np.int64),
        joint_names=np.array(names),
        joints=joints[order],
        covariance=np.full((N, J, 3, 3), np.nan),
        confidence=np.zeros((N, J)) if confidence is None else confidence[order],
        betas=np.full((N, 10), np.nan),
        global_orient=np.full((N, 3), np.nan),
        body_pose=np.full((N, 23, 3), np.nan),
        transl=np.full((N, 3), np.nan),
        status=np.full(N, str(Status.BODY_UNDETERMINED)),
        time_s=np.full(N, np.nan) if time_s is None else time_s[order],
    )
