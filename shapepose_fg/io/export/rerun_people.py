"""People in a rerun recording: joints, bones, ellipsoids and bodies in the world, and how sure joints are."""

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.io.export.bones import bones_of
from shapepose_fg.io.export.light_mesh import thinned
from shapepose_fg.io.export.markers import sigma_m
from shapepose_fg.io.export.skinned import rest_joints, skin
from shapepose_fg.io.export.take import Take
from shapepose_fg.viz.viewer.palette import colour_of

PEOPLE = "world/people"
"""Where people are in the recording."""
_REGION = float(np.sqrt(chi2.ppf(0.95, 3)))
"""Standard deviations at which an ellipsoid holds 95 % of a Gaussian."""
_JOINT_M, _GUESSED_M, _BONE_M = 0.016, 0.010, 0.007
_PALE = 0.6
"""How much white is in the colour of a joint that no view saw."""
_CHUNK = 64
"""Bodies that are posed at once."""


def person_path(who: int) -> str:
    """Where a person is in the recording."""
    return f"{PEOPLE}/{who}"


def log_people(rr: ModuleType, stream: Any, take: Take, arrays: SmplArrays | None) -> None:
    """All people of a take in all its frames; bodies where there is a body model."""
    bones = bones_of(tuple(take.people.joint_names.tolist()))
    mesh = None if arrays is None else thinned(arrays.template, arrays.faces)
    for person, who in enumerate(take.persons.tolist()):
        colour = np.array(colour_of(who))
        if mesh is not None:
            surface = rr.Mesh3D.from_fields(triangle_indices=mesh[1], albedo_factor=_rgba(colour, 0.55))
            stream.log(f"{person_path(who)}/body", surface, static=True)
        line = rr.SeriesLines(colors=_rgb8(colour[None]), names=f"person {who}")
        stream.log(f"plots/sigma/person_{who}", line, static=True)
        _log_person(rr, stream, take, person, colour, bones)
        if arrays is not None and mesh is not None:
            _log_bodies(rr, stream, take, person, arrays, mesh[0], mesh[1])


def _log_person(
    rr: ModuleType, stream: Any, take: Take, person: int, colour: NDArray[np.float64], bones: NDArray[np.intp]
) -> None:
    """Joints, bones, ellipsoids and sigma of one person, frame by frame; what ends is cleared."""
    who, rows = int(take.persons[person]), take.rows[person]
    path, people, there_before = person_path(who), take.people, False
    names = people.joint_names
    sigma = 1e3 * sigma_m(people.covariance)
    for index, row in enumerate(rows.tolist()):
        if row < 0:
            if there_before:
                set_time(stream, take, index)
                for gone in (path, f"plots/sigma/person_{who}"):
                    stream.log(gone, rr.Clear(recursive=True))
            there_before = False
            continue
        there_before = True
        set_time(stream, take, index)
        joints = people.joints[row]
        placed = np.flatnonzero(np.isfinite(joints).all(axis=1))
        seen = people.known[row][placed] == Known.SEEN
        shades = np.where(seen[:, None], colour, colour + _PALE * (1 - colour))
        radii = np.where(seen, _JOINT_M, _GUESSED_M)
        points = rr.Points3D(
            joints[placed], colors=_rgb8(shades), radii=radii, labels=names[placed].tolist(), show_labels=False
        )
        stream.log(f"{path}/joints", points)
        lines = joints[bones]
        lines = lines[np.isfinite(lines).all(axis=(1, 2))]
        stream.log(f"{path}/bones", rr.LineStrips3D(lines, colors=_rgb8(colour[None]), radii=_BONE_M))
        stream.log(f"{path}/uncertainty", _ellipsoids(rr, joints[placed], people.covariance[row][placed], colour))
        known = sigma[row][np.isfinite(sigma[row])]
        if len(known) > 0:
            stream.log(f"plots/sigma/person_{who}", rr.Scalars(float(np.median(known))))


def _ellipsoids(
    rr: ModuleType, centres: NDArray[np.float64], covariance: NDArray[np.float64], colour: NDArray[np.float64]
) -> Any:
    """The 95 % regions of joints."""
    fine = np.isfinite(covariance).all(axis=(1, 2))
    variance, axes = np.linalg.eigh(covariance[fine])
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a mirror
    return rr.Ellipsoids3D(
        centers=centres[fine],
        half_sizes=_REGION * np.sqrt(np.maximum(variance, 0)),
        quaternions=Rotation.from_matrix(axes).as_quat() if fine.any() else np.zeros((0, 4)),
        colors=_rgb8(colour[None]),
        line_radii=0.0008,
    )


def _log_bodies(
    rr: ModuleType,
    stream: Any,
    take: Take,
    person: int,
    arrays: SmplArrays,
    kept: NDArray[np.intp],
    faces: NDArray[np.int32],
) -> None:
    """The body of one person where there is one."""
    people, rows = take.people, take.rows[person]
    path = f"{person_path(int(take.persons[person]))}/body"
    parts = [getattr(people, name) for name in ("betas", "global_orient", "body_pose", "transl")]
    whole = np.all([np.isfinite(part).reshape(len(part), -1).all(axis=1) for part in parts], axis=0)
    bare = np.flatnonzero((rows >= 0) & ~whole[rows])
    for index in bare.tolist():
        set_time(stream, take, index)
        stream.log(path, rr.Clear(recursive=False))
    index = np.flatnonzero((rows >= 0) & whole[rows])
    for chunk in (index[start : start + _CHUNK] for start in range(0, len(index), _CHUNK)):
        betas, orient, pose, transl = (part[rows[chunk]] for part in parts)
        vectors = np.concatenate([orient[:, None], pose], axis=1).reshape(-1, 3)
        rotations = Rotation.from_rotvec(vectors).as_quat().reshape(len(chunk), -1, 4)
        pelvis = rest_joints(arrays, betas)[:, 0] + transl
        vertices = skin(arrays, betas, rotations, pelvis, kept).astype(np.float32)
        normals = _normals(vertices, faces)
        for place, at in enumerate(chunk.tolist()):
            set_time(stream, take, at)
            mesh = rr.Mesh3D.from_fields(vertex_positions=vertices[place], vertex_normals=normals[place])
            stream.log(path, mesh)


def _normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(F, M, 3) unit normals of bodies' vertices (F, M, 3)."""
    from shapepose_fg.viz.rendering import vertex_normals

    return np.stack([vertex_normals(body, faces) for body in vertices]).astype(np.float32)


def set_time(stream: Any, take: Take, index: int) -> None:
    """What is logged from now on is of this frame."""
    stream.set_time("frame", sequence=int(take.frames[index]))
    stream.set_time("time", duration=float(take.times_s[index]))


def _rgb8(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)


def _rgba(colour: NDArray[np.float64], alpha: float) -> list[int]:
    return [*_rgb8(colour).tolist(), round(255 * alpha)]
