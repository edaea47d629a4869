"""Reads people in 3D for `evaluate`, as truth or result, from the layouts of common data sets."""

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.frame_times import spans_of
from shapepose_fg.core.joint_names import keypoint_names, layouts_called
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.result_files import PEOPLE
from shapepose_fg.core.run_summary import covered_frames, has_identities
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.core.storage.files import MIDDLE, read_bytes, read_json
from shapepose_fg.core.storage.npz import NpzFile, read_npz
from shapepose_fg.core.world_axes import z_up
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.evaluation.shelf import SHELF_JOINTS, read_shelf_ground_truth
from shapepose_fg.io.amass import LARGEST, read_amass
from shapepose_fg.io.export.motion_files import OPEN_BODY

_PANOPTIC = (
    "Neck Nose MidHip LShoulder LElbow LWrist LHip LKnee LAnkle RShoulder RElbow RWrist RHip "
    "RKnee RAnkle LEye LEar REye REar"
).split()
"""Joint order of CMU Panoptic (`joints19`)."""
_SIZE_M = (0.1, 5.0)
"""Diagonal of the box around the joints of a person, m; another median means another unit."""
_CELL, _FLOATS, _MATRIX, _COMPRESSED = 1, (6, 7), 14, 15
"""Codes of MATLAB files: classes (cell; double and single), types (matrix; compressed matrix)."""


def read_people(
    path: Path | str,
    *,
    up: Axis | None = None,
    fps: float | None = None,
    body: Path | None = None,
) -> PlainPeople:
    """Read people in 3D; InputError that names file, place and cure.

    | `path` | layout |
    |---|---|
    | folder with people.npz, or that file | a result of this program, or simulated truth |
    | folder of `body3DScene_*.json`, or one with `hdPose3d_stage1_coco19` | CMU Panoptic, cm |
    | `actorsGT.mat` | Shelf and Campus (Belagiannis et al.): LSP's 14 joints, m |
    | `.txt` | Shelf's annotation in the format of 4D Association |
    | `.npz` with `poses` and `trans`, or a folder of such files | AMASS, a person per file |
    | `.npz` with `joints` | (T, P, J, 3) or (T, J, 3), m, and `joint_names` (J,) or `layout` |

    `up` is the axis of the world that points up; AMASS needs it, because its own is z. `fps` is the
    frame rate to which AMASS is thinned; `body` the body model that its shapes belong to.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; check the path")
    if path.is_dir() and not (path / PEOPLE).is_file():
        for folder in (path, path / "hdPose3d_stage1_coco19"):
            if scenes := sorted(folder.glob("body3DScene_*.json")):
                return _panoptic(scenes)
        files = sorted(path.glob("*.npz"))
    elif path.suffix == ".mat":
        return _actors(path)
    elif path.suffix == ".txt":
        return read_shelf_ground_truth(path)
    else:
        files = [path / PEOPLE if path.is_dir() else path]
    kinds = [_kind(file) for file in files if file.suffix == ".npz"]
    if kinds == ["result"]:
        with naming(path, "restore the file"):
            return people_of(Reconstruction.load(files[0]))
    if kinds == ["arrays"]:
        return _arrays(files[0])
    if kinds and set(kinds) == {"amass"}:
        if up is None:
            raise InputError(f"{path}: AMASS is z up; give --up, the up axis of the result's world")
        return _amass(files, z_up(up).T, fps, body)
    raise InputError(
        f"{path}: must be a folder with people.npz, body3DScene_*.json or AMASS files, or "
        "actorsGT.mat, a .txt annotation, or .npz with joints; give one of these"
    )


def people_of(result: Reconstruction) -> PlainPeople:
    """The joints of a result, for `score`; ValueError if its `run` is invalid."""
    return PlainPeople(
        result.frame,
        result.joints,
        result.person,
        tuple(result.joint_names.tolist()),
        result.covariance,
        covered_frames(result.run),
        identified=has_identities(result.run),
    )


def _kind(file: Path) -> str:
    """Layout of an `.npz` file, by the names of its arrays."""
    with NpzFile(file, ("body_pose", "poses", "joints"), "give the file of a data set") as opened:
        names = opened.names
    return "result" if "body_pose" in names else "amass" if "poses" in names else "arrays"


def _table(place: object, rows: list[tuple[int, int, Array]], names: tuple[str, ...],
           **more: Any) -> PlainPeople:  # fmt: skip
    """People from rows of frame, person and joints (J, 3); InputError for a person twice in a
    frame, or for coordinates that are no positions.
    """
    frame, person = (np.array([row[n] for row in rows], dtype=np.int64) for n in (0, 1))
    joints = np.array([row[2] for row in rows]).reshape(-1, len(names), 3)
    pairs, count = np.unique(np.stack([frame, person], axis=1), axis=0, return_counts=True)
    if len(rows) == 0:
        raise InputError(f"{place}: there is no person in any frame; give a file with people")
    if count.max() > 1:
        at, duplicate = pairs[count.argmax()]
        raise InputError(f"{place}: person {duplicate} is twice in frame {at}; remove one of them")
    known = np.isfinite(joints)
    box = np.where(known, joints, -np.inf).max(axis=1) + np.where(known, -joints, -np.inf).max(1)
    size = np.linalg.norm(box[np.isfinite(box).all(axis=1) & box.any(axis=1)], axis=1)
    median = float(np.median(size)) if len(size) > 0 else 1.0
    largest = np.abs(joints[~np.isnan(joints)]).max(initial=0)
    if not (_SIZE_M[0] < median < _SIZE_M[1] and largest < LARGEST):
        raise InputError(
            f"{place}: joints must be metres, but people are {median:.3g} m large and up to "
            f"{largest:.3g} m from the origin; check the unit"
        )
    return PlainPeople(frame, joints, person, names, **more)


def _panoptic(files: list[Path]) -> PlainPeople:
    """CMU Panoptic's scenes, one file per frame; its number is at the end of the file's name."""
    rows, names, frames = list[tuple[int, int, Array]](), tuple(_PANOPTIC), list[int]()
    for file in files:
        number, scene = re.search(r"(\d{1,9})$", file.stem), read_json(file)
        if number is None:
            raise InputError(f"{file}: its name must end with the frame's number; rename it so")
        frames.append(int(number[1]))
        try:
            for body in scene["bodies"]:
                key = "joints19" if "joints19" in body else "joints15"
                # Joint order of the older files of CMU Panoptic (`joints15`).
                names = (
                    tuple(_PANOPTIC) if key == "joints19" else ("Neck", "Head", *_PANOPTIC[2:15])
                )
                values = np.array(body[key], dtype=np.float64).reshape(len(names), 4)
                known = values[:, 3:] > 0  # -1 marks joints that were not reconstructed
                # Unit of CMU Panoptic, m.
                xyz = np.where(known, 0.01 * values[:, :3], np.nan)
                rows.append((frames[-1], int(body["id"]), xyz))
        except (KeyError, TypeError, ValueError, OverflowError):
            raise InputError(
                f"{file}: bodies must have id, and joints19 or joints15 with x, y, z and "
                "confidence of each joint; download the file again"
            ) from None
    if len({row[2].shape for row in rows}) > 1:
        problem = "some bodies have joints19, others joints15"
        raise InputError(f"{files[0].parent}: {problem}; give a folder with one of them")
    return _table(files[0].parent, rows, names, covered=spans_of(frames))


def _arrays(file: Path) -> PlainPeople:
    """Joints as an array, with names or the name of a known layout."""
    keys = ("joints", "joint_names", "layout", "frames")
    data = read_npz(file, keys, "write it again with NumPy")
    joints = data.get("joints", np.zeros(0))
    joints = joints[:, None] if joints.ndim == 3 else joints
    if joints.ndim != 4 or joints.shape[3] != 3 or joints.dtype.kind not in "fiu":
        raise InputError(f"{file}: joints must be (T, P, J, 3) or (T, J, 3); write them so")
    names = data.get("joint_names", np.zeros(0)).ravel().tolist()
    if not names:
        layout = str(data.get("layout", ""))
        known = {"smpl": SMPL_24, "smpl24": SMPL_24}.get(re.sub("[_ -]", "", layout.lower()))
        found = [known] if known else map(keypoint_names, layouts_called(layout))
        names = next((list(each) for each in found if len(each) == joints.shape[2]), [])
    if len(names) != joints.shape[2] or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{file}: joint_names must name the {joints.shape[2]} joints, or layout must be a "
            "known one, such as H36M_17; add one of them"
        )
    frames = data.get("frames", np.arange(len(joints)))
    if frames.shape != (len(joints),) or frames.dtype.kind not in "iu":
        raise InputError(f"{file}: frames must be ({len(joints)},) whole numbers; correct them")
    present = np.argwhere(np.isfinite(joints).all(axis=-1).any(axis=-1)).tolist()
    rows = [(int(frames[t]), person, joints[t, person].astype(np.float64)) for t, person in present]
    return _table(file, rows, tuple(names), covered=spans_of(frames.tolist()))


def _amass(files: list[Path], turn: Array, fps: float | None, body: Path | None) -> PlainPeople:
    """AMASS's motions, a person per file (`person_3_...`, else in the order of names); `turn` (3,
    3) is the rotation from z up to the world.
    """
    model = BodyModel.default() if body is None else BodyModel.load(body)
    rows = list[tuple[int, int, Array]]()
    for place, file in enumerate(files):
        motion = read_amass(file)
        if body is None and motion.body != OPEN_BODY:
            raise InputError(f"{file}: its shape belongs to SMPL; give that model with --body")
        # Values of a pose of SMPL-X, whose shape differs from SMPL's.
        if motion.poses.shape[1] == 165:
            raise InputError(
                f"{file}: its shape belongs to SMPL-X; download the motion as SMPL+H instead"
            )
        named, rate = motion.frames[0] >= 0, motion.fps
        step = 1.0 if named or fps is None or not rate > fps else rate / fps
        at = np.rint(np.arange(0, len(motion.poses) - 0.5, step)).astype(np.intp)
        number = motion.frames[at] if named else np.arange(len(at))
        pose = np.zeros((len(at), 72))
        pose[:, :66] = motion.poses[at, :66]
        shape = np.zeros(10)
        shape[: len(motion.betas)] = motion.betas[:10]
        with naming(file, "download it again"):
            posed = BodyParameters(
                np.tile(shape, (len(at), 1)),
                pose[:, :3],
                pose[:, 3:].reshape(-1, 23, 3),
                motion.trans[at],
            )
            joints = model.keypoints(posed) @ turn.T
        called = re.search(r"person_(\d{1,9})", file.stem)
        person = int(called[1]) if called else place
        rows += [(int(n), person, xyz) for n, xyz in zip(number, joints, strict=True)]
    return _table(files[0].parent, rows, model.keypoint_names)


def _actors(file: Path) -> PlainPeople:
    """The annotation of Shelf or Campus: actor3D, cells of actors, of frames, of (14, 3) metres."""
    content, tree = read_bytes(file, MIDDLE), None
    try:
        for kind, part in _elements(content[128:] if content[126:128] == b"IM" else b""):
            if kind == _COMPRESSED:
                kind, part = next(_elements(zlib.decompressobj().decompress(part, MIDDLE)))
            if kind == _MATRIX and bytes(list(_elements(part))[2][1]) == b"actor3D":
                tree = _value(part)
    except (ValueError, IndexError, KeyError, StopIteration, struct.error, zlib.error) as error:
        raise InputError(
            f"{file}: cannot be read as a MATLAB file of version 7 or older ({error}); download "
            "it again, or save it with -v7"
        ) from None
    while isinstance(tree, list) and len(tree) == 1 and isinstance(tree[0], list):
        tree = tree[0]
    if not isinstance(tree, list) or not all(isinstance(actor, list) for actor in tree):
        raise InputError(f"{file}: actor3D must be cells of actors and frames; give actorsGT.mat")
    rows = list[tuple[int, int, Array]]()
    for person, actor in enumerate(tree):
        for frame, xyz in enumerate(actor):
            xyz = xyz[0] if isinstance(xyz, list) and len(xyz) == 1 else xyz
            if not isinstance(xyz, list) and xyz.shape == (14, 3):  # others mark absent actors
                rows.append((frame, person, np.vstack([xyz, xyz[2:4].mean(axis=0)])))
    return _table(file, rows, SHELF_JOINTS, complete=False)


def _elements(content: bytes) -> Iterator[tuple[int, bytes]]:
    """The elements of a MATLAB file or matrix: type and content."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        begin = at + 8
        if kind >> 16:  # a small element has its size in the upper half, and its content in the tag
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
        yield kind, content[begin : begin + size]
        at = max(at + 8, begin + size + (0 if kind == _COMPRESSED else -size % 8))


def _value(content: bytes, depth: int = 0) -> Any:
    """The value of a matrix: a list of the values of a cell, or an array of floats."""
    parts = list(_elements(content))
    if len(parts) == 0:
        return np.zeros(0)
    kind, shape = parts[0][1][0], np.frombuffer(parts[1][1], "<i4").tolist()
    # Maximum depth of nested cells.
    if kind == _CELL and depth < 6:
        return [_value(part, depth + 1) for _, part in parts[3:]]
    if kind not in _FLOATS:
        raise ValueError("actor3D holds something else than cells and numbers")
    stored, values = parts[3] if len(parts) > 3 else (9, b"")
    # NumPy's names of MATLAB's data types.
    kinds = dict(enumerate("i1 u1 i2 u2 i4 u4 f4 - f8 - - i8 u8".split(), start=1))
    array = np.frombuffer(values, f"<{kinds[stored]}").astype(np.float64)
    return array.reshape(shape, order="F")
