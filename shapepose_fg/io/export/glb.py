"""GLB, binary glTF 2.0: every person's skinned mesh with its motion, by pygltflib; y up, metres, seconds."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.core.drawing import colour_of, vertex_normals
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.io.export.job import Job, Written, optional
from shapepose_fg.io.export.skinned import BONES, Motion, everybody
from shapepose_fg.io.export.take import y_up

_SET = 4
"""Bones in a set of influences. Every program reads the first set, Blender all of them."""
_ARRAY, _ELEMENTS = 34962, 34963
"""glTF's targets: what vertices have, and which vertices make triangles."""
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


def write_glb(job: Job) -> Written:
    """`people.glb`."""
    take, written = job.take, Written()
    motions = dict(everybody(job, take, "glb", y_up(take.up), written))
    if len(motions) == 0:
        return written
    if job.arrays.pose_blend is not None:
        written.notes.append("glb: the body's pose-dependent corrections of the skin are left out")
    written.add(job.folder / "people.glb", glb_bytes(motions, job.arrays, take.times_s))
    return written


def glb_bytes(motions: dict[int, Motion], arrays: SmplArrays, times_s: NDArray[np.float64]) -> bytes:
    """A GLB file of people by their numbers, in frames taken at `times_s` (T,); the file's time 0 is the first.

    A person is a node with a tree of 24 joints and a skinned mesh below it. Where a person is not there, its node
    is scaled to zero, glTF's way to hide things. Rotations are interpolated along the sphere, the pelvis on a
    line.
    """
    gltf = optional("pygltflib", "export")
    file, buffers = gltf.GLTF2(), Buffers()
    sets: dict[str, int] = {}
    for number, (joints, weights) in enumerate(influences(arrays.weights)):
        sets[f"JOINTS_{number}"] = buffers.vertices(joints)
        sets[f"WEIGHTS_{number}"] = buffers.vertices(weights)
    skin = _Skin(buffers.indices(arrays.faces.reshape(-1).astype(np.uint32)), sets)
    animation = gltf.Animation(name="motion")
    times = times_s - times_s[0]
    roots = []
    for who, motion in motions.items():
        first = len(file.nodes)
        _add_person(gltf, file, buffers, who, motion, skin)
        _animate(gltf, animation, buffers, first, motion, times)
        roots.append(first)
    file.asset = gltf.Asset(version="2.0", generator="shapepose-fg")
    file.scene, file.scenes = 0, [gltf.Scene(name="people", nodes=roots)]
    file.animations = [animation]
    file.accessors, file.bufferViews = buffers.accessors, buffers.views
    file.buffers = [gltf.Buffer(byteLength=len(buffers.data))]
    file.set_binary_blob(buffers.data)
    return b"".join(file.save_to_bytes())


def influences(weights: NDArray[np.float64]) -> list[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    """The bones (Nv, 4) that move each vertex most, with their weights (Nv, 4); then the next four, if there are.

    All sets together are the weights (Nv, 24) themselves. A program that reads the first set alone and makes it
    sum to 1 again draws 1 in 100 vertices of the open body, at neck and shoulders, more than 1 mm elsewhere.
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    sorted_weights = np.take_along_axis(weights, order, axis=1).astype(np.float32)
    most = int((sorted_weights > 0).sum(axis=1).max())
    sets = []
    for start in range(0, most, _SET):
        part = slice(start, start + _SET)
        # glTF wants 0 for a bone without weight.
        joints = np.where(sorted_weights[:, part] > 0, order[:, part], 0).astype(np.uint8)
        sets.append((joints, np.ascontiguousarray(sorted_weights[:, part])))
    return sets


@dataclass(frozen=True)
class _Skin:
    """What the skins of all people share: numbers of accessors."""

    triangles: int
    influences: dict[str, int]


def _add_person(gltf: Any, file: Any, buffers: "Buffers", who: int, motion: Motion, skin: "_Skin") -> None:
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
        **skin.influences,
    )
    primitive = gltf.Primitive(attributes=attributes, indices=skin.triangles, material=len(file.materials))
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
    gltf: Any, animation: Any, buffers: "Buffers", first: int, motion: Motion, times: NDArray[np.float64]
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


class Buffers:
    """glTF's binary part: arrays one after the other, each described by an accessor."""

    def __init__(self) -> None:
        self._gltf = optional("pygltflib", "export")
        self.accessors: list[Any] = []
        self.views: list[Any] = []
        self._parts: list[bytes] = []
        self._length = 0

    def vertices(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Number of the accessor of a vertex attribute; `bounds` are asked for of positions."""
        return self._add(values, _ARRAY, bounds)

    def indices(self, values: NDArray[Any]) -> int:
        """Number of the accessor of triangles' vertices, flat."""
        return self._add(values, _ELEMENTS, False)

    def values(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Number of the accessor of anything else; `bounds` are asked for of an animation's times."""
        return self._add(values, None, bounds)

    @property
    def data(self) -> bytes:
        """All arrays."""
        return b"".join(self._parts)

    def _add(self, values: NDArray[Any], target: int | None, bounds: bool) -> int:
        flat = np.ascontiguousarray(values.mT if values.ndim == 3 else values)  # matrices go column by column
        content = flat.tobytes()
        self.views.append(
            self._gltf.BufferView(buffer=0, byteOffset=self._length, byteLength=len(content), target=target)
        )
        limits = {"min": np.atleast_1d(flat.min(0)).tolist(), "max": np.atleast_1d(flat.max(0)).tolist()}
        self.accessors.append(
            self._gltf.Accessor(
                bufferView=len(self.views) - 1,
                componentType=_COMPONENTS[flat.dtype.name],
                count=len(flat),
                type=_TYPES[values.shape[1:]],
                **(limits if bounds else {}),
            )
        )
        padding = -len(content) % 4  # each array begins at a multiple of 4 bytes
        self._parts.append(content + bytes(padding))
        self._length += len(content) + padding
        return len(self.accessors) - 1
