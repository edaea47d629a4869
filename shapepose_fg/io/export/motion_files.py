"""Exports motions of bodies: AMASS-style npz for learning code (z up, metres, radians), and BVH for
animation (y up).
"""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import write_npz
from shapepose_fg.core.world_axes import y_up, z_up
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.skinned import BONES, RestBody, SkinnedMotion, all_segments

_SHARED = SMPL_24.index("left_hand")
"""Number of joints, from the pelvis on, that SMPL and SMPL-H have in common."""
OPEN_BODY = "shapepose-fg open body"
"""Name of the built-in body model in files."""


def write_amass(job: Job) -> Written:
    """Write a file per person and segment without long gaps, named by its first and last frame."""
    written = Written()
    body = OPEN_BODY if job.body is None else job.body.name
    for name, segment, take in all_segments(job, "amass", z_up(job.take.up), written):
        columns = amass_columns(segment, take.fps) | {
            "times": take.times_s[segment.index],
            "frames": take.frames[segment.index],
            "body": np.array(body),
            "gender": np.array(_gender(body)),
        }
        path = name.with_name(f"{name.name}_amass.npz")
        write_atomically(path, lambda stream, columns=columns: write_npz(stream, columns))
        written.files.append(path)
    if job.body is None and len(written.files) > 0:
        written.notes.append(
            "amass: betas are those of the built-in body model, not of SMPL; poses fit both"
        )
    return written


def amass_columns(segment: SkinnedMotion, fps: float) -> dict[str, NDArray[Any]]:
    """The arrays of AMASS for one segment of one person.

    `poses` (F, 156) are SMPL-H's: pelvis and body are ours; SMPL's two hand joints have no
    counterpart in SMPL-H, so all finger rotations are zero (a flat hand). `poses_smpl` (F, 72) are
    all 24 joints of SMPL.
    """
    frames, rest = len(segment.index), segment.rest
    vectors = Rotation.from_quat(segment.rotations.reshape(-1, 4)).as_rotvec().reshape(frames, -1)
    # Number of values of a pose of SMPL-H: pelvis, 21 joints of the body, 15 of each hand.
    poses = np.zeros((frames, 156))
    poses[:, : 3 * _SHARED] = vectors[:, : 3 * _SHARED]
    # Number of shape components in AMASS.
    return {
        "trans": segment.pelvis - rest.joints[0],
        "poses": poses,
        "poses_smpl": vectors,
        "betas": np.pad(rest.betas, (0, 16 - len(rest.betas))),
        "num_betas": np.array(len(rest.betas)),
        # Older and newer files of AMASS spell this key differently.
        "mocap_framerate": np.array(fps),
        "mocap_frame_rate": np.array(fps),
        "filled": np.asarray(segment.filled),
    }


def _gender(body: str) -> str:
    """The gender of a body model by its file name, in SMPL's style; neutral if the name has
    none.
    """
    name = body.lower().replace("-", "_")
    words = name.replace(".", "_").split("_")
    if "female" in words or "f" in words:
        return "female"
    return "male" if "male" in words or "m" in words else "neutral"


def write_bvh(job: Job) -> Written:
    """Write a file per person and segment without long gaps, named by its first and last frame."""
    written = Written()
    for name, segment, take in all_segments(job, "bvh", y_up(job.take.up), written):
        written.add(name.with_name(f"{name.name}.bvh"), bvh_text(segment, take.fps))
    return written


def bvh_text(motion: SkinnedMotion, fps: float) -> str:
    """A BVH file: the T-pose, and per frame the position of the pelvis and the rotations.

    The pelvis has offset zero, because some programs add the offset to its position in a frame, and
    others do not.
    """
    count = len(motion.index)
    lines = [
        "HIERARCHY",
        *_joint(0, motion.rest, ""),
        "MOTION",
        f"Frames: {count}",
        f"Frame Time: {1 / fps:.12g}",
    ]
    angles = _zxy_degrees(motion.rotations[:, _ORDER]).reshape(count, -1)
    # Rounding errors are a hundredth of a millimetre at the end of the longest chain.
    rows = np.concatenate(
        [np.char.mod("%.6f", motion.pelvis), np.char.mod("%.5f", angles)], axis=1
    ).tolist()
    return "\n".join([*lines, *(" ".join(row) for row in rows)]) + "\n"


def _zxy_degrees(rotations: Array) -> Array:
    """Euler angles (F, B, 3) of quaternions (F, B, 4), degrees: about z, then the rotated x, then
    the rotated y.

    No angle jumps by a full turn between frames, because programs interpolate angles linearly.
    """
    with warnings.catch_warnings():
        # With x at 90 degrees, z and y rotate about the same axis (gimbal lock); any split is
        # valid.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_quat(rotations.reshape(-1, 4)).as_euler("ZXY", degrees=True)
    return np.unwrap(angles.reshape(*rotations.shape[:2], 3), axis=0, period=360)


_CHILDREN = [
    [child for child in range(BONES) if SMPL_PARENTS[child] == joint] for joint in range(BONES)
]


def _tree(joint: int) -> Iterator[int]:
    """A joint and all its descendants, in the order of the file."""
    yield joint
    for child in _CHILDREN[joint]:
        yield from _tree(child)


_ORDER = np.array(list(_tree(0)))
"""SMPL's joints in the order of the file; channels follow the hierarchy."""


def _joint(joint: int, rest: RestBody, indent: str) -> Iterator[str]:
    """The lines of a joint and of all its descendants."""
    yield f"{indent}{'ROOT' if joint == 0 else 'JOINT'} {SMPL_24[joint]}"
    yield indent + "{"
    inside, place = indent + "\t", "6 Xposition Yposition Zposition" if joint == 0 else "3"
    yield f"{inside}OFFSET {_vector(np.zeros(3) if joint == 0 else rest.offsets[joint])}"
    yield f"{inside}CHANNELS {place} Zrotation Xrotation Yrotation"
    for child in _CHILDREN[joint]:
        yield from _joint(child, rest, inside)
    if len(_CHILDREN[joint]) == 0:
        yield f"{inside}End Site"
        yield inside + "{"
        yield f"{inside}\tOFFSET {_vector(rest.tips()[joint])}"
        yield inside + "}"
    yield indent + "}"


def _vector(xyz: Array) -> str:
    return " ".join(f"{value:.6f}" for value in xyz)
