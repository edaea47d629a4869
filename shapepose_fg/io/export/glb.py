"""GLB, binary glTF 2.0: the animated skinned mesh of every person; y up, metres, seconds."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.drawing import colour_of, vertex_normals
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.core.world_axes import y_up
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.skinned import BONES, SkinnedMotion, everybody

_SET = 4
"""Number of bone influences of a vertex in one set. Every program reads the first set, Blender all
sets."""
_ARRAY, _ELEMENTS = 34962, 34963
"""glTF's buffer targets: vertex attributes, and triangle indices."""


def write_glb(job: Job) -> Written:
    """Write `people.glb`."""
    written, turn = Written(), y_up(job.take.up)
    take, origin = written.near_origin(job.take, turn, "glb", "extras.origin_m of its scene")
    motions = dict(everybody(job, take, "glb", turn, written))
    if len(motions) == 0:
        return written
    if job.arrays.pose_blend is not None:
        written.notes.append("glb: pose-dependent corrections of the body's surface are left out")
    written.add(job.folder / "people.glb", glb_bytes(motions, job.arrays, take.times_s, origin))
    return written


def glb_bytes(
    motions: dict[int, SkinnedMotion],
    arrays: SmplArrays,
    times_s: Array,
    origin_m: Array | None = None,
) -> bytes:
    """A GLB file of people by number, in frames at `times_s` (T,), seconds; time 0 of the file is
    the first frame.

    A person is a node with a tree of 24 joints and a skinned mesh below it. While a person is
    absent, the node is scaled to zero, the usual way to hide objects in glTF. Rotations are
    interpolated spherically, the pelvis linearly. `origin_m` (3,), metres, is the file's origin in
    the world, in the file's axes.
    """
    file = _File()
    shared: dict[str, int] = {}
    for number, (joints, weights) in enumerate(influences(arrays.weights)):
        shared[f"JOINTS_{number}"] = file.array(joints, _ARRAY)
        shared[f"WEIGHTS_{number}"] = file.array(weights, _ARRAY)
    triangles = file.array(arrays.faces.reshape(-1).astype(np.uint32), _ELEMENTS)
    roots = []
    for person, motion in motions.items():
        roots.append(_add_person(file, person, motion, shared, triangles))
        _animate(file, roots[-1], motion, times_s - times_s[0])
    extras = (
        {}
        if origin_m is None or not origin_m.any()
        else {"extras": {"origin_m": origin_m.tolist()}}
    )
    return file.content(roots, extras)


class _File:
    """The lists of a glTF file, and its binary part: arrays one after the other, each described by
    an accessor.
    """

    def __init__(self) -> None:
        names = "nodes meshes materials skins accessors bufferViews".split()
        self.lists: dict[str, list[Any]] = {name: [] for name in names}
        self.samplers, self.channels = list[Any](), list[Any]()
        self._binary = bytearray()

    def add(self, kind: str, **what: Any) -> int:
        """Append to the list `kind`; returns the index in it."""
        self.lists[kind].append(what)
        return len(self.lists[kind]) - 1

    def array(
        self, values: NDArray[Any], target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Append an array and return its accessor; positions and times need `bounds`."""
        flat = np.ascontiguousarray(
            values.mT if values.ndim == 3 else values
        )  # matrices are column-major
        self._binary += bytes(-len(self._binary) % 4)  # arrays are aligned to 4 bytes
        place = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": flat.nbytes}
        self._binary += flat.tobytes()
        limits = {
            "min": np.atleast_1d(flat.min(0)).tolist(),
            "max": np.atleast_1d(flat.max(0)).tolist(),
        }
        return self.add(
            "accessors",
            bufferView=self.add(
                "bufferViews", **place, **({} if target is None else {"target": target})
            ),
            componentType={"uint8": 5121, "uint32": 5125, "float32": 5126}[flat.dtype.name],
            count=len(flat),
            type={(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}[values.shape[1:]],
            **(limits if bounds else {}),
        )

    def content(self, roots: list[int], more: dict[str, Any]) -> bytes:
        """The whole file; its scene has the root nodes `roots`, and `more` are further
        properties.
        """
        binary = bytes(self._binary) + bytes(-len(self._binary) % 4)
        tree = {
            "asset": {"version": "2.0", "generator": "shapepose-fg"},
            "scene": 0,
            "scenes": [{"name": "people", "nodes": roots, **more}],
            "animations": [
                {"name": "motion", "samplers": self.samplers, "channels": self.channels}
            ],
            "buffers": [{"byteLength": len(binary)}],
            **self.lists,
        }
        text = json.dumps(tree, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        pairs = ((b"JSON", text), (b"BIN\0", binary))
        parts = b"".join(struct.pack("<I4s", len(part), kind) + part for kind, part in pairs)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def influences(weights: Array) -> list[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    """The four bones (Nv, 4) with the largest weights of each vertex, and these weights (Nv, 4);
    then the next four, and so on.

    All sets together are equal to the weights (Nv, 24). A program that reads and renormalises only
    the first set draws 1 in 100 vertices of the open body, at neck and shoulders, with an error of
    more than 1 mm.
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    sorted_weights = np.take_along_axis(weights, order, axis=1).astype(np.float32)
    most = int((sorted_weights > 0).sum(axis=1).max())
    sets = []
    for start in range(0, most, _SET):
        part = slice(start, start + _SET)
        # glTF requires bone 0 for a weight of zero.
        joints = np.where(sorted_weights[:, part] > 0, order[:, part], 0).astype(np.uint8)
        sets.append((joints, np.ascontiguousarray(sorted_weights[:, part])))
    return sets


def _add_person(
    file: _File, person: int, motion: SkinnedMotion, shared: dict[str, int], triangles: int
) -> int:
    """Add the nodes of a person in the pose of the first frame, with mesh, material and skin;
    returns the index of the first node.

    All people have the same `triangles` and `shared` vertex attributes, which are accessors.
    """
    first, rest, name = len(file.lists["nodes"]), motion.rest, f"person_{person}"
    file.add("nodes", name=name, children=[first + 1, first + 1 + BONES])
    for joint in range(BONES):
        place = motion.pelvis[0] if joint == 0 else rest.offsets[joint]
        children = [first + 1 + child for child in range(1, BONES) if SMPL_PARENTS[child] == joint]
        file.add(
            "nodes",
            name=f"{name}_{SMPL_24[joint]}",
            translation=place.tolist(),
            rotation=motion.rotations[0, joint].tolist(),
            **({"children": children} if children else {}),
        )
    normals = vertex_normals(rest.vertices, rest.arrays.faces).astype(np.float32)
    attributes = {
        "POSITION": file.array(rest.vertices.astype(np.float32), _ARRAY, bounds=True),
        "NORMAL": file.array(normals, _ARRAY),
        **shared,
    }
    surface = {"baseColorFactor": [*_linear(colour_of(person)), 1.0], "metallicFactor": 0.0}
    material = file.add("materials", name=name, pbrMetallicRoughness=surface)
    primitive = {"attributes": attributes, "indices": triangles, "material": material}
    mesh = file.add("meshes", name=name, primitives=[primitive])
    # In the T-pose, a bone's frame is that of the body, translated to the joint.
    inverse = np.tile(np.eye(4, dtype=np.float32), (BONES, 1, 1))
    inverse[:, :3, 3] = -rest.joints
    bones = list(range(first + 1, first + 1 + BONES))
    skin = file.add(
        "skins",
        name=name,
        inverseBindMatrices=file.array(inverse),
        skeleton=first + 1,
        joints=bones,
    )
    file.add("nodes", name=f"{name}_skin", mesh=mesh, skin=skin)
    return first


def _animate(file: _File, first: int, motion: SkinnedMotion, times: Array) -> None:
    """Add the animation channels of the person whose first node is `first`."""

    def channel(
        node: int, path: str, at: int, values: Array, interpolation: str = "LINEAR"
    ) -> None:
        output = file.array(values.astype(np.float32))
        file.samplers.append({"input": at, "output": output, "interpolation": interpolation})
        file.channels.append(
            {"sampler": len(file.samplers) - 1, "target": {"node": node, "path": path}}
        )

    at = file.array(times[motion.index].astype(np.float32), bounds=True)
    channel(first + 1, "translation", at, motion.pelvis)
    rotations = _shortest(motion.rotations)
    for joint in range(BONES):
        channel(first + 1 + joint, "rotation", at, rotations[:, joint])
    visible = np.zeros(len(times), dtype=bool)
    visible[motion.index] = True
    if not visible.all():
        turns = np.flatnonzero(np.diff(visible, prepend=not visible[0]))
        scale = np.repeat(visible[turns].astype(np.float64)[:, None], 3, axis=1)
        channel(
            first, "scale", file.array(times[turns].astype(np.float32), bounds=True), scale, "STEP"
        )


def _shortest(rotations: Array) -> Array:
    """Quaternions (F, 24, 4) with signs such that successive ones are close to each other."""
    inner = (rotations[1:] * rotations[:-1]).sum(axis=-1, keepdims=True)
    signs = np.cumprod(np.where(inner < 0, -1.0, 1.0), axis=0)
    return np.concatenate([rotations[:1], rotations[1:] * signs])


def _linear(colour: tuple[float, float, float]) -> list[float]:
    """A colour in linear light, as required by glTF, converted from sRGB (IEC 61966-2-1)."""
    srgb = np.array(colour)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).tolist()
