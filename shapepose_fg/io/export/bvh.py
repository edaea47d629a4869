"""BVH, a skeleton with its motion, as Blender and other animation programs read it: y up, metres."""

import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.skinned import BONES, RestBody, all_segments
from shapepose_fg.io.export.take import y_up


def write_bvh(job: Job) -> Written:
    """A file per person and segment of frames without a long hole, named by its first and last frame."""
    written = Written()
    for who, rest, segment, take in all_segments(job, "bvh", y_up(job.take.up), written):
        first, last = take.frames[segment.index[[0, -1]]].tolist()
        path = job.folder / f"person_{who}_frames_{first}-{last}.bvh"
        written.add(path, bvh_text(rest, segment.rotations, segment.pelvis, take.fps))
    return written


def bvh_text(rest: RestBody, rotations: NDArray[np.float64], pelvis: NDArray[np.float64], fps: float) -> str:
    """A BVH file: the T-pose of `rest`, and per frame quaternions (F, 24, 4) and pelvis (F, 3), metres.

    The pelvis' own offset is zero: some programs add it to the place of a frame, others do not.
    """
    lines = ["HIERARCHY", *_joint(0, rest, ""), "MOTION", f"Frames: {len(pelvis)}", f"Frame Time: {1 / fps:.9f}"]
    angles = _zxy_degrees(rotations[:, _ORDER]).reshape(len(pelvis), -1)
    # The rounding is a hundredth of a millimetre at the end of the longest chain.
    rows = np.concatenate([np.char.mod("%.6f", pelvis), np.char.mod("%.5f", angles)], axis=1).tolist()
    return "\n".join([*lines, *(" ".join(row) for row in rows)]) + "\n"


def _zxy_degrees(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, B, 3) angles about z, then the turned x, then the turned y, degrees, of quaternions (F, B, 4).

    From frame to frame no angle jumps by a full turn: programs that draw between frames go along the line.
    """
    with warnings.catch_warnings():
        # With x at 90 degrees z and y are one turn; any split of it will do.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_quat(rotations.reshape(-1, 4)).as_euler("ZXY", degrees=True)
    return np.unwrap(angles.reshape(*rotations.shape[:2], 3), axis=0, period=360)


def _tree(joint: int) -> Iterator[int]:
    """A joint and all below it, as they stand in the file."""
    yield joint
    for child in range(BONES):
        if SMPL_PARENTS[child] == joint:
            yield from _tree(child)


_ORDER = np.array(list(_tree(0)))
"""SMPL's joints in the order of the file: channels follow the hierarchy."""


def _joint(joint: int, rest: RestBody, indent: str) -> Iterator[str]:
    """The lines of a joint and of all below it."""
    offset = np.zeros(3) if joint == 0 else rest.offsets[joint]
    yield f"{indent}{'ROOT' if joint == 0 else 'JOINT'} {SMPL_24[joint]}"
    yield indent + "{"
    inside = indent + "\t"
    yield f"{inside}OFFSET {_vector(offset)}"
    place = "6 Xposition Yposition Zposition" if joint == 0 else "3"
    yield f"{inside}CHANNELS {place} Zrotation Xrotation Yrotation"
    children = [child for child in range(BONES) if SMPL_PARENTS[child] == joint]
    for child in children:
        yield from _joint(child, rest, inside)
    if len(children) == 0:
        yield from (
            f"{inside}End Site",
            inside + "{",
            f"{inside}\tOFFSET {_vector(rest.tips()[joint])}",
            inside + "}",
        )
    yield indent + "}"


def _vector(xyz: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.6f}" for value in xyz)
