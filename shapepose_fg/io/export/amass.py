"""AMASS-style npz, the motion of a SMPL body as learning code reads it: z up, metres, radians."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import write_npz
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.skinned import RestBody, Segment, all_segments
from shapepose_fg.io.export.take import z_up

_SMPL_H = 156
"""Numbers of a pose of SMPL-H: pelvis, 21 joints of the body, 15 of each hand."""
_SHARED = 22
"""Joints, from the pelvis on, that SMPL and SMPL-H have alike."""
_AMASS_BETAS = 16
"""Shape components in AMASS."""
OPEN_BODY = "shapepose-fg open body"
"""What the body that ships is called in a file."""


def write_amass(job: Job) -> Written:
    """A file per person and segment of frames without a long hole, named by its first and last frame."""
    written = Written()
    body = OPEN_BODY if job.body_file is None else job.body_file.name
    for who, rest, segment, take in all_segments(job, "amass", z_up(job.take.up), written):
        frames, times = take.frames[segment.index], take.times_s[segment.index]
        path = job.folder / f"person_{who}_frames_{frames[0]}-{frames[-1]}_amass.npz"
        columns = amass_columns(rest, segment, take.fps) | {
            "times": times, "frames": frames, "body": np.array(body), "gender": np.array(_gender(body)),
        }  # fmt: skip
        write_atomically(path, lambda stream, columns=columns: write_npz(stream, columns))
        written.files.append(path)
    if job.body_file is None and len(written.files) > 0:
        written.notes.append("amass: betas are those of the open body that ships, not SMPL's; poses fit both")
    return written


def amass_columns(rest: RestBody, segment: Segment, fps: float) -> dict[str, NDArray[Any]]:
    """The arrays of AMASS for one segment of one person.

    `poses` (F, 156) are SMPL-H's: pelvis and body are ours; SMPL's two hand joints have no counterpart there, so
    the fingers are zero, which is SMPL-H's flat hand. `poses_smpl` (F, 72) are all 24 joints of SMPL.
    """
    frames = len(segment.index)
    vectors = Rotation.from_quat(segment.rotations.reshape(-1, 4)).as_rotvec().reshape(frames, -1)
    poses = np.zeros((frames, _SMPL_H))
    poses[:, : 3 * _SHARED] = vectors[:, : 3 * _SHARED]
    betas = np.zeros(_AMASS_BETAS)
    betas[: len(rest.betas)] = rest.betas
    return {
        "trans": segment.pelvis - rest.joints[0],
        "poses": poses,
        "poses_smpl": vectors,
        "betas": betas,
        "num_betas": np.array(len(rest.betas)),
        # Older and newer files of AMASS spell it differently.
        "mocap_framerate": np.array(fps),
        "mocap_frame_rate": np.array(fps),
        "filled": segment.filled,
    }


def _gender(body: str) -> str:
    """The gender of a body model by the name of its file, as SMPL's are called; neutral where it says nothing."""
    name = body.lower().replace("-", "_")
    words = name.replace(".", "_").split("_")
    if "female" in words or "f" in words:
        return "female"
    return "male" if "male" in words or "m" in words else "neutral"
