"""Detections in arrays: FreeMoCap's NumPy file of all cameras, HDF5 of SLEAP and DeepLabCut;
pickles are never read.
"""

import pickletools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError, naming, optional
from shapepose_fg.core.storage.files import BIG, SMALL, open_regular
from shapepose_fg.core.storage.npz import MOST_PACKED, read_npy_header
from shapepose_fg.io.camera_names import MOST_FRAME
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.csv_people import BLAZEPOSE, body_parts, taken
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock

_FREEMOCAP, _SLEAP, _DEEPLABCUT = (
    "FreeMoCap's 2D points",
    "SLEAP's analysis HDF5",
    "DeepLabCut's HDF5",
)
_RERUN = "write the detections again, in pixels"
_MOST_NAMES, _LONGEST_NAME = 1000, 1000
_TABLE = "df_with_missing/table"
"""Path of the table in files of DeepLabCut and AniPose."""
_RECORD = np.dtype([("length", "<u4"), ("heap", "<u8"), ("index", "<u4")])
"""HDF5's reference to a text of variable length: its length and its address."""
_HDF5 = (
    "an HDF5 file, of which only SLEAP's analysis files and DeepLabCut's tables are supported; "
    "give the CSV"
)
_FREEMOCAP_3D = (
    "FreeMoCap's table of 3D points, but its 2D points are needed; give the recording's folder, or"
    " output_data/raw_data/..._pixelXY.npy in it"
)
_OTHERS = {
    ".npy": (
        "a NumPy array, of which only FreeMoCap's (cameras, frames, points, 2 or 3) in pixels is "
        "supported"
    ),
    ".npz": "a NumPy archive, which has no standard layout",
    ".mat": "a MATLAB file, which has no standard layout",
    ".pkl": "a Python pickle, which could run code and is not opened",
    ".pickle": "a Python pickle, which could run code and is not opened",
    ".slp": "a SLEAP project; export the analysis HDF5: sio export FILE.slp -o FILE.h5",
    ".h5": f"{_HDF5} (deeplabcut.analyze_videos_converth5_to_csv)",
    ".hdf5": _HDF5,
    ".parquet": "a Parquet table, which has no standard layout",
    ".c3d": "a C3D file of 3D points, but 2D detections are needed",
    "_3d_xyz.csv": _FREEMOCAP_3D,
    "freemocap_data_by_frame.csv": _FREEMOCAP_3D,
    ".trc": "a TRC file of 3D points, but 2D detections are needed",
}


def what_it_is(path: Path) -> str | None:
    """A sentence that identifies an unsupported file and names a way to convert it; None if its
    suffix is unknown.
    """
    known = next(
        (what for ending, what in _OTHERS.items() if path.name.lower().endswith(ending)), None
    )
    if known is None:
        return None
    cure = "" if ";" in known else "; convert it to <camera>.json, COCO's keypoint results"
    return f"{known}{cure}"


def read_freemocap(path: Path, camera: int, cameras: int) -> CameraPeople:
    """Detections of one person in camera number `camera` of `cameras`, in the order of the
    calibration.

    The file is (cameras, frames, points, 2 or 3): pixels, NaN for points that were not detected. A
    third number is a score if all are between 0 and 1, otherwise MediaPipe's depth, which is
    ignored. InputError naming file and cure.
    """
    with open_regular(path) as stream:
        shape, dtype, fortran, offset = _header(path, stream)
        if shape[0] != cameras:
            raise InputError(
                f"{path}: has {shape[0]} cameras, but {cameras} are expected; give the "
                "calibration of the same recording, with all cameras in the same order"
            )
        # Maximum number of values in a file: as many as one hour of four cameras with
        # MediaPipe's 553 points at 30 Hz.
        if np.prod(shape, dtype=float) > 2**29:
            raise InputError(f"{path}: its arrays {shape} are too large; split the recording")
        size = path.stat().st_size - offset
        if size < int(np.prod(shape)) * dtype.itemsize:
            raise InputError(f"{path}: the file ends too early; copy it again")
    order = "F" if fortran else "C"
    every = np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=shape, order=order)
    own = every[camera]
    body = BLAZEPOSE if "mediapipe" in path.name.lower() and shape[2] >= BLAZEPOSE else shape[2]
    third = own[:, :body, 2] if shape[3] == 3 else None
    scored = (
        third is not None
        and not ((third < 0) | (third > 1)).any()
        and bool(np.isfinite(third).any())
    )

    def blocks() -> Iterator[PeopleBlock]:
        for start in range(0, shape[1], BLOCK_FRAMES):
            part = np.array(own[start : start + BLOCK_FRAMES, None, :body], dtype=np.float64)
            score = part[..., 2:] if scored else np.ones((*part.shape[:3], 1))
            points = np.concatenate([part[..., :2], score], axis=3)
            yield PeopleBlock.dense(np.arange(start, start + len(part)), points)

    joints = "mediapipe" if body == BLAZEPOSE else None
    return CameraPeople(path, _FREEMOCAP, blocks(), 0, shape[1] - 1, rerun=_RERUN, joints=joints)


def cameras_of_freemocap(path: Path) -> list[str]:
    """Names for the cameras of FreeMoCap's file, numbered in its order. Raises InputError as
    `read_freemocap` does.
    """
    with open_regular(path) as stream:
        return [f"cam_{n}" for n in range(min(_header(path, stream)[0][0], 1000))]


def _header(path: Path, stream: Any) -> tuple[tuple[int, ...], np.dtype[Any], bool, int]:
    """Shape, type and memory order of the array in an .npy file, and the offset of its values."""
    # NumPy evaluates the header as a Python literal, which raises many kinds of errors.
    with naming(path, "", f"this is not a NumPy array, but {what_it_is(path)}", Exception):
        shape, fortran, dtype = read_npy_header(stream)
    if dtype.hasobject:
        raise InputError(f"{path}: holds Python objects, which could run code; save it as numbers")
    if len(shape) != 4 or shape[3] not in (2, 3) or dtype.kind != "f":
        raise InputError(f"{path}: holds {dtype} of shape {shape}; {what_it_is(path)}")
    return shape, dtype, fortran, stream.tell()


def read_hdf5(path: Path) -> CameraPeople:
    """The people of one camera, from SLEAP's analysis file or DeepLabCut's table.

    InputError naming file and cure.
    """
    h5py = optional("h5py", "hdf5")
    with open_regular(path) as stream:
        if stream.read(8) != b"\x89HDF\r\n\x1a\n":
            raise InputError(f"{path}: this is not an HDF5 file, but {what_it_is(path)}")
    kinds = OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, IndexError
    words = "damaged HDF5 ({:.100})"
    with naming(path, "export it again", words, *kinds), h5py.File(path, "r") as file:
        table = _dataset(h5py, file, _TABLE)
        return _sleap(path, h5py, file) if table is None else _deeplabcut(path, table)


def _deeplabcut(path: Path, table: Any) -> CameraPeople:
    """One person, or each individual, from a pandas table: one row per frame; columns are in one or
    several blocks.
    """
    names = [name for name in table.dtype.names or () if name.startswith("values_block_")]
    columns = [row for name in names for row in _list_of_rows(table.attrs, f"{name}_kind")]
    known = table.ndim == 1 and not table.dtype.hasobject and "index" in (table.dtype.names or ())
    if not known or any(len(row) not in (3, 4) for row in columns):
        raise InputError(f"{path}: {what_it_is(path)}")
    joints, picked = body_parts(
        path, ((row[1] if len(row) == 4 else "", row[-2], row[-1]) for row in columns)
    )
    _check_size(path, table.size * table.dtype.itemsize / 8, table.shape)
    rows = table[:]
    frame, *blocks = (np.asarray(rows[name]) for name in ("index", *names))
    values = np.concatenate(
        [np.zeros((len(rows), 1)), *(each.reshape(len(rows), -1) for each in blocks)], axis=1
    )
    if (
        frame.dtype.kind not in "iu"
        or (np.diff(frame, prepend=-1) <= 0).any()
        or frame.max(initial=0) >= MOST_FRAME
    ):
        raise InputError(f"{path}: frame numbers must be increasing whole numbers; {_RERUN}")
    if len(rows) == 0 or values.shape[1] != 1 + len(columns):
        raise InputError(
            f"{path}: has {len(rows)} frames, and its columns do not match their names; export "
            "it again"
        )
    block = PeopleBlock.dense(frame.astype(np.intp), taken(values.astype(np.float64), picked))
    return CameraPeople(
        path, _DEEPLABCUT, iter([block]), int(frame[0]), int(frame[-1]), rerun=_RERUN, joints=joints
    )


def _list_of_rows(attributes: Any, name: str) -> list[list[str]]:
    """A list of rows of texts, which pandas stores as a pickle: the pickle is parsed as text, and
    nothing is executed.

    ValueError for any other content.
    """
    kind = attributes.get_id(name)
    if kind.dtype.kind != "S" or kind.shape != () or kind.dtype.itemsize > SMALL:
        raise ValueError(f"{name} is not text")
    known, rows, row, last = dict[Any, str](), list[list[str]](), list[str](), ""
    for operation, value, _ in pickletools.genops(bytes(attributes[name])):
        match operation.name:
            case "MARK":
                row = []
            case "UNICODE" | "STRING" | "GET":
                last = known[value] if operation.name == "GET" else str(value)
                row.append(last)
            case "PUT":
                known[value] = last
            case "TUPLE":
                rows.append(row)
            case "LIST" | "APPEND" | "STOP":
                pass
            case other:
                raise ValueError(f"{name} is not a list of names: {other}")
    return rows


def _sleap(path: Path, h5py: Any, file: Any) -> CameraPeople:
    """Read SLEAP's analysis file: each track is one person, and nodes have names."""
    tracks = _dataset(h5py, file, "tracks")
    names = _dataset(h5py, file, "node_names")
    if (
        tracks is None
        or names is None
        or tracks.ndim != 4
        or names.ndim != 1
        or len(names) > _MOST_NAMES
    ):
        raise InputError(f"{path}: {what_it_is(path)}")
    joints = _names(path, names)
    xy, score = _numbers(path, tracks), None
    if (scores := _dataset(h5py, file, "point_scores")) is not None and scores.ndim == 3:
        score = _numbers(path, scores)
    occupancy = _dataset(h5py, file, "track_occupancy")
    if not _frames_first(xy.shape, len(joints), None if occupancy is None else occupancy.shape):
        xy, score = xy.transpose(3, 0, 2, 1), None if score is None else score.transpose(2, 0, 1)
    score = np.ones(xy.shape[:3]) if score is None else score
    if xy.shape[3] != 2 or xy.shape[2] != len(joints) or score.shape != xy.shape[:3]:
        raise InputError(
            f"{path}: tracks are {xy.shape}, but there are {len(joints)} node_names; export it "
            "again with SLEAP"
        )
    points = np.concatenate([xy, np.where(np.isfinite(score), score, 1.0)[..., None]], axis=3)
    parts = (slice(start, start + BLOCK_FRAMES) for start in range(0, len(points), BLOCK_FRAMES))
    blocks = (PeopleBlock.dense(np.arange(len(points))[part], points[part]) for part in parts)
    return CameraPeople(path, _SLEAP, blocks, 0, len(points) - 1, rerun=_RERUN, joints=joints)


def _dataset(h5py: Any, file: Any, name: str) -> Any:
    """A dataset stored in the file itself; None if it does not exist, or if its data are in another
    file.
    """
    found = file
    for part in name.split("/"):
        if not isinstance(found, h5py.Group) or not isinstance(
            found.get(part, getlink=True), h5py.HardLink
        ):
            return None
        found = found[part]
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        return None
    return found


def _names(path: Path, names: Any) -> tuple[str, ...]:
    """The texts of a dataset (N,). Texts of variable length are read by this module, because
    libhdf5 does not check damaged lengths.
    """
    if names.dtype.kind == "S" and names.dtype.itemsize <= _LONGEST_NAME:
        return tuple(each.decode("utf-8") for each in names[:])
    begin = names.id.get_offset() if names.dtype.kind == "O" and names.chunks is None else None
    if begin is None:
        raise InputError(f"{path}: node_names are not text; export it again with SLEAP")
    with open_regular(path) as stream:
        stream.seek(begin)
        records = np.frombuffer(stream.read(len(names) * _RECORD.itemsize), dtype=_RECORD)
        return tuple(
            _from_heap(stream, *map(int, record)).decode("utf-8") for record in records.tolist()
        )


def _from_heap(stream: BinaryIO, length: int, address: int, index: int) -> bytes:
    """A text from one of HDF5's global heaps; ValueError if it does not exist."""
    stream.seek(address)
    head = stream.read(16)
    size = int.from_bytes(head[8:], "little")
    if head[:4] != b"GCOL" or not 16 <= size <= SMALL or length > _LONGEST_NAME:
        raise ValueError("the position of a text is invalid")
    heap, at = stream.read(size - 16), 0
    while at + 16 <= len(heap):
        number, begin = int.from_bytes(heap[at : at + 2], "little"), at + 16
        if number == index:
            return heap[begin : begin + length]
        at = begin + -(-int.from_bytes(heap[at + 8 : begin], "little") // 8) * 8
    raise ValueError("a text is outside its heap")


def _frames_first(tracks: tuple[int, ...], nodes: int, occupancy: tuple[int, ...] | None) -> bool:
    """Whether `tracks` are (frames, tracks, nodes, 2), the default of sleap-io, instead of MATLAB's
    order (tracks, 2, nodes, frames). `occupancy` is (frames, tracks) in both.
    """
    standard, matlab = tracks[2:] == (nodes, 2), tracks[1:3] == (2, nodes)
    if standard and matlab and occupancy is not None:
        return occupancy != (tracks[3], tracks[0])
    return standard and not matlab


def _numbers(path: Path, dataset: Any) -> Array:
    """All values of a dataset."""
    _check_size(path, dataset.size if dataset.dtype.kind in "fiu" else np.inf, dataset.shape)
    return np.asarray(dataset[:], dtype=np.float64)


def _check_size(path: Path, count: float, shape: tuple[int, ...]) -> None:
    """Raise InputError if the file is too small for this number of values."""
    if 8 * count > max(BIG, MOST_PACKED * path.stat().st_size):
        raise InputError(
            f"{path}: its arrays {shape} are too large; export a part of the recording"
        )
