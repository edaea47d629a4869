"""Recorded motions in SMPL's pose structure, performed by bodies of any shape in a room with z up."""

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model import BodyModel
from shapepose_fg.errors import InputError
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.shoulder import shoulder_rhythm

Array = NDArray[np.float64]

_ARRAYS = {"poses": ("N", 24, 3), "trans": ("N", 3), "seq_start": ("S",), "seq_len": ("S",), "fps": ("S",)}
_ARRAYS |= {name: ("S",) for name in ("names", "subject", "action", "tier", "wrist_valid", "toe_valid")}
_ARRAYS |= {"leg_m": ("S",), "floor_y": ("S",), "pairs": ("K", 2), "parents": (24,)}
_FEET = (7, 8, 10, 11)
_RELAXED_HAND = 0.25
"""Radians by which the fingers of a hand that was not recorded are bent."""
_GLITCH_RAD_S = np.radians(900.0)
"""No joint of a walker or dancer turns faster; a marker that jumps does."""
_JUMP_M = 0.12
"""Who rises this far above the floor around it has jumped; less is how recordings err."""
_Z_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0]).as_matrix()


@dataclass(frozen=True)
class Clip:
    """Consecutive frames of one recorded person."""

    name: str
    """Subject, trial and segment, as "60_01#0"."""
    subject: str
    """Who was recorded."""
    action: str
    """What is done, in words."""
    tier: int
    """How near to the recording: 0 its own skeleton, 1 and 2 retargeted."""
    rotations: Array
    """(T, 24, 3, 3) local rotations in SMPL's structure, y up."""
    pelvis: Array
    """(T, 3) place of the pelvis, y up, metres."""
    fps: float
    """Frames a second."""
    leg_m: float
    """Length of the recorded leg."""
    floor_y: float
    """Height of the floor."""
    wrist_valid: bool
    """Whether the wrists were recorded."""
    toe_valid: bool
    """Whether the toes were recorded."""

    def __len__(self) -> int:
        """Count of frames, T."""
        return len(self.pelvis)

    def between(self, start: int, stop: int) -> "Clip":
        """The frames from `start` up to `stop`."""
        return replace(self, rotations=self.rotations[start:stop], pelvis=self.pelvis[start:stop])

    def resampled(self, fps: float) -> "Clip":
        """The same motion at another rate: rotations by slerp, places linearly."""
        if fps == self.fps or len(self) < 2:
            return replace(self, fps=fps)
        time = np.arange(int(np.floor((len(self) - 1) * fps / self.fps + 1e-9)) + 1) * self.fps / fps
        low = np.minimum(time.astype(int), len(self) - 2)
        share = np.asarray(time - low, dtype=np.float64)
        rotations = blend(self.rotations[low], self.rotations[low + 1], share)
        pelvis = self.pelvis[low] + share[:, None] * (self.pelvis[low + 1] - self.pelvis[low])
        return replace(self, rotations=rotations, pelvis=pelvis, fps=fps)


@dataclass(frozen=True)
class Mocap:
    """A file of recorded motions; clips are read when asked for."""

    names: tuple[str, ...]
    """(S,) names of the clips."""
    subjects: tuple[str, ...]
    """(S,) who was recorded."""
    actions: tuple[str, ...]
    """(S,) what is done."""
    lengths: NDArray[np.int64]
    """(S,) frames of each."""
    tiers: NDArray[np.int64]
    """(S,) how near to the recording."""
    pairs: tuple[tuple[int, int], ...]
    """Clips of two people together: same frames, common origin."""
    arrays: dict[str, NDArray]
    """What the file holds."""

    def __len__(self) -> int:
        """Count of clips, S."""
        return len(self.names)

    @classmethod
    def load(cls, path: str | Path) -> "Mocap":
        """The recordings in `path` (.npz, see docs/simulation.md); InputError where it cannot be used."""
        arrays = _read(Path(path))
        return cls(
            names=tuple(map(str, arrays["names"])),
            subjects=tuple(map(str, arrays["subject"])),
            actions=tuple(map(str, arrays["action"])),
            lengths=arrays["seq_len"].astype(np.int64),
            tiers=arrays["tier"].astype(np.int64),
            pairs=tuple((int(lead), int(follow)) for lead, follow in arrays["pairs"]),
            arrays=arrays,
        )

    def clip(self, index: int) -> Clip:
        """Clip `index`, glitches of single markers bridged."""
        start = int(self.arrays["seq_start"][index])
        frames = slice(start, start + int(self.lengths[index]))
        vectors = self.arrays["poses"][frames].astype(np.float64)
        fps = float(self.arrays["fps"][index])
        rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)
        rotations, pelvis = _bridged(rotations, self.arrays["trans"][frames].astype(np.float64), fps)
        return Clip(
            name=self.names[index],
            subject=self.subjects[index],
            action=self.actions[index],
            tier=int(self.tiers[index]),
            rotations=rotations,
            pelvis=pelvis,
            fps=fps,
            leg_m=float(self.arrays["leg_m"][index]),
            floor_y=float(self.arrays["floor_y"][index]),
            wrist_valid=bool(self.arrays["wrist_valid"][index]),
            toe_valid=bool(self.arrays["toe_valid"][index]),
        )


@dataclass(frozen=True)
class Placement:
    """Where in the room a recording is put."""

    xy: tuple[float, float] = (0.0, 0.0)
    """Metres; the recording's own `origin` comes to lie here."""
    turn_rad: float = 0.0
    """Turn about the vertical; without one, who faced +z in the recording faces -y."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Point (x, z) of the recording's floor, in its own metres."""


@dataclass(frozen=True)
class Performance:
    """One person's motion in the room, z up, metres."""

    rotations: Array
    """(T, 24, 3, 3) local rotations; the first is the pelvis' in the world."""
    joints: Array
    """(T, 24, 3) SMPL's joints."""
    rest: Array
    """(24, 3) the shaped body's joints in the T-pose."""

    def __len__(self) -> int:
        """Count of frames, T."""
        return len(self.joints)

    def moved(self, xy: Array, turn_rad: float = 0.0) -> "Performance":
        """Turned about the vertical through the origin, then shifted by `xy` (2,)."""
        turn = about_z(np.array([turn_rad]))[0]
        rotations = self.rotations.copy()
        rotations[:, 0] = turn @ rotations[:, 0]
        return replace(self, rotations=rotations, joints=self.joints @ turn.T + np.array([*xy, 0.0]))


class Figure:
    """A shaped body as motions need it: joints of its T-pose and the soles of its feet."""

    def __init__(self, body: BodyModel, betas: Array):
        arrays = body.arrays
        shaped = arrays.template + arrays.shapes @ betas
        self.rest: Array = arrays.joint_regressor @ shaped
        """(24, 3) joints in the T-pose, y up."""
        self.parents = body.parents
        """(24,) parent of each joint."""
        self.leg_m = float(np.linalg.norm(np.diff(self.rest[[1, 4, 7]], axis=0), axis=1).sum())
        """Length of thigh and shank together."""
        feet = [np.flatnonzero(arrays.weights[:, list(_FEET[side::2])].sum(axis=1) > 0.9) for side in (0, 1)]
        # Whatever the foot's turn, its lowest point is a corner of its convex hull.
        hull = np.concatenate([foot[ConvexHull(shaped[foot]).vertices] for foot in feet])
        self._soles, self._weights = shaped[hull], arrays.weights[hull][:, list(_FEET)]
        self._weights = self._weights / self._weights.sum(axis=1, keepdims=True)

    def joints(self, rotations: Array, pelvis: Array) -> tuple[Array, Array]:
        """Joints (T, 24, 3) and their world rotations (T, 24, 3, 3) with the pelvis joint at `pelvis` (T, 3)."""
        world, places = rotations.copy(), np.empty((len(pelvis), 24, 3))
        places[:, 0] = pelvis
        for joint in range(1, 24):
            parent = self.parents[joint]
            world[:, joint] = world[:, parent] @ rotations[:, joint]
            places[:, joint] = places[:, parent] + world[:, parent] @ (self.rest[joint] - self.rest[parent])
        return places, world

    def lowest_sole(self, joints: Array, world: Array) -> Array:
        """Height (T,) of the lowest point of both feet, z up."""
        up = world[:, list(_FEET), 2]  # (T, 4, 3): the height's share of each rotation
        offsets = self._soles[:, None] - self.rest[list(_FEET)]
        heights = np.einsum("tfi,vfi,vf->tv", up, offsets, self._weights, optimize=True)
        return (heights + joints[:, list(_FEET), 2] @ self._weights.T).min(axis=1)


def perform(
    body: BodyModel,
    betas: Array,
    clip: Clip,
    placement: Placement = Placement(),
    *,
    fps: float | None = None,
    scale: float | None = None,
) -> Performance:
    """`clip` as a body of shape `betas` (10,) does it: on the floor z = 0 of a room with z up.

    Steps are longer in the measure of the legs (`scale` overrides it, for who must stay together); collars
    follow the arms, hands hang loosely, and the soles are on the floor, but for what is jumped.
    """
    clip = clip if fps is None else clip.resampled(fps)
    figure = Figure(body, np.asarray(betas, dtype=np.float64))
    ratio = figure.leg_m / clip.leg_m
    turn = about_z(np.array([placement.turn_rad]))[0] @ _Z_UP
    rotations = shoulder_rhythm(clip.rotations)
    if not clip.wrist_valid:
        rotations[:, 20:22] = np.eye(3)
    for hand, sign in ((22, -1.0), (23, 1.0)):
        rotations[:, hand] = Rotation.from_rotvec([0.0, 0.0, sign * _RELAXED_HAND]).as_matrix()
    rotations[:, 0] = turn @ rotations[:, 0]
    x, z = placement.origin
    pelvis = (clip.pelvis - (x, clip.floor_y, z)) * (ratio if scale is None else scale)
    pelvis[:, 1] = (clip.pelvis[:, 1] - clip.floor_y) * ratio
    pelvis = pelvis @ turn.T + np.array([*placement.xy, 0.0])
    return grounded(figure, rotations, pelvis, clip.fps, bend_toes=not clip.toe_valid)


def grounded(figure: Figure, rotations: Array, pelvis: Array, fps: float, *, bend_toes: bool) -> Performance:
    """Shift a person up and down, smoothly, so that the feet that carry are on the floor."""
    joints, world = figure.joints(rotations, pelvis)
    if bend_toes:
        rotations = _toes_on_the_floor(rotations, joints, world, figure.lowest_sole(joints, world))
        joints, world = figure.joints(rotations, pelvis)
    joints = joints.copy()
    joints[..., 2] -= _floor(figure.lowest_sole(joints, world), fps)[:, None]
    return Performance(rotations, joints, figure.rest)


def together(betas: Array, performances: list[Performance], frames: int) -> Motion:
    """SMPL's parameters of P people, `betas` (P, 10), in `frames` frames (needed where P is 0)."""
    motion = Motion(
        np.asarray(betas, dtype=np.float64).reshape(len(performances), 10),
        np.zeros((frames, len(performances), 3)),
        np.zeros((frames, len(performances), 23, 3)),
        np.zeros((frames, len(performances), 3)),
    )
    for person, performed in enumerate(performances):
        vectors = Rotation.from_matrix(performed.rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 24, 3)
        motion.global_orient[:, person] = vectors[:, 0]
        motion.body_pose[:, person] = vectors[:, 1:]
        # SMPL turns the body about its pelvis where the T-pose has it, and shifts it afterwards.
        motion.transl[:, person] = performed.joints[:, 0] - performed.rest[0]
    return motion


def blend(first: Array, second: Array, share: Array) -> Array:
    """Rotations (T, J, 3, 3) on the way from `first` to `second`, `share` (T,) of it: slerp."""
    step = Rotation.from_matrix((np.swapaxes(first, -1, -2) @ second).reshape(-1, 3, 3)).as_rotvec()
    step = step.reshape(*first.shape[:2], 3) * share[:, None, None]
    return first @ Rotation.from_rotvec(step.reshape(-1, 3)).as_matrix().reshape(first.shape)


def about_z(angle: Array) -> Array:
    """Rotations (T, 3, 3) by `angle` (T,) about the vertical."""
    return Rotation.from_rotvec(np.array([0.0, 0.0, 1.0]) * angle[:, None]).as_matrix()


def _floor(lowest: Array, fps: float) -> Array:
    """Height (T,) of the floor under somebody whose lowest point is at `lowest` (T,): smooth, blind for jumps."""
    if len(lowest) == 0:
        return lowest
    reach = 2 * max(1, round(0.3 * fps)) + 1
    opened = maximum_filter1d(minimum_filter1d(lowest, reach, mode="nearest"), reach, mode="nearest")
    flies = (lowest - opened).max() > _JUMP_M
    floor = gaussian_filter1d(opened if flies else lowest, 0.1 * fps, mode="nearest")
    below = np.maximum(floor - lowest - 0.015, 0.0)  # what would be deep in the floor lifts the person
    wide = maximum_filter1d(below, 2 * max(1, round(0.15 * fps)) + 1, mode="nearest")
    return floor - gaussian_filter1d(wide, 0.08 * fps, mode="nearest")


def _toes_on_the_floor(rotations: Array, joints: Array, world: Array, lowest: Array) -> Array:
    """Toes that were not recorded stay flat where the heel rises and the ball of the foot is on the floor."""
    bent = rotations.copy()
    for ankle, ball in ((7, 10), (8, 11)):
        pitch = np.arcsin(np.clip(-world[:, ankle, 2, 2], -1.0, 1.0))  # of the foot's +z, below the horizontal
        near = np.clip((0.14 - (joints[:, ball, 2] - lowest)) / 0.06, 0.0, 1.0)
        angle = -np.clip(pitch, 0.0, 0.7) * near
        bent[:, ball] = Rotation.from_rotvec(np.array([1.0, 0.0, 0.0]) * angle[:, None]).as_matrix()
    return bent


def _bridged(rotations: Array, pelvis: Array, fps: float) -> tuple[Array, Array]:
    """Bridge the frames around a joint that jumps from one frame to the next, all joints together."""
    if len(pelvis) < 3:
        return rotations, pelvis
    trace = np.einsum("tjab,tjab->tj", rotations[:-1], rotations[1:])  # of R^T R': 1 + 2 cos
    jumps = np.flatnonzero((np.arccos(np.clip((trace - 1) / 2, -1, 1)) > _GLITCH_RAD_S / fps).any(axis=1))
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


def _read(path: Path) -> dict[str, NDArray]:
    """The arrays of the file, shapes, ranges and indices checked."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the .npz of recorded motions")
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in _ARRAYS if name not in archive]
            if missing:
                raise InputError(f"{path}: array {missing[0]!r} is missing; give motions in SMPL's structure")
            arrays = {name: archive[name] for name in _ARRAYS}
    except InputError:
        raise
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as .npz of plain arrays ({error}); copy it again") from None
    _check(path, arrays)
    return arrays


def _check(path: Path, arrays: dict[str, NDArray]) -> None:
    """InputError that names the array that does not fit."""
    from shapepose_fg.body.model import BodyModel

    sizes = {"N": len(arrays["poses"]), "S": len(arrays["seq_start"]), "K": len(arrays["pairs"])}
    for name, shape in _ARRAYS.items():
        expected = tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        if arrays[name].shape != expected:
            raise InputError(f"{path}: {name} must be {expected}, is {arrays[name].shape}; write the file again")
    for name in ("poses", "trans", "fps", "leg_m", "floor_y"):
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: {name} holds values that are not finite; write the file again")
    if not ((arrays["fps"] > 0).all() and (arrays["leg_m"] > 0.1).all()):
        raise InputError(f"{path}: fps and leg_m must be positive; write the file again")
    start, length = arrays["seq_start"].astype(np.int64), arrays["seq_len"].astype(np.int64)
    if not ((start >= 0) & (length > 0) & (start + length <= sizes["N"])).all():
        raise InputError(f"{path}: seq_start and seq_len reach beyond the last frame; write the file again")
    pairs = arrays["pairs"].astype(np.int64)
    if not ((pairs >= 0) & (pairs < sizes["S"])).all() or (length[pairs[:, 0]] != length[pairs[:, 1]]).any():
        raise InputError(f"{path}: pairs must name two clips of one length each; write the file again")
    if tuple(arrays["parents"].tolist()) != BodyModel.parents:
        raise InputError(f"{path}: parents are not SMPL's tree; give motions in SMPL's structure")
