"""The same motions by people whose proportions the fitted model lacks; a detector with joints of its own."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.smpl_file import NUM_BETAS, SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.performance import Figure
from shapepose_fg.simulation.scene import Scene

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
"""Whom `people_of` knows; of the last, every second one is a child."""

_STIFF_M = 0.01
"""A bone's frame is stretched along what joins it to the next joints; farther across than this it is not."""
_CHILDREN = {bone: [joint for joint in range(24) if SMPL_PARENTS[joint] == bone] for bone in range(24)}
_LEGS = ("left_knee", "left_ankle", "right_knee", "right_ankle")
_ARMS = ("left_elbow", "left_wrist", "right_elbow", "right_wrist")
_CHILD_M = 1.2
"""Stature of a child of seven (CDC growth charts, 2000: the median is 1.22 m)."""


class Proportions(NamedTuple):
    """How a body differs from one that the model has."""

    length: Array
    """(24,) factor of the distance of each of SMPL's joints from its parent."""
    girth: Array
    """(24,) factor of the size of each bone's flesh across."""


def people_of(kind: str, count: int, seed: int = 0) -> list[Proportions]:
    """The proportions of `count` people of one kind of `PEOPLE`; ValueError for any other.

    Own bones are longer or shorter by their own share, left and right drawn apart. A child is about seven years
    old, 1.2 m where the body is the mean adult. The head is a sixth of the stature, that of adults 1 / 7.5 or less
    (Domljan et al. 2024); the hips are at half the stature, those of this adult at 52 %: children sit higher for
    their stature (Snyder et al. 1977, UM-HSRI-77-17).
    """
    if kind not in PEOPLE:
        raise ValueError(f"kind must be one of {', '.join(PEOPLE)}; got {kind}")
    rng, usual = np.random.default_rng([seed, 24]), np.ones(24)
    bones = [1 + rng.uniform(-0.05, 0.05, 24) for _ in range(count)]
    arms = _scaled(usual, {joint: 1.15 for joint in _ARMS})
    adult_m, hip_m = 1.70, 0.893
    legs = dict.fromkeys(_LEGS, 0.5 * _CHILD_M / hip_m)
    child = _scaled(np.full(24, 0.685), legs | {"head": 0.8, "neck": 0.69, "left_foot": 0.72, "right_foot": 0.72})
    slight = _scaled(np.full(24, _CHILD_M / adult_m), {"head": (_CHILD_M / 6) / (adult_m / 7.6)})
    kinds = [
        [Proportions(usual, usual)] * count,
        [Proportions(own, usual) for own in bones],
        [Proportions(arms, usual)] * count,
        [Proportions(child, slight)] * count,
        [
            Proportions(own * (child if place % 2 else arms), slight if place % 2 else usual)
            for place, own in enumerate(bones)
        ],
    ]
    return kinds[PEOPLE.index(kind)]


def _scaled(factors: Array, own: dict[str, float]) -> Array:
    """(24,) `factors` with those of some joints replaced."""
    factors = factors.copy()
    factors[[SMPL_24.index(joint) for joint in own]] = list(own.values())
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
    model = BodyModel(replace(arrays, shapes=shapes), body.keypoint_offsets, body.keypoint_names)
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

        def sole(figure: Figure, turns: Array = turns, pelvis: Array = pelvis) -> Array:
            """Height (T,) of the lowest point of both feet of who has the pelvis there, z up."""
            return figure.lowest_sole(*figure.joints(turns, pelvis))

        transl[:, person] = pelvis - after.rest[0]
        transl[:, person, 2] += sole(before) - sole(after)
    return replace(scene, body=body, motion=Motion(betas, motion.global_orient, motion.body_pose, transl))
