"""Content of a rerun recording: people and cameras in the world, detections, their gates and
residuals.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from shapepose_fg.body.model.rotation import quaternion
from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Axis, Camera, Rig
from shapepose_fg.core.decompositions import principal_axes
from shapepose_fg.core.drawing import bones_of, colour_of, thinned, vertex_normals
from shapepose_fg.core.errors import optional
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Known, Reconstruction, sigma_m
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.io.export.skinned import BONES, motion_of, skin
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.placement import CameraFootage, Placement

_CAMERAS = "world/cameras"
"""Path of the cameras in the recording."""
Drawn = dict[int, dict[int, Array]]
"""By person whose body is shown, and bone: rotations (M, 3, 3) of the bones nearby, relative to
this one, for which its part was shaped."""
_GATES = {
    Gate.TOO_FAR: (213, 43, 43),
    Gate.CONTRADICTS_BODY: (214, 39, 190),
    Gate.BEHIND_CAMERA: (90, 90, 90),
    Gate.NOT_PLACED: (150, 150, 150),
}
"""Colours of unused detections, by reason; used ones have the colour of their person."""


def person_path(identity: int) -> str:
    """Path of a person's entities in the recording."""
    return f"world/people/{identity}"


def camera_path(name: str) -> str:
    """Path of a camera's entities in the recording, for any camera name."""
    return f"{_CAMERAS}/{optional('rerun', 'view').escape_entity_path_part(name)}"


def _set_time(stream: Any, take: Take, index: int) -> None:
    """Set the frame and time for subsequent logging."""
    stream.set_time("frame", sequence=int(take.frames[index]))
    stream.set_time("time", duration=float(take.times_s[index]))


def log_take(stream: Any, take: Take, arrays: SmplArrays | None) -> None:
    """Log a complete take on the timelines `frame` and `time` (seconds).

    Cameras and detections are logged if they are known; bodies if the body model `arrays` is given.
    """
    rr, skin_of = optional("rerun", "view"), None if arrays is None else Skin.of(arrays)
    log_world(stream, take.up, take.rig)
    if take.rig is not None:
        _log_moving(rr, stream, take, take.rig)
        _log_observations(rr, stream, take, take.rig)
    drawn: Drawn = {}
    for person in range(len(take.persons)):
        _log_looks(rr, stream, int(take.persons[person]), skin_of)
        _log_person(rr, stream, take, person)
        if skin_of is not None:
            _log_bodies(rr, stream, take, person, skin_of, drawn)
    stream.reset_time()


class LiveLog:
    """Logs people frame by frame as they arrive; the world and its cameras are logged at the
    beginning.
    """

    def __init__(self, stream: Any, rig: Rig, arrays: SmplArrays) -> None:
        self._rr, self._stream, self._rig = optional("rerun", "view"), stream, rig
        self._skin, self._met = Skin.of(arrays), set[int]()
        self._there, self._drawn = set[int](), Drawn()
        log_world(stream, rig.up, rig)

    def moment(self, rows: Reconstruction) -> None:
        """Log the people of one frame, and clear those who are no longer in `rows`."""
        persons, time_s = rows.person.astype(np.int64), rows.time_s[:1]
        if len(rows) > 0:
            self._stream.set_time("time", duration=float(time_s[0]))
        for identity in self._there - set(persons.tolist()):
            for path in (person_path(identity), _sigma_path(identity)):
                self._stream.log(path, self._rr.Clear(recursive=True))
        self._there = set(persons.tolist())
        self._drawn = {
            identity: parts for identity, parts in self._drawn.items() if identity in self._there
        }
        if len(rows) == 0:
            return
        places = np.arange(len(rows), dtype=np.intp)[:, None]
        take = Take(
            rows,
            persons,
            places,
            rows.frame[:1].astype(np.int64),
            time_s,
            1.0,
            self._rig.up,
            self._rig,
        )
        for person, identity in enumerate(persons.tolist()):
            if identity not in self._met:
                self._met.add(identity)
                _log_looks(self._rr, self._stream, identity, self._skin)
            _log_person(self._rr, self._stream, take, person)
            _log_bodies(self._rr, self._stream, take, person, self._skin, self._drawn)


@dataclass(frozen=True)
class Skin:
    """A body model, and the parts of its simplified surface that are drawn: one for each bone.

    A part moves rigidly with its bone, so that most frames of a body are 24 poses instead of all
    vertices. Neighbouring parts share triangles.
    """

    arrays: SmplArrays
    parts: tuple[tuple[Index, NDArray[np.int32]], ...]
    """By bone: indices of its vertices, and triangles (F, 3) between these."""

    @classmethod
    def of(cls, arrays: SmplArrays) -> "Skin":
        """Simplify the surface for a viewer, and cut it at the bones."""
        kept, faces, _ = thinned(arrays.template, arrays.faces)
        parts = []
        bone_of = arrays.weights[kept].argmax(axis=1)[faces]
        for bone in range(BONES):
            own = faces[(bone_of == bone).any(axis=1)]
            vertices, triangles = np.unique(own, return_inverse=True)
            parts.append((kept[vertices], triangles.reshape(-1, 3).astype(np.int32)))
        return cls(arrays, tuple(parts))


def log_world(stream: Any, up: Axis, rig: Rig | None) -> None:
    """Log static content: the up axis, and the cameras, if known."""
    rr = optional("rerun", "view")
    axes = f"RIGHT_HAND_{up[-1].upper()}_{'DOWN' if up[0] == '-' else 'UP'}"
    stream.log("world", getattr(rr.ViewCoordinates, axes), static=True)
    if rig is not None:
        _log_cameras(rr, stream, rig)


def _part_path(identity: int, bone: int) -> str:
    return f"{person_path(identity)}/body/{SMPL_24[bone]}"


def _sigma_path(identity: int) -> str:
    return f"plots/sigma/person_{identity}"


def _log_looks(rr: ModuleType, stream: Any, identity: int, skin_of: Skin | None) -> None:
    """Log static content of a person: line colour, and triangles of the surface."""
    colour = _rgb8(np.array(colour_of(identity)))
    stream.log(
        _sigma_path(identity),
        rr.SeriesLines(colors=colour[None], names=f"person {identity}"),
        static=True,
    )
    shade = [*colour.tolist(), round(255 * 0.55)]
    for bone, (_, faces) in enumerate(() if skin_of is None else skin_of.parts):
        surface = rr.Mesh3D.from_fields(triangle_indices=faces, albedo_factor=shade)
        stream.log(_part_path(identity, bone), surface, static=True)


def _log_person(rr: ModuleType, stream: Any, take: Take, person: int) -> None:
    """Log joints, bones, ellipsoids and sigmas of one person, frame by frame; clear them when the
    person leaves.
    """
    identity, people, there_before = int(take.persons[person]), take.people, False
    path, plot, colour = person_path(identity), _sigma_path(identity), np.array(colour_of(identity))
    bones, sigma = bones_of(tuple(people.joint_names.tolist())), 1e3 * sigma_m(people.covariance)
    for index, row in enumerate(take.rows[person].tolist()):
        if row < 0 and not there_before:
            continue
        _set_time(stream, take, index)
        there_before = row >= 0
        if row < 0:
            for path_ in (path, plot):
                stream.log(path_, rr.Clear(recursive=True))
            continue
        joints, known = people.joints[row], sigma[row][np.isfinite(sigma[row])]
        placed = np.flatnonzero(np.isfinite(joints).all(axis=1))
        seen = people.known[row][placed] == Known.SEEN
        # Share of white in the colour of a joint that no view detected.
        shades = np.where(seen[:, None], colour, colour + 0.6 * (1 - colour))
        points = rr.Points3D(
            joints[placed],
            colors=_rgb8(shades),
            radii=np.where(seen, 0.016, 0.010),
            labels=people.joint_names[placed].tolist(),
            show_labels=False,
        )
        stream.log(f"{path}/joints", points)
        lines = joints[bones]
        lines = lines[np.isfinite(lines).all(axis=(1, 2))]
        stream.log(f"{path}/bones", rr.LineStrips3D(lines, colors=_rgb8(colour[None]), radii=0.007))
        stream.log(
            f"{path}/uncertainty",
            _ellipsoids(rr, joints[placed], people.covariance[row][placed], colour),
        )
        if len(known) > 0:
            stream.log(plot, rr.Scalars(float(np.median(known))))


def _ellipsoids(rr: ModuleType, centres: Array, covariance: Array, colour: Array) -> Any:
    """The 95 % ellipsoids of joints."""
    fine = np.isfinite(covariance).all(axis=(1, 2))
    variance, axes = principal_axes(covariance[fine])
    # Radius, in standard deviations, of the 95 % ellipsoid of a 3D Gaussian.
    return rr.Ellipsoids3D(
        centers=centres[fine],
        half_sizes=float(np.sqrt(2 * gammaincinv(1.5, 0.95))) * np.sqrt(np.maximum(variance, 0)),
        quaternions=Rotation.from_matrix(axes).as_quat() if fine.any() else np.zeros((0, 4)),
        colors=_rgb8(colour[None]),
        line_radii=0.0008,
    )


def _log_bodies(
    rr: ModuleType, stream: Any, take: Take, person: int, skin_of: Skin, drawn: Drawn
) -> None:
    """Log the body of one person, in the frames that have one: the poses of the bones, and the
    shape of a part when it appears, or when a joint has bent since.
    """
    identity, arrays = int(take.persons[person]), skin_of.arrays
    motion = motion_of(take, person, arrays, np.eye(3))
    index = np.zeros(0, dtype=np.intp) if motion is None else motion.index
    appears = np.diff(index, prepend=-1 if identity in drawn else -2) > 1
    absent = np.setdiff1d(np.r_[0, index + 1], index)
    for at in absent[absent < len(take.frames)].tolist():
        _set_time(stream, take, at)
        stream.log(f"{person_path(identity)}/body", rr.Clear(recursive=True))
    shapes = drawn.pop(identity, {})
    if motion is None:
        return
    if index[-1] == len(take.frames) - 1:
        drawn[identity] = shapes
    times = [
        rr.TimeColumn("frame", sequence=take.frames[index]),
        rr.TimeColumn("time", duration=take.times_s[index]),
    ]
    turns, joints = motion.turns(), motion.joints()
    for bone, (kept, faces) in enumerate(skin_of.parts):
        path = _part_path(identity, bone)
        # Minimum weight of a bone that shapes a part.
        near = arrays.weights[kept].max(axis=0) > 0.1
        bends = turns[:, bone, None].mT @ turns[:, near]
        for n, at in enumerate(index.tolist()):
            trace = (bends[n] * shapes.get(bone, 0.0)).sum(axis=(1, 2))  # 1 + 2 cos of the bend
            # Bend of a joint, radians, after which the shapes of the parts nearby
            # are logged again.
            if appears[n] or trace.min() < 1 + 2 * math.cos(0.35):
                shapes[bone] = bends[n]
                turn, way = motion.rotations[n, None], motion.pelvis[n, None]
                vertices = skin(arrays, motion.rest.betas[None], turn, way, kept)[0]
                vertices = (vertices - joints[n, bone]) @ turns[n, bone]
                normals = vertex_normals(vertices, faces)
                _set_time(stream, take, at)
                stream.log(
                    path,
                    rr.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals),
                )
        place, turn = joints[:, bone], np.roll(quaternion(turns[:, bone]), -1, axis=-1)
        if len(index) == 1:  # live: rerun collects single rows, but not columns
            _set_time(stream, take, int(index[0]))
            stream.log(path, rr.Transform3D.from_fields(translation=place[0], quaternion=turn[0]))
        else:
            poses = rr.Transform3D.columns(translation=place, quaternion=turn)
            rr.send_columns(path, times, poses, recording=stream)


def _log_moving(rr: ModuleType, stream: Any, take: Take, rig: Rig) -> None:
    """Log moving cameras, frame by frame."""
    for index, time_s in enumerate(take.times_s if rig.moves else ()):
        _set_time(stream, take, index)
        for camera, moves in zip(
            rig.at(np.full(len(rig), time_s)).cameras, rig.carrier >= 0, strict=True
        ):
            if moves:
                pose = rr.Transform3D(translation=camera.centre, mat3x3=camera.wTc[:3, :3])
                stream.log(camera_path(camera.name), pose)


def _log_cameras(rr: ModuleType, stream: Any, rig: Rig) -> None:
    """Log lenses and poses of cameras; their pictures are undistorted."""
    for camera in rig.cameras:
        pose = rr.Transform3D(translation=camera.centre, mat3x3=camera.wTc[:3, :3])
        lens = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=camera.image_size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.4,
        )
        stream.log(camera_path(camera.name), *([] if camera.carrier else [pose]), lens, static=True)
    words = {gate: gate.name.lower().replace("_", " ") for gate in _GATES}
    reasons = [
        rr.AnnotationInfo(id=int(gate), label=words[gate], color=_GATES[gate]) for gate in _GATES
    ]
    stream.log(_CAMERAS, rr.AnnotationContext(reasons), static=True)


def _log_observations(rr: ModuleType, stream: Any, take: Take, rig: Rig) -> None:
    """Log each camera's detections (used ones in the person's colour, unused ones by reason), and
    the residuals.
    """
    table = take.people.observations
    if table is None or tuple(table.view_names.tolist()) != rig.names:
        return
    row_frame = np.searchsorted(take.frames, take.people.frame)
    colours = _rgb8(np.array([colour_of(identity) for identity in take.people.person.tolist()]))
    used, seen = table.gate == Gate.USED, table.gate != Gate.NOT_SEEN
    residual = np.where(used, np.linalg.norm(table.residual_px, axis=-1), np.nan)
    for index in range(len(take.frames)):
        _set_time(stream, take, index)
        rows = np.flatnonzero(row_frame == index)
        for view, path in enumerate(map(camera_path, rig.names)):
            row, joint = np.nonzero(used[rows, :, view])
            # Radii of dots in screen units, independent of the zoom; rerun marks these by negative
            # values.
            points = rr.Points2D(
                table.xy[rows[row], joint, view],
                colors=colours[rows[row]],
                radii=-2.0,
                labels=take.people.joint_names[joint].tolist(),
                show_labels=False,
            )
            stream.log(f"{path}/seen/used", points)
            row, joint = np.nonzero(seen[rows, :, view] & ~used[rows, :, view])
            xy, gate = table.xy[rows[row], joint, view], table.gate[rows[row], joint, view]
            stream.log(f"{path}/seen/not_used", rr.Points2D(xy, class_ids=gate, radii=-3.0))
            errors = residual[rows, :, view]
            if np.isfinite(errors).any():
                plot = path.replace(_CAMERAS, "plots/residual", 1)
                stream.log(plot, rr.Scalars(float(np.nanmedian(errors))))


def log_pictures(
    stream: Any,
    take: Take,
    pictures: Sequence[tuple[CameraFootage, Footage]],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Log the pictures of the cameras in the frames of a take, undistorted, so that people and
    detections match them.
    """
    rr = optional("rerun", "view")
    if take.rig is None:
        raise ValueError("pictures are only shown with cameras; cameras.json is missing")
    done, total = 0, len(pictures) * len(take.frames)
    for used, footage in pictures:
        camera = take.rig.cameras[take.rig.names.index(used.name)]
        maps = undistorting(camera, used.placement)
        path = f"{camera_path(camera.name)}/picture"
        for index, frame in enumerate(take.frames.tolist()):
            place = int(used.places[frame]) if frame < len(used.places) else -1
            picture = footage.at(place) if place >= 0 else None
            _set_time(stream, take, index)
            if picture is None:
                stream.log(path, rr.Clear(recursive=False))
            else:
                straight = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderValue=(90, 90, 90))
                # JPEG quality, 0 to 100; one second of four cameras in full HD
                # has about 30 MB.
                _, jpeg = cv2.imencode(".jpg", straight, [cv2.IMWRITE_JPEG_QUALITY, 75])
                stream.log(path, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg"))
            done += 1
            if progress is not None:
                progress(done, total)


def undistorting(
    camera: Camera, placement: Placement
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps for undistortion (columns and rows, (H, W)): position in the original picture of each
    pixel of the undistorted, calibrated picture.
    """
    width, height = camera.image_size
    column, row = np.meshgrid(
        np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    )
    pixels = np.stack([column.ravel(), row.ravel()], axis=1)
    there = (
        placement.to_picture(camera.distort(pixels)).reshape(height, width, 2).astype(np.float32)
    )
    return np.ascontiguousarray(there[..., 0]), np.ascontiguousarray(there[..., 1])


def _rgb8(colours: Array) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)
