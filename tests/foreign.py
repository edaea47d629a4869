"""The same motions by people whose proportions the fitted model lacks."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.smpl_file import NUM_BETAS, SMPL_PARENTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.simulation.motion import BodyMotion
from shapepose_fg.simulation.performance import Figure
from shapepose_fg.simulation.scene import Scene

_STIFF_M = 0.01
"""A bone's frame is stretched along what joins it to the next joints; farther across than this it
is not."""
_CHILDREN = {
    bone: [joint for joint in range(24) if SMPL_PARENTS[joint] == bone] for bone in range(24)
}


class Proportions(NamedTuple):
    """How a body differs from one that the model has."""

    length: Array
    """(24,) factor of the distance of each of SMPL's joints from its parent."""
    girth: Array
    """(24,) factor of the size of each bone's flesh across."""


def reshaped(
    body: BodyModel, betas: Array, proportions: Sequence[Proportions]
) -> tuple[BodyModel, Array]:
    """A model whose shapes are these people, and their betas (P, 10) in it: 1 in a column of their
    own.

    Person p is the `body` of shape `betas[p]` with `proportions[p]`. Joints, keypoints and the
    posed surface follow, for all of it is made from the mesh. ValueError for more people than a
    model has shapes.
    """
    if len(betas) > NUM_BETAS or len(betas) != len(proportions):
        raise ValueError(
            f"up to {NUM_BETAS} people and proportions for each, got {len(betas)}, "
            f"{len(proportions)}"
        )
    arrays = body.arrays
    shapes = np.zeros_like(arrays.shapes)
    for person, (own, share) in enumerate(zip(betas, proportions, strict=True)):
        adult = arrays.template + arrays.shapes @ own
        shapes[..., person] = _stretched(
            adult, arrays.joint_regressor @ adult, arrays.weights, share
        )
        shapes[..., person] -= arrays.template
    model = BodyModel(replace(arrays, shapes=shapes), body.keypoint_offsets, body.keypoint_names)
    return model, np.eye(len(betas), NUM_BETAS)


def _stretched(vertices: Array, joints: Array, weights: Array, proportions: Proportions) -> Array:
    """The mesh (Nv, 3) of a T-pose with `joints` (24, 3) in other proportions.

    Each bone carries its skin by a linear map about its joint, which takes the next joints where
    they shall be and is the bone's girth across that; skinning weights blend the maps. Joints are
    regressed from the mesh, from vertices of several bones: limbs come out as long as they shall be
    to 3 % of that, bones of the trunk to 12 mm.
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

    They stand where they stood, on the same floor. Steps and reaches are those of the adults: a
    child's feet slide, and hands that were held need not meet. Who hides whom follows from the new
    bodies.
    """
    body, betas = reshaped(scene.body, scene.motion.betas, proportions)
    motion = scene.motion
    transl = motion.transl.copy()
    for person in range(scene.people):
        before, after = (
            Figure(model, shape[person])
            for model, shape in ((scene.body, motion.betas), (body, betas))
        )
        vectors = np.concatenate(
            [motion.global_orient[:, person, None], motion.body_pose[:, person]], axis=1
        )
        turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)
        pelvis = before.rest[0] + transl[:, person]

        def sole(figure: Figure, turns: Array = turns, pelvis: Array = pelvis) -> Array:
            """Height (T,) of the lowest point of both feet of who has the pelvis there, z up."""
            return figure.lowest_sole(*figure.joints(turns, pelvis))

        transl[:, person] = pelvis - after.rest[0]
        transl[:, person, 2] += sole(before) - sole(after)
    return replace(
        scene, body=body, motion=BodyMotion(betas, motion.global_orient, motion.body_pose, transl)
    )
