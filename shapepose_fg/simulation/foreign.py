"""The same motions by people whose proportions the fitted model lacks; a detector with joints of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.smpl_file import NUM_BETAS, SMPL_PARENTS
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.performance import Figure
from shapepose_fg.simulation.scene import Scene

Array = NDArray[np.float64]

DETECTOR_S_OWN = KeypointOffsets.symmetric(
    {
        "LHip": (0.035, 0.03, 0.0),
        "LShoulder": (0.01, -0.02, -0.01),
        "Neck": (0.0, -0.03, 0.01),
        "Nose": (0.0, 0.0, 0.02),
        "LEar": (0.0, 0.01, -0.02),
        "LKnee": (0.0, 0.02, 0.01),
        "LElbow": (-0.015, 0.0, -0.01),
        "LHeel": (0.0, 0.01, -0.02),
    }
)
"""A detector with hips, shoulders, neck, face, elbows, knees and heels of its own: 18 to 46 mm off."""

PEOPLE = ("the body that is fitted", "own bones", "long arms", "children", "all of these")
"""Whom `people_of` knows."""

_STIFF_M = 0.01
"""A bone's frame is stretched along what joins it to the next joints; farther across than this it is not."""
_CHILDREN = {bone: [joint for joint in range(24) if SMPL_PARENTS[joint] == bone] for bone in range(24)}
_LEGS = np.array([SMPL_24.index(f"{side}_{name}") for side in ("left", "right") for name in ("knee", "ankle")])
_ARMS = np.array([SMPL_24.index(f"{side}_{name}") for side in ("left", "right") for name in ("elbow", "wrist")])
_HEAD = SMPL_24.index("head")
_CHILD_M = 1.2
"""Stature of a child of seven (CDC growth charts, 2000: the median is 1.22 m)."""


@dataclass(frozen=True)
class Proportions:
    """How a body differs from one that the model has."""

    length: Array
    """(24,) factor of the distance of each of SMPL's joints from its parent."""
    girth: Array
    """(24,) factor of the size of each bone's flesh across."""

    def __post_init__(self) -> None:
        for name in ("length", "girth"):
            value = getattr(self, name)
            if value.shape != (24,) or not (np.isfinite(value).all() and (value > 0).all()):
                raise ValueError(f"{name} must be 24 positive numbers, got {value}")

    def times(self, other: "Proportions") -> "Proportions":
        """Both, one after the other."""
        return Proportions(self.length * other.length, self.girth * other.girth)

    @classmethod
    def usual(cls) -> "Proportions":
        """Those that the model has."""
        return cls(np.ones(24), np.ones(24))

    @classmethod
    def own_bones(cls, rng: np.random.Generator, spread: float = 0.05) -> "Proportions":
        """Every bone longer or shorter by its own share, at most `spread`; left and right are drawn apart."""
        return cls(1 + rng.uniform(-spread, spread, 24), np.ones(24))

    @classmethod
    def long_arms(cls, factor: float = 1.15) -> "Proportions":
        """Upper and lower arms that are longer than those of anybody of this stature."""
        return cls(_only(_ARMS, factor), np.ones(24))

    @classmethod
    def child(cls) -> "Proportions":
        """A child of about seven years, of 1.2 m where the body is the mean adult: a larger head, shorter legs.

        The head is a sixth of the stature, that of adults 1 / 7.5 or less (Domljan et al. 2024); the hips are at
        half the stature, those of this adult at 52 %: children sit higher for their stature (Snyder et al. 1977,
        UM-HSRI-77-17).
        """
        adult_m, hip_m = 1.70, 0.893
        legs, head = 0.5 * _CHILD_M / hip_m, (_CHILD_M / 6) / (adult_m / 7.6)
        length = np.full(24, 0.685)
        length[_LEGS] = legs
        length[_HEAD], length[SMPL_24.index("neck")] = 0.8, 0.69
        length[[SMPL_24.index("left_foot"), SMPL_24.index("right_foot")]] = 0.72
        girth = np.full(24, _CHILD_M / adult_m)
        girth[_HEAD] = head
        return cls(length, girth)


def _only(joints: NDArray[np.intp], factor: float) -> Array:
    factors = np.ones(24)
    factors[joints] = factor
    return factors


def reshaped(body: BodyModel, betas: Array, proportions: Sequence[Proportions]) -> tuple[BodyModel, Array]:
    """A model whose shapes are these people, and their betas (P, 10) in it: 1 in a column of their own.

    Person p is the `body` of shape `betas[p]` with `proportions[p]`. Joints, keypoints and the posed surface
    follow, for all of it is made from the mesh. ValueError for more people than a model has shapes.
    """
    if len(betas) > NUM_BETAS or len(betas) != len(proportions):
        raise ValueError(
            f"up to {NUM_BETAS} people and proportions for each, got {len(betas)}, {len(proportions)}"
        )
    arrays = body.arrays
    shapes = np.zeros_like(arrays.shapes)
    for person, (own, share) in enumerate(zip(betas, proportions, strict=True)):
        adult = arrays.template + arrays.shapes @ own
        shapes[..., person] = _stretched(adult, arrays.joint_regressor @ adult, arrays.weights, share)
        shapes[..., person] -= arrays.template
    model = BodyModel(replace(arrays, shapes=shapes), body.dtype, body.keypoint_offsets, body.keypoint_names)
    return model, np.eye(len(betas), NUM_BETAS)


def _stretched(vertices: Array, joints: Array, weights: Array, proportions: Proportions) -> Array:
    """The mesh (Nv, 3) of a T-pose with `joints` (24, 3) in other proportions.

    Each bone carries its skin by a linear map about its joint, which takes the next joints where they shall be and
    is the bone's girth across that; skinning weights blend the maps. Joints are regressed from the mesh, from
    vertices of several bones: limbs come out as long as they shall be to 3 % of that, bones of the trunk to 12 mm.
    """
    moved = joints.copy()
    for joint in range(1, 24):
        parent = SMPL_PARENTS[joint]
        moved[joint] = moved[parent] + proportions.length[joint] * (joints[joint] - joints[parent])
    stretched = np.zeros_like(vertices)
    for bone, children in _CHILDREN.items():
        girth = proportions.girth[bone]
        old = (joints[children] - joints[bone]).T  # (3, C)
        new = (moved[children] - moved[bone]).T
        across = old @ old.T + _STIFF_M**2 * np.eye(3)
        linear = girth * np.eye(3) + np.linalg.solve(across, old @ (new - girth * old).T).T
        stretched += weights[:, bone, None] * (moved[bone] + (vertices - joints[bone]) @ linear.T)
    return stretched


def people_of(kind: str, count: int, seed: int = 0) -> list[Proportions]:
    """The proportions of `count` people: of one kind of `PEOPLE`, or of all, every second one a child."""
    rng = np.random.default_rng([seed, 24])
    usual, bones = Proportions.usual(), [Proportions.own_bones(rng) for _ in range(count)]
    arms, child = Proportions.long_arms(), Proportions.child()
    kinds = {
        "the body that is fitted": [usual] * count,
        "own bones": bones,
        "long arms": [arms] * count,
        "children": [child] * count,
        "all of these": [own.times(child if place % 2 else arms) for place, own in enumerate(bones)],
    }
    if kind not in kinds:
        raise ValueError(f"kind must be one of {', '.join(PEOPLE)}; got {kind}")
    return kinds[kind]


def recast(scene: Scene, proportions: Sequence[Proportions]) -> Scene:
    """The same motions by people of other `proportions` (one for each): every bone turns as it did.

    They stand where they stood, on the same floor. Steps and reaches are those of the adults: a child's feet
    slide, and hands that were held need not meet. Who hides whom follows from the new bodies.
    """
    body, betas = reshaped(scene.body, scene.motion.betas, proportions)
    motion = scene.motion
    transl = motion.transl.copy()
    for person in range(scene.people):
        before, after = (
            Figure(model, shape[person]) for model, shape in ((scene.body, motion.betas), (body, betas))
        )
        vectors = np.concatenate([motion.global_orient[:, person, None], motion.body_pose[:, person]], axis=1)
        turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)
        pelvis = before.rest[0] + transl[:, person]
        transl[:, person] = pelvis - after.rest[0]
        transl[:, person, 2] += _sole(before, turns, pelvis) - _sole(after, turns, pelvis)
    return replace(scene, body=body, motion=Motion(betas, motion.global_orient, motion.body_pose, transl))


def _sole(figure: Figure, rotations: NDArray[np.float64], pelvis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height (T,) of the lowest point of both feet of who has the pelvis there, z up."""
    return figure.lowest_sole(*figure.joints(rotations, pelvis))
