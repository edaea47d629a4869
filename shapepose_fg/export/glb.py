"""GLB, binary glTF 2.0: every person's skinned mesh with its motion, by pygltflib; y up, metres, seconds."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.export.axes import y_up
from shapepose_fg.export.buffers import Buffers
from shapepose_fg.export.job import Job, Written, optional
from shapepose_fg.export.skinned import BONES, Motion, motion_of
from shapepose_fg.files import write_atomically
from shapepose_fg.rendering import vertex_normals
from shapepose_fg.skeleton import SMPL_24
from shapepose_fg.viewer.palette import colour_of

INFLUENCES = 4
"""Bones that move a vertex: what every program that reads glTF can do."""


def write_glb(job: Job) -> Written:
    """`people.glb`."""
    take, written = job.take, Written()
    motions = {}
    for person, who in enumerate(take.persons.tolist()):
        motion = motion_of(take, person, job.arrays, y_up(take.up))
        if motion is None:
            written.notes.append(f"glb: person {who} has no body in any frame")
        else:
            motions[who] = motion
    if len(motions) == 0:
        return written
    if job.arrays.pose_blend is not None:
        written.notes.append("glb: the body's pose-dependent corrections of the skin are left out")
    content = glb_bytes(motions, job.arrays, take.times_s)
    path = job.folder / "people.glb"
    write_atomically(path, lambda stream: stream.write(content))
    written.files.append(path)
    return written


def glb_bytes(motions: dict[int, Motion], arrays: SmplArrays, times_s: NDArray[np.float64]) -> bytes:
    """A GLB file of people by their numbers, in frames taken at `times_s` (T,); the file's time 0 is the first.

    A person is a node with a tree of 24 joints and a skinned mesh below it. Where a person is not there, its node
    is scaled to zero: glTF's way to hide things. Rotations are interpolated along the sphere, the pelvis on a line.
    """
    gltf = optional("pygltflib", "export")
    file, buffers = gltf.GLTF2(), Buffers()
    joints, weights = four_influences(arrays.weights)
    shared = {
        "indices": buffers.indices(arrays.faces.reshape(-1).astype(np.uint32)),
        "JOINTS_0": buffers.vertices(joints),
        "WEIGHTS_0": buffers.vertices(weights.astype(np.float32)),
    }
    animation = gltf.Animation(name="motion")
    times = times_s - times_s[0]
    roots = []
    for who, motion in motions.items():
        first = len(file.nodes)
        _add_person(gltf, file, buffers, who, motion, shared)
        _animate(gltf, animation, buffers, first, motion, times)
        roots.append(first)
    file.asset = gltf.Asset(version="2.0", generator="shapepose-fg")
    file.scene, file.scenes = 0, [gltf.Scene(name="people", nodes=roots)]
    file.animations = [animation]
    file.accessors, file.bufferViews = buffers.accessors, buffers.views
    file.buffers = [gltf.Buffer(byteLength=len(buffers.data))]
    file.set_binary_blob(buffers.data)
    return b"".join(file.save_to_bytes())


def four_influences(weights: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """(Nv, 4) bones that move each vertex most, and (Nv, 4) their weights, which sum to 1 again."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = kept / kept.sum(axis=1, keepdims=True)
    return np.where(kept > 0, joints, 0).astype(np.uint8), kept


def _add_person(gltf: Any, file: Any, buffers: Buffers, who: int, motion: Motion, shared: dict[str, int]) -> None:
    """Nodes of a person in the pose of its first frame, with mesh, material and skin."""
    first, rest = len(file.nodes), motion.rest
    name = f"person_{who}"
    children: list[list[int]] = [[] for _ in range(BONES)]
    for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
        children[parent].append(first + 1 + joint)
    mesh_node = first + 1 + BONES
    file.nodes.append(gltf.Node(name=name, children=[first + 1, mesh_node]))
    for joint in range(BONES):
        place = motion.pelvis[0] if joint == 0 else rest.offsets[joint]
        file.nodes.append(
            gltf.Node(
                name=f"{name}_{SMPL_24[joint]}",
                children=children[joint],
                translation=place.tolist(),
                rotation=motion.rotations[0, joint].tolist(),
            )
        )
    file.nodes.append(gltf.Node(name=f"{name}_skin", mesh=len(file.meshes), skin=len(file.skins)))
    normals = vertex_normals(rest.vertices, rest.arrays.faces)
    attributes = gltf.Attributes(
        POSITION=buffers.vertices(rest.vertices.astype(np.float32), bounds=True),
        NORMAL=buffers.vertices(normals.astype(np.float32)),
        JOINTS_0=shared["JOINTS_0"],
        WEIGHTS_0=shared["WEIGHTS_0"],
    )
    primitive = gltf.Primitive(attributes=attributes, indices=shared["indices"], material=len(file.materials))
    file.meshes.append(gltf.Mesh(name=name, primitives=[primitive]))
    surface = gltf.PbrMetallicRoughness(baseColorFactor=[*_linear(colour_of(who)), 1.0], metallicFactor=0.0)
    file.materials.append(gltf.Material(name=name, pbrMetallicRoughness=surface))
    # A bone's frame in the T-pose is the body's own, moved to the joint.
    inverse = np.tile(np.eye(4, dtype=np.float32), (BONES, 1, 1))
    inverse[:, :3, 3] = -rest.joints
    file.skins.append(
        gltf.Skin(
            name=name,
            inverseBindMatrices=buffers.values(inverse),
            skeleton=first + 1,
            joints=list(range(first + 1, first + 1 + BONES)),
        )
    )


def _animate(
    gltf: Any, animation: Any, buffers: Buffers, first: int, motion: Motion, times: NDArray[np.float64]
) -> None:
    """The channels of a person whose node is number `first`."""

    def channel(node: int, path: str, at: int, values: NDArray[np.float64], interpolation: str) -> None:
        sampler = gltf.AnimationSampler(
            input=at, output=buffers.values(values.astype(np.float32)), interpolation=interpolation
        )
        animation.samplers.append(sampler)
        target = gltf.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    at = buffers.values(times[motion.index].astype(np.float32), bounds=True)
    channel(first + 1, "translation", at, motion.pelvis, "LINEAR")
    rotations = _shortest(motion.rotations)
    for joint in range(BONES):
        channel(first + 1 + joint, "rotation", at, rotations[:, joint], "LINEAR")
    there = np.zeros(len(times), dtype=bool)
    there[motion.index] = True
    if not there.all():
        turns = np.flatnonzero(np.diff(there, prepend=not there[0]))
        scale = np.repeat(there[turns].astype(np.float64)[:, None], 3, axis=1)
        channel(first, "scale", buffers.values(times[turns].astype(np.float32), bounds=True), scale, "STEP")


def _shortest(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions (F, 24, 4) with signs such that each is near the one before."""
    inner = (rotations[1:] * rotations[:-1]).sum(axis=-1, keepdims=True)
    signs = np.cumprod(np.where(inner < 0, -1.0, 1.0), axis=0)
    return np.concatenate([rotations[:1], rotations[1:] * signs])


def _linear(colour: tuple[float, float, float]) -> list[float]:
    """A colour as glTF's factors have it: linear light, from sRGB (IEC 61966-2-1)."""
    srgb = np.array(colour)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).tolist()
