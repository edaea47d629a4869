"""Poses of recorded people, by frame: CMU's .npz or a folder of AMASS files, with a fixed split by
subject.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, MIRROR
from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SMPL_24, smpl_joints
from shapepose_fg.core.storage.files import files_below
from shapepose_fg.core.storage.schema import Column, Table
from shapepose_fg.io.amass import read_amass
from shapepose_fg.simulation.mocap import Clip, Mocap, shoulder_rhythm

Split = Literal["train", "validation", "test"]

SPLITS: tuple[Split, ...] = get_args(Split)
"""Names of the splits: for training, for choosing settings, and for reporting."""

TEST_SUBJECTS = ("60", "61", "02", "08", "16", "43", "94", "139")
"""CMU subjects for reported figures only: salsa (both partners), sports and chores, walks, runs and
jumps, a bar, Indian dance, getting up."""
VALIDATION_SUBJECTS = ("06", "12", "127", "140")
"""CMU subjects on which settings are chosen: basketball, walks, runs and ducks, getting up from the
floor."""
UNKNOWN_SUBJECT = "?"
"""Subject of a recording without one: used for training only."""

MIRROR_JOINTS = tuple(place - BODY_POINTS.index(SMPL_24[0]) for place in MIRROR[-len(SMPL_24) :])
"""(24,) index of each SMPL joint's partner on the other side of the body; its own for joints in the
middle."""

SUBJECT_CAP = 1500
"""Maximum weight of one subject, frames: 13,000 frames of one climber show one person's habits."""
WALK_CAP = 0.25
"""Maximum share of walking in the weight of a split. With 0.25 instead of 0.15, likelihoods of
unseen people's walks rise by 1.6 nats a frame, and those of all else fall by 0.1; without a cap by
a further 0.6 and 0.1."""

_WRISTS, _HANDS, _TOES = (
    smpl_joints(f"left_{name} right_{name}") for name in ("wrist", "hand", "foot")
)
_SHARED = SMPL_24.index("left_hand")
"""Number of joints, from the root on, that SMPL, SMPL+H and SMPL-X files have in common."""
_NOT_MOTIONS = ("shape.npz", "_stagei.npz")
"""Suffixes of other files than motions in AMASS."""


def split_of(subject: str) -> Split:
    """The split of a `subject`.

    CMU's subjects have their original numbers ("02", "139"), so that copies of a recording in other
    collections are in the same split. Others are assigned by a stable hash of the name, 8 : 1 : 1.
    """
    if subject in TEST_SUBJECTS:
        return "test"
    if subject in VALIDATION_SUBJECTS:
        return "validation"
    cmu = subject.isascii() and subject.isdigit() and len(subject) >= 2 and int(subject) <= 144
    tenth = hashlib.sha256(subject.encode()).digest()[0] % 10
    if subject == UNKNOWN_SUBJECT or cmu or tenth < 8:
        return "train"
    return "validation" if tenth == 8 else "test"


@dataclass(frozen=True)
class Motions(Table):
    """Poses of many people in SMPL's structure: N frames of S recordings.

    Collars that were not recorded follow the arms as they do in the simulator; unrecorded wrists,
    toes and hands are zero. World frame: y up, SMPL's own.
    """

    poses: Annotated[NDArray[np.float32], Column("N 24 3", np.float32)]
    """(N, 24, 3) axis-angle, rad: the root's in the world, the other joints' relative to their
    parents."""
    weight: Annotated[Array, Column("N")]
    """(N,) weight of each frame, at most 1: recordings, subjects and walking are capped within
    their split."""
    subject: Annotated[NDArray[np.str_], Column("N", np.str_)]
    """(N,) recorded subject."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.poses).all():
            raise ValueError("poses must be finite: leave out frames that were not recorded")

    def of(self, split: Split) -> "Motions":
        """The frames of the subjects of one split."""
        if split not in SPLITS:
            raise ValueError(f"split must be one of {' '.join(SPLITS)}, got {split!r}")
        subjects, place = np.unique(self.subject, return_inverse=True)
        return self.rows(
            np.array([split_of(str(name)) == split for name in subjects], dtype=bool)[place]
        )


def drawn_motions(count: int, seed: int) -> Motions:
    """Poses sampled from the prior, upright and with any heading: training data without
    recordings.
    """
    rng = np.random.default_rng(seed)
    # Standard deviation of the lean of sampled people, rad.
    root = rng.normal(0, 0.15, (count, 1, 3))
    root[:, 0, 1] = rng.uniform(-np.pi, np.pi, count)
    poses = np.concatenate((root, PosePrior.default().sample(rng, count)), axis=1).astype(
        np.float32
    )
    return Motions(poses, np.ones(count), np.full(count, UNKNOWN_SUBJECT))


_Recording = tuple[str, bool, NDArray[np.float32]]
"""Subject, whether it is walking, poses (T, 24, 3)."""


def load_motions(path: str | Path) -> Motions:
    """Read all recordings in `path`; raises InputError if it is unusable.

    A file is read as CMU's motions in SMPL's structure (`simulation.mocap`), a folder as AMASS: all
    `.npz` in it and below, with `poses` (T, 66 or more) and `mocap_framerate` or
    `mocap_frame_rate`; the subject is the name of the file's folder.
    """
    path = Path(path)
    if path.is_dir():
        files = [
            file
            for file in sorted(files_below(path, (".npz",)))
            if not file.name.endswith(_NOT_MOTIONS)
        ]
        recordings = [_read_amass(file) for file in files]
    else:
        mocap = Mocap.load(path)
        recordings = [_of_clip(mocap.clip(index)) for index in range(len(mocap))]
    if len(recordings) == 0:
        raise InputError(
            f"{path}: holds no recordings, or no .npz; give CMU's file or a folder of AMASS motions"
        )
    subject, walking, poses = zip(*recordings, strict=True)
    length = np.array([len(each) for each in poses])
    return Motions(
        poses=np.concatenate(poses),
        weight=np.repeat(frame_weights(length, np.array(subject), np.array(walking)), length),
        subject=np.repeat(subject, length),
    )


def frame_weights(length: Whole, subject: NDArray[np.str_], walking: Mask) -> Array:
    """Weight (S,) of a frame in each of S recordings: recordings, subjects and walking are capped,
    per split.
    """
    # Maximum weight of one recording, frames (10 s).
    total = np.minimum(length.astype(np.float64), 300)
    for name in np.unique(subject):
        rows = subject == name
        total[rows] *= min(1.0, SUBJECT_CAP / total[rows].sum())
    splits = np.array([split_of(str(name)) for name in subject])
    for split in SPLITS:
        walks, rest = walking & (splits == split), total[~walking & (splits == split)].sum()
        if walks.any() and rest > 0:
            total[walks] *= min(1.0, rest * WALK_CAP / (1 - WALK_CAP) / total[walks].sum())
    return total / length


def pose_vectors(clip: Clip) -> Array:
    """(T, 24, 3) axis-angle rotations of a clip, with collars that follow the arms; unrecorded
    wrists, toes and hands are zero.
    """
    rotations = shoulder_rhythm(clip.rotations)
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 24, 3)
    for joints, recorded in ((_HANDS, False), (_WRISTS, clip.wrist_valid), (_TOES, clip.toe_valid)):
        if not recorded:
            vectors[:, list(joints)] = 0.0
    return vectors


def _of_clip(clip: Clip) -> _Recording:
    return clip.subject, "walk" in clip.action.lower(), pose_vectors(clip).astype(np.float32)


def _read_amass(path: Path) -> _Recording:
    """One AMASS file, decimated to about 30 Hz and rotated to y up, without hands."""
    motion = read_amass(path)
    if not 0 < motion.fps < np.inf:
        raise InputError(f"{path}: mocap_framerate must be one positive number; correct it")
    poses = motion.poses
    # Approximate frame rate to which AMASS recordings are decimated, Hz: every k-th frame,
    # without interpolation.
    step = max(1, round(motion.fps / 30.0))
    kept = np.zeros((len(poses[::step]), 24, 3))
    kept[:, :_SHARED] = poses[::step, : 3 * _SHARED].reshape(-1, _SHARED, 3)
    # Rotation from AMASS, z up, to SMPL's own frame, y up.
    kept[:, 0] = (
        Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0]) * Rotation.from_rotvec(kept[:, 0])
    ).as_rotvec()
    return path.parent.name, "walk" in path.stem.lower(), kept.astype(np.float32)
