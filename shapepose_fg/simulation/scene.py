"""Scenes of people with ground truth and calibrated cameras; the built-in scene of `demo` and the
tests.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.rendering import look_at
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.motion import BodyDimensions, BodyMotion, close_motion

if TYPE_CHECKING:  # not needed by visibility workers
    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters

UP = np.array([0.0, 0.0, 1.0])
_FEET = [n for n, name in enumerate(BODY_25.joints) if name.endswith(("Toe", "Heel"))]
"""Toes and heels in BODY_25."""


@dataclass(frozen=True)
class Scene:
    """Ground-truth people and the cameras. World z up, floor at z = 0, metres."""

    rig: Rig
    """The cameras."""
    body: "BodyModel"
    """The body model of the parameters in `motion`."""
    motion: BodyMotion
    """Bodies of P people in T frames."""
    fps: float
    """Frame rate, Hz."""
    cuts: tuple[int, ...] = ()
    """First frames after cuts, at which positions are discontinuous."""
    clips: tuple[tuple[str, ...], ...] = ()
    """Name of each person's recording in each segment, for recorded motions."""

    def __len__(self) -> int:
        """Number of frames, T."""
        return len(self.motion.transl)

    @property
    def people(self) -> int:
        """Number of people, P."""
        return len(self.motion.betas)

    @cached_property
    def keypoints(self) -> Array:
        """(T, P, 25, 3) true BODY_25 keypoints."""
        return keypoints_of(self.body, self.motion)

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "Scene":
        """Return the scene with ground-truth keypoints including a detector's offsets."""
        return replace(self, body=self.body.with_keypoint_offsets(offsets))

    def part(self, span: range) -> "Scene":
        """The scene in the consecutive frames `span`."""
        # Segments that overlap the span, each from its cut (the first from frame 0) to the next.
        segments = zip((0, *self.cuts), (*self.cuts, len(self)), self.clips, strict=False)
        clips = tuple(
            names for start, stop, names in segments if start < span.stop and stop > span.start
        )
        cuts = tuple(first - span.start for first in self.cuts if span.start < first < span.stop)
        return replace(
            self, motion=self.motion.rows(slice(span.start, span.stop)), cuts=cuts, clips=clips
        )

    def truth_at(self, frame: int) -> Array:
        """(P, 25, 3) true BODY_25 keypoints of one frame."""
        return self.keypoints[frame]

    def vertices_at(self, frame: int, only: Index | None = None) -> NDArray[np.float32]:
        """(P, Nv, 3) ground-truth meshes of one frame; or (P, M, 3) for the vertices
        `only` (M,).
        """
        parameters = parameters_of(self.motion.rows(slice(frame, frame + 1)))
        return self.body.vertices(parameters, only).astype(np.float32)


def built_in_scene(
    seed: int = 0,
    *,
    people: int = 4,
    cameras: int = 6,
    frames: int = 60,
    fps: float = 25.0,
    body: "BodyModel | None" = None,
) -> Scene:
    """Close motion in a room of 4 x 4 m: two people dance, one walks through, one waves and
    crouches.

    Any number of `people` from 0, of `cameras` from 2 and of `frames` from 0; all random values
    (shapes, phases, positions) depend on `seed`. `body` is the body model, by default the
    package's.
    """
    if people < 0 or frames < 0 or cameras < 2:
        raise ValueError(
            f"need people >= 0, frames >= 0, cameras >= 2; got {people}, {frames}, {cameras}"
        )
    if body is None:
        from shapepose_fg.body.model.body_model import BodyModel

        body = BodyModel.default()
    rng = np.random.default_rng(seed)
    rig = ring_of_cameras(cameras, rng)
    betas = np.clip(rng.normal(0.0, 1.0, (people, body.num_betas)), -1.8, 1.8)
    builds = builds_of(body, betas)
    motion = close_motion(betas, builds, frames, fps, rng)
    return Scene(rig, body, _on_the_floor(body, motion, builds), fps)


def ring_of_cameras(
    count: int,
    rng: np.random.Generator,
    *,
    distance_m: tuple[float, float] = (3.1, 3.6),
    height_m: tuple[float, float] = (2.0, 2.5),
    focal_px: tuple[float, float] = (860.0, 940.0),
) -> Rig:
    """Cameras on the walls around the room, 3 to 3.6 m from its centre and 1.9 to 2.7 m high,
    looking inwards.

    `distance_m`, `height_m` and `focal_px` are the ranges of uniform draws; every second camera is
    0.3 m lower. 1280 x 720 px and a focal length near 900 px by default: a field of view of 71 by
    44 degrees.
    """
    image_size, cameras = (1280, 720), []
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.18, 0.18, count)) / count + 0.35
    for index, angle in enumerate(angles):
        distance, height = rng.uniform(*distance_m), rng.uniform(*height_m) + (0.2, -0.1)[index % 2]
        eye = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
        target = np.array([*rng.uniform(-0.15, 0.15, 2), 0.85])
        focal = rng.uniform(*focal_px)
        centre = np.array(image_size) / 2 + rng.uniform(-8.0, 8.0, 2)
        K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"cam{index}", K, look_at(eye, target, UP), image_size))
    return Rig(tuple(cameras), up="z")


def builds_of(body: "BodyModel", betas: Array) -> list[BodyDimensions]:
    """Dimensions of P shapes `betas` (P, 10) for motions."""
    parameters = parameters_of(BodyMotion.still(betas))
    joints, floors = body.joints(parameters), body.vertices(parameters)[..., 1].min(axis=1)
    return [BodyDimensions(rest, float(floor)) for rest, floor in zip(joints, floors, strict=True)]


def keypoints_of(body: "BodyModel", motion: BodyMotion) -> Array:
    """BODY_25 keypoints (T, P, 25, 3) of a motion."""
    points = body.keypoints(parameters_of(motion))
    return points.reshape(*motion.transl.shape[:2], *points.shape[1:])


def _on_the_floor(
    body: "BodyModel", motion: BodyMotion, builds: list[BodyDimensions]
) -> BodyMotion:
    """Shift each person vertically so that in each frame the lowest toe or heel is as high as when
    standing.
    """
    floors = np.array([build.floor for build in builds])
    soles = keypoints_of(body, BodyMotion.still(motion.betas))[0][:, _FEET, 1].min(axis=1) - floors
    transl = motion.transl.copy()
    transl[..., 2] += soles - keypoints_of(body, motion)[:, :, _FEET, 2].min(axis=2)
    return replace(motion, transl=transl)


def parameters_of(motion: BodyMotion) -> "BodyParameters":
    """The bodies of all frames, frame by frame, as one batch."""
    from shapepose_fg.body.model.body_model import BodyParameters

    return BodyParameters(
        np.tile(motion.betas, (len(motion.transl), 1)),
        motion.global_orient.reshape(-1, 3),
        motion.body_pose.reshape(-1, 23, 3),
        motion.transl.reshape(-1, 3),
    )
