"""A saved result as what is exported: with its cameras, its up axis and its body model."""

from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import OpenedReconstruction, Reconstruction
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.solved_setup import CAMERAS


def read_take(
    path: Path,
    *,
    up: Axis | None = None,
    fps: float | None = None,
    seen_only: bool = False,
    frames: range | None = None,
    persons: tuple[int, ...] | None = None,
    identities: bool = True,
    observations: bool = True,
) -> Take:
    """What of the result at `path` is exported; InputError, one sentence, where it cannot be.

    `up` is asked for where there is no cameras.json beside people.npz. `frames` and `persons` choose rows;
    `observations` says whether what they were solved from is read, too.
    """
    cameras = results_folder(path) / CAMERAS
    if up is not None and up not in get_args(Axis):
        raise InputError(f"--up {up}: must be one of x -x y -y z -z")
    with Reconstruction.open(path) as opened:
        rig = read_rig(cameras) if cameras.is_file() else None
        if up is None and rig is None:
            raise InputError(f"{cameras}: it is not there to say which axis is up; give --up, such as --up z")
        people = opened.rows(chosen_rows(opened, path, frames, persons), observations=observations)
    if frames is not None:  # of those that were reconstructed the ones that are asked for
        spans = covered_frames(people.run) or []
        cut = [[max(span.start, frames.start), min(span.stop, frames.stop)] for span in spans]
        people = people.with_run(frames=[[start, stop] for start, stop in cut if start < stop])
    axis: Any = up or (rig.up if rig is not None else None)
    try:
        return Take.of(people, axis, rig=rig, fps=fps, seen_only=seen_only, identities=identities)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def chosen_rows(
    opened: OpenedReconstruction, path: Path, frames: range | None, persons: tuple[int, ...] | None
) -> NDArray[np.intp] | None:
    """(R,) rows of these frames and people; None for all. InputError for somebody who is not there."""
    if frames is None and persons is None:
        return None
    chosen = np.ones(len(opened), dtype=bool)
    if persons is not None:
        strangers = sorted(set(persons) - set(opened.person.tolist()))
        if strangers:
            there = " ".join(map(str, np.unique(opened.person).tolist()))
            raise InputError(f"--person {strangers[0]}: {path} has no such person; it has {there}")
        chosen &= np.isin(opened.person, persons)
    if frames is not None:
        chosen &= (opened.frame >= frames.start) & (opened.frame < frames.stop)
        there = opened.frame if persons is None else opened.frame[np.isin(opened.person, persons)]
        if len(there) > 0 and not chosen.any():
            raise InputError(
                f"--frames: {path} has nobody in these frames; people are in frames {there.min()} to {there.max()}"
            )
    return np.flatnonzero(chosen)


def body_file(take: Take, given: Path | None) -> Path | None:
    """File of the body model that a result was made with, or the one `given`; None for the one that ships."""
    named = take.people.run.get("body")
    if given is not None or named is None:
        return given
    return Path(str(named))
