"""What comes out: the people of every frame, as arrays with one row per person and frame."""

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json, write_atomically
from shapepose_fg.skeleton import BODY_25


class Status(StrEnum):
    """How far the reconstruction of one person in one frame came."""

    OK = "ok"
    """Joints and body are determined."""
    TOO_FEW_VIEWS = "too few views"
    """No joint is seen by two views, or too few are: nothing fixes the person in space."""
    BODY_UNDETERMINED = "body undetermined"
    """Joints are there, but too few of them to fit a body; what no view saw stays NaN."""
    NOT_SOLVED = "not solved"
    """A joint ran away from what was seen of it, or nothing determines it: `run` names person, frame and joint."""


@dataclass(frozen=True)
class Reconstruction:
    """The people of a recording: N rows, one per person and frame, sorted as they were added."""

    frame: NDArray[np.integer]
    """(N,) frame of each row, counted from 0 in the file."""
    person: NDArray[np.integer]
    """(N,) identity of the person; without tracking, a number within the frame."""
    joint_names: NDArray[np.str_]
    """(J,) names of the joints, as OpenPose writes them."""
    joints: NDArray[np.float64]
    """(N, J, 3) joint positions in the world, metres; NaN where unknown."""
    covariance: NDArray[np.float64]
    """(N, J, 3, 3) covariance of each joint's position, square metres; NaN where unknown."""
    confidence: NDArray[np.float64]
    """(N, J) mean confidence of a joint's observations over all views, 0 to 1."""
    betas: NDArray[np.float64]
    """(N, 10) shape of the body, standard deviations; NaN where there is no body."""
    global_orient: NDArray[np.float64]
    """(N, 3) orientation of the pelvis in the world, axis times angle, radians."""
    body_pose: NDArray[np.float64]
    """(N, 23, 3) rotation of every other body joint against its parent, axis times angle, radians."""
    transl: NDArray[np.float64]
    """(N, 3) translation of the body, metres."""
    status: NDArray[np.str_]
    """(N,) one of the values of `Status`."""
    run: dict[str, Any] = field(default_factory=dict)
    """How this came about: configuration, versions, checksums, times (goes to run.json)."""

    ROWS: ClassVar = (
        "frame person joints covariance confidence betas global_orient body_pose transl status".split()
    )
    """The columns that have one entry per row."""

    def __post_init__(self) -> None:
        """Check every shape, once."""
        N, J = np.size(self.frame), np.size(self.joint_names)
        shapes = {"frame": (N,), "person": (N,), "joint_names": (J,), "joints": (N, J, 3)}
        shapes |= {"covariance": (N, J, 3, 3), "confidence": (N, J), "betas": (N, 10)}
        shapes |= {"global_orient": (N, 3), "body_pose": (N, 23, 3), "transl": (N, 3), "status": (N,)}
        for name, shape in shapes.items():
            kind, wanted = _KINDS.get(name, ("f", np.dtype(np.float64)))
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {value.shape}")
            if value.dtype.kind not in kind and value.size > 0:
                raise ValueError(f"{name} must hold {wanted} values, got {value.dtype}")
            # Fixed-width text keeps its own width; everything else gets one type.
            text = wanted.kind == "U"
            object.__setattr__(self, name, value.astype(str if text else wanted, copy=False))
        unknown = set(np.unique(self.status).tolist()) - set(Status)
        if len(unknown) > 0:
            raise ValueError(f"status must be one of {[*map(str, Status)]}, got {sorted(unknown)}")

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def empty(cls, joint_names: Sequence[str] = BODY_25.joints) -> "Reconstruction":
        """Nobody."""
        J = len(joint_names)
        return cls(
            frame=np.zeros(0, dtype=np.int64),
            person=np.zeros(0, dtype=np.int64),
            joint_names=np.array(joint_names),
            joints=np.zeros((0, J, 3)),
            covariance=np.zeros((0, J, 3, 3)),
            confidence=np.zeros((0, J)),
            betas=np.zeros((0, 10)),
            global_orient=np.zeros((0, 3)),
            body_pose=np.zeros((0, 23, 3)),
            transl=np.zeros((0, 3)),
            status=np.zeros(0, dtype="U1"),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["Reconstruction"]) -> "Reconstruction":
        """The rows of `parts`, one after the other; `run` is the first part's."""
        if len(parts) == 0:
            return cls.empty()
        first = parts[0]
        for part in parts:
            if not np.array_equal(part.joint_names, first.joint_names):
                raise ValueError("parts must have the same joint_names")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.ROWS}
        return replace(first, **columns)

    def rows(self, index: NDArray) -> "Reconstruction":
        """The rows that `index` picks: a mask (N,) or row numbers."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.ROWS})

    def at(self, frame: int) -> "Reconstruction":
        """The people of one frame."""
        return self.rows(self.frame == frame)

    def with_run(self, **entries: Any) -> "Reconstruction":
        """The same people, with more to say in run.json."""
        return replace(self, run=self.run | entries)

    def save(self, folder: str | Path) -> None:
        """Write people.npz and run.json into `folder`, each whole or not at all (docs/conventions.md).

        A process killed on the way leaves each file as it was or as it shall be. OSError where `folder`
        cannot be written.
        """
        folder = Path(folder)
        columns = {name: getattr(self, name) for name in (*self.ROWS, "joint_names")}
        run = json.dumps(self.run, indent=2, allow_nan=False, default=_plain) + "\n"
        people = io.BytesIO()
        np.savez_compressed(people, **columns)
        # Both are complete in memory before the first is touched.
        write_atomically(folder / "people.npz", lambda stream: stream.write(people.getbuffer()))
        write_atomically(folder / "run.json", lambda stream: stream.write(run.encode()))

    @classmethod
    def load(cls, path: str | Path) -> "Reconstruction":
        """Read what `save` wrote: its folder, or the people.npz in it. InputError on anything else.

        `run` is empty where there is no run.json beside it.
        """
        path = Path(path)
        file = path / "people.npz" if path.is_dir() else path
        columns = _read_npz(file)
        names = (*cls.ROWS, "joint_names")
        for name in names:
            if name not in columns:
                raise InputError(f"{file}: column {name} is missing; give the people.npz of a reconstruction")
        run_file = file.with_name("run.json")
        run = read_json(run_file) if run_file.is_file() else {}
        if not isinstance(run, dict):
            raise InputError(f"{run_file}: must hold an object; restore it or delete it")
        try:
            return cls(**{name: columns[name] for name in names}, run=run)
        except ValueError as error:
            raise InputError(f"{file}: {error}; give the people.npz of a reconstruction") from None


_KINDS = {
    "frame": ("iu", np.dtype(np.int64)),
    "person": ("iu", np.dtype(np.int64)),
    "joint_names": ("U", np.dtype(np.str_)),
    "status": ("U", np.dtype(np.str_)),
}
"""NumPy kinds that a column may have, and the type that it is given; every other column is float64."""


def _plain(value: object) -> object:
    """What JSON can hold of `value`: arrays as lists, paths as text."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"run must hold plain values, got {type(value).__name__}")


def _read_npz(file: Path) -> dict[str, NDArray]:
    """The arrays of an .npz file, none of them pickled."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(f"{file}: there is no such file; run a reconstruction first") from None
    except (ValueError, TypeError, EOFError, KeyError, OSError, zlib.error, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{file}: cannot be read as an .npz file without pickled objects ({reason});"
            " give the people.npz of a reconstruction"
        ) from None
