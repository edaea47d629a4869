"""The same motions by people whose bodies the fitted model lacks, and a detector with joints of its own."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.performance import Figure
from shapepose_fg.simulation.proportions import Proportions, reshaped
from shapepose_fg.simulation.scene import Scene

AnyScene = TypeVar("AnyScene", bound=Scene)

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


def recast(scene: AnyScene, proportions: Sequence[Proportions]) -> AnyScene:
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
