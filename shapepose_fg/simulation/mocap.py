"""Recorded motions in SMPL's pose structure: one .npz of clips, read and validated.

Arrays of the file, for N frames, S clips, K pairs: `poses` (N, 24, 3) local axis-angle rotations
relative to SMPL's T-pose, y up, row 0 the global orientation; `trans` (N, 3) the pelvis' position
(not SMPL's `transl`); `seq_start`, `seq_len`, `fps`, `names`, `subject`, `action`, `tier`,
`wrist_valid`, `toe_valid`, `leg_m`, `floor_y` (S,); `pairs` (K, 2) clips of two people together;
`parents` (24,).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.decompositions import rotation_angle
from shapepose_fg.core.errors import naming
from shapepose_fg.core.storage.npz import read_npz
from shapepose_fg.core.storage.schema import Column, checked_columns
from shapepose_fg.simulation.limbs import ARMS

_OF_CLIP = {
    **dict.fromkeys(("seq_start", "seq_len", "tier"), Column("S", np.int64)),
    "fps": Column("S", least=1e-3, finite=True),
    "leg_m": Column("S", least=0.1, finite=True),
    "floor_y": Column("S", finite=True),
    **dict.fromkeys(("wrist_valid", "toe_valid"), Column("S", np.bool_)),
    **dict.fromkeys(("names", "subject", "action"), Column("S", np.str_)),
}
_ARRAYS = _OF_CLIP | {
    "poses": Column("N 24 3", np.float32, finite=True),
    "trans": Column("N 3", np.float32, finite=True),
    "pairs": Column("K 2", np.int64),
    "parents": Column("24", np.int64),
}

COLLARS, SHOULDERS, *_ = zip(*ARMS, strict=True)
"""Left and right collar, and shoulder, as indices of SMPL's joints."""
_SETTING = np.radians(30.0)
"""Elevation of the arm, rad, below which only the glenohumeral joint moves (Inman, Saunders and
Abbott 1944)."""


@dataclass(frozen=True)
class Clip:
    """Consecutive frames of a recorded person."""

    name: str
    """Subject, trial and segment, as "60_01#0"."""
    subject: str
    """Identifier of the recorded person."""
    action: str
    """Action in words."""
    rotations: Array
    """(T, 24, 3, 3) local rotations in SMPL's structure, y up."""
    pelvis: Array
    """(T, 3) position of the pelvis, y up, metres."""
    fps: float
    """Frame rate, Hz."""
    leg_m: float
    """Length of the recorded leg, m."""
    floor_y: float
    """Height of the floor, m."""
    wrist_valid: bool
    """Whether the wrists were recorded."""
    toe_valid: bool
    """Whether the toes were recorded."""

    def __len__(self) -> int:
        """Number of frames, T."""
        return len(self.pelvis)

    def between(self, start: int, stop: int) -> "Clip":
        """The frames from `start` up to `stop`."""
        return replace(self, rotations=self.rotations[start:stop], pelvis=self.pelvis[start:stop])

    def resampled(self, fps: float) -> "Clip":
        """Return the motion at another frame rate: rotations by slerp, positions linearly."""
        if fps == self.fps or len(self) < 2:
            return replace(self, fps=fps)
        time = (
            np.arange(int(np.floor((len(self) - 1) * fps / self.fps + 1e-9)) + 1) * self.fps / fps
        )
        low = np.minimum(time.astype(int), len(self) - 2)
        share = np.asarray(time - low, dtype=np.float64)
        rotations = blend(self.rotations[low], self.rotations[low + 1], share)
        pelvis = self.pelvis[low] + share[:, None] * (self.pelvis[low + 1] - self.pelvis[low])
        return replace(self, rotations=rotations, pelvis=pelvis, fps=fps)


@dataclass(frozen=True)
class Mocap:
    """A file of recorded motions; clips are extracted on demand."""

    names: tuple[str, ...]
    """(S,) names of the clips."""
    subjects: tuple[str, ...]
    """(S,) identifiers of the recorded people."""
    actions: tuple[str, ...]
    """(S,) actions."""
    lengths: NDArray[np.int64]
    """(S,) numbers of frames."""
    tiers: NDArray[np.int64]
    """(S,) processing of the clip: 0 with its own skeleton, 1 and 2 retargeted."""
    pairs: tuple[tuple[int, int], ...]
    """Clips of two people together, with the same frames and a common origin."""
    arrays: dict[str, NDArray]
    """The arrays of the file."""

    def __len__(self) -> int:
        """Number of clips, S."""
        return len(self.names)

    @classmethod
    def load(cls, path: str | Path) -> "Mocap":
        """Read the recordings in `path` (.npz); raises InputError if it is unusable."""
        cure = "give motions in SMPL's structure"
        arrays = read_npz(Path(path), _ARRAYS, cure)
        with naming(path, cure):
            arrays = checked_columns(_ARRAYS, arrays, {})
            _check(arrays)
        names, subjects, actions = (
            tuple(map(str, arrays[name])) for name in ("names", "subject", "action")
        )
        pairs = tuple((int(lead), int(follow)) for lead, follow in arrays["pairs"])
        return cls(names, subjects, actions, arrays["seq_len"], arrays["tier"], pairs, arrays)

    def clip(self, index: int) -> Clip:
        """Clip `index`, with glitches of single markers interpolated."""
        own = {name: self.arrays[name][index].item() for name in _OF_CLIP}
        frames = slice(int(own["seq_start"]), int(own["seq_start"]) + int(self.lengths[index]))
        vectors, fps = self.arrays["poses"][frames].astype(np.float64), float(own["fps"])
        rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)
        rotations, pelvis = _bridged(
            rotations, self.arrays["trans"][frames].astype(np.float64), fps
        )
        labels = (self.names[index], self.subjects[index], self.actions[index])
        valid = (bool(own[name]) for name in ("wrist_valid", "toe_valid"))
        return Clip(
            *labels, rotations, pelvis, fps, float(own["leg_m"]), float(own["floor_y"]), *valid
        )


def blend(first: Array, second: Array, share: Array) -> Array:
    """Interpolate rotations (T, J, 3, 3) from `first` to `second` by `share` (T,): slerp."""
    step = Rotation.from_matrix((np.swapaxes(first, -1, -2) @ second).reshape(-1, 3, 3)).as_rotvec()
    step = step.reshape(*first.shape[:2], 3) * share[:, None, None]
    return first @ Rotation.from_rotvec(step.reshape(-1, 3)).as_matrix().reshape(first.shape)


def _bridged(rotations: Array, pelvis: Array, fps: float) -> tuple[Array, Array]:
    """Interpolate all joints over frames in which any joint jumps."""
    if len(pelvis) < 3:
        return rotations, pelvis
    turned = rotation_angle(rotations[:-1].mT @ rotations[1:])
    # Angular speed, rad/s, above which a marker has jumped; joints of walkers and dancers
    # are slower.
    jumps = np.flatnonzero((turned > np.radians(900.0) / fps).any(axis=1))
    if len(jumps) == 0:
        return rotations, pelvis
    bad = np.zeros(len(pelvis), dtype=bool)
    for group in np.split(jumps, np.flatnonzero(np.diff(jumps) > 0.25 * fps) + 1):
        bad[max(group[0], 0) : group[-1] + 2] = True
    good, frames = np.flatnonzero(~bad), np.arange(len(pelvis))
    if len(good) < 2:
        return rotations, pelvis
    place = np.clip(np.searchsorted(good, frames, side="right") - 1, 0, len(good) - 2)
    low, high = good[place], good[place + 1]
    share = np.clip((frames - low) / (high - low), 0.0, 1.0)
    eased = np.where(bad, share**2 * (3 - 2 * share), share)
    smooth = blend(rotations[low], rotations[high], eased)
    return np.where(bad[:, None, None, None], smooth, rotations), np.where(
        bad[:, None], pelvis[low] + eased[:, None] * (pelvis[high] - pelvis[low]), pelvis
    )


def _check(arrays: dict[str, NDArray]) -> None:
    """ValueError if clips or pairs lie outside the file, or if its bodies are not SMPL's."""
    start, length, pairs = arrays["seq_start"], arrays["seq_len"], arrays["pairs"]
    if not ((start >= 0) & (length > 0) & (start + length <= len(arrays["poses"]))).all():
        raise ValueError("seq_start and seq_len go beyond the last frame")
    inside = ((pairs >= 0) & (pairs < len(start))).all()
    if not inside or (length[pairs[:, 0]] != length[pairs[:, 1]]).any():
        raise ValueError("pairs must name two clips of one length each")
    if tuple(arrays["parents"].tolist()) != SMPL_PARENTS:
        raise ValueError("parents are not SMPL's tree")


def shoulder_rhythm(rotations: Array) -> Array:
    """Local rotations (T, 24, 3, 3) with collars computed from the arms, replacing the given
    collars.

    The collar rises and sweeps with the upper arm's direction in the chest's frame (scapulohumeral
    rhythm); the shoulder is rotated back by as much, so that the upper arm's rotation in the world
    is unchanged.
    """
    adapted = rotations.copy()
    for side, (collar, shoulder) in enumerate(zip(COLLARS, SHOULDERS, strict=True)):
        sign = (1.0, -1.0)[side]
        arm = rotations[:, collar] @ rotations[:, shoulder]
        along = sign * arm[:, :, 0]  # the T-pose's arm lies along +x on the left
        turned = _collar(along, sign)
        adapted[:, collar] = turned
        adapted[:, shoulder] = np.swapaxes(turned, -1, -2) @ arm
    return adapted


def _collar(along: Array, sign: float) -> Array:
    """Rotation (T, 3, 3) of the collar for upper arms in directions `along` (T, 3) in the chest's
    frame.
    """
    elevation = np.arccos(np.clip(-along[:, 1], -1.0, 1.0))  # 0 hanging, pi overhead
    # Elevation of the clavicle per elevation of the arm beyond `_SETTING`: 30 degrees with
    # the arm overhead. There, a third of the arm's elevation is due to the scapula (1:2),
    # and half of that to the clavicle; the other half, at the outer end of the clavicle,
    # hardly moves the shoulder's centre, and SMPL's tree has no joint for it.
    # Elevation of the arm, rad, at which the collar is as in the T-pose: T-poses of body
    # files are made from bodies with half raised arms by rotating the arms only.
    rise = 0.2 * (_ramp(elevation - _SETTING) - _ramp(np.array([np.radians(60.0) - _SETTING])))
    raised = np.sin(np.clip(elevation, 0.0, np.pi / 2)) ** 2
    # Rotation of the collar, rad, forwards if the raised arm points forwards, and backwards
    # if it points back.
    sweep = 0.22 * raised * along[:, 2] - 0.35 * np.maximum(rise, 0.0)
    return Rotation.from_euler("yz", np.stack([-sign * sweep, sign * rise], axis=1)).as_matrix()


def _ramp(angle: Array) -> Array:
    """Smooth ramp: 0 below 0 and `angle` above, rounded over 0.1 rad, so that the collar starts
    gently.
    """
    return 0.05 * np.logaddexp(0.0, angle / 0.05)
