"""Cameras in a rerun recording: where they stand, what they saw, what was used of it, and how well it fits."""

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.io.export.job import optional
from shapepose_fg.io.export.rerun_people import set_time
from shapepose_fg.io.export.take import Take
from shapepose_fg.viz.viewer.palette import colour_of

CAMERAS = "world/cameras"
"""Where cameras are in the recording."""
_GATES = {
    Gate.TOO_FAR: (213, 43, 43),
    Gate.CONTRADICTS_BODY: (214, 39, 190),
    Gate.BEHIND_CAMERA: (90, 90, 90),
    Gate.NOT_PLACED: (150, 150, 150),
}
"""Colours of detections that were not used, by reason; those that were have their person's."""

_USED_DOT, _UNUSED_DOT = -2.0, -3.0
"""Radii of dots on the screen, whatever the zoom: that is what rerun takes negative radii for."""


def camera_path(name: str) -> str:
    """Where a camera is in the recording, whatever its name."""
    return f"{CAMERAS}/{escaped(name)}"


def escaped(name: str) -> str:
    """A name as a part of a path in the recording."""
    return optional("rerun", "view").escape_entity_path_part(name)


def log_cameras(rr: ModuleType, stream: Any, rig: Rig) -> None:
    """The cameras, which stand still; their pictures are those of cameras without distortion."""
    for camera in rig.cameras:
        pose = rr.Transform3D(translation=camera.centre, mat3x3=camera.wTc[:3, :3])
        lens = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=camera.image_size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.4,
        )
        stream.log(camera_path(camera.name), pose, lens, static=True)
    reasons = [
        rr.AnnotationInfo(id=int(gate), label=gate.name.lower().replace("_", " "), color=colour)
        for gate, colour in _GATES.items()
    ]
    stream.log(CAMERAS, rr.AnnotationContext(reasons), static=True)


def log_observations(rr: ModuleType, stream: Any, take: Take) -> None:
    """What each camera saw of the people: used in their colours, not used in that of the reason; and residuals."""
    table, rig = take.people.observations, take.rig
    if table is None or rig is None or tuple(table.view_names.tolist()) != rig.names:
        return
    row_frame = np.searchsorted(take.frames, take.people.frame)
    colours = np.rint(255 * np.array([colour_of(who) for who in take.people.person.tolist()])).astype(np.uint8)
    used, seen = table.gate == Gate.USED, table.gate != Gate.NOT_SEEN
    residual = np.where(used, np.linalg.norm(table.residual_px, axis=-1), np.nan)
    names = take.people.joint_names
    for index in range(len(take.frames)):
        set_time(stream, take, index)
        rows = np.flatnonzero(row_frame == index)
        for view, name in enumerate(rig.names):
            path = f"{camera_path(name)}/seen"
            row, joint = np.nonzero(used[rows, :, view])
            points = table.xy[rows[row], joint, view]
            stream.log(
                f"{path}/used",
                rr.Points2D(
                    points,
                    colors=colours[rows[row]],
                    radii=_USED_DOT,
                    labels=_names(names, joint),
                    show_labels=False,
                ),
            )
            row, joint = np.nonzero(seen[rows, :, view] & ~used[rows, :, view])
            points, gate = table.xy[rows[row], joint, view], table.gate[rows[row], joint, view]
            stream.log(f"{path}/not_used", rr.Points2D(points, class_ids=gate, radii=_UNUSED_DOT))
            errors = residual[rows, :, view]
            if np.isfinite(errors).any():
                stream.log(f"plots/residual/{escaped(name)}", rr.Scalars(float(np.nanmedian(errors))))


def _names(names: NDArray[np.str_], joint: NDArray[np.intp]) -> list[str]:
    return names[joint].tolist()
