"""The HTML report of calibrated or refined cameras: poses before and after, and the people in their
views.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.cameras.sightings import followed
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.world_axes import z_up
from shapepose_fg.io.export.take import Take
from shapepose_fg.viz.report.figures import Residual
from shapepose_fg.viz.report.page import filled
from shapepose_fg.viz.report.scene import PageScene, scene_camera, scene_of


@dataclass(frozen=True, kw_only=True)
class CameraPage:
    """A self-contained HTML page of cameras, and of the people in their views."""

    rig: Rig
    """The cameras."""
    before: Rig | None = None
    """The given cameras, drawn beside the refined ones; None if there are none to compare with."""
    points: Array
    """(P, J, 3) joints of people, metres."""
    frame: Index
    """(P,) frame of each person."""
    time_s: Array
    """(T,) times of the frames, seconds."""
    skeleton: Skeleton
    """Skeleton; `points` are its core joints."""
    heads: Sequence[str]
    """Column headings of the table of cameras."""
    rows: Sequence[tuple[str, Sequence[str]]]
    """Name of each camera, and its values, a column each."""
    missed_px: Mapping[str, Array]
    """(N, V) distances of joints from their positions by the other cameras, pixels, by name of the
    series; NaN if unknown."""
    lines: Sequence[str]
    """Caption of the table, and lines above it."""
    remarks: Sequence[str] = ()
    """Notes on weakly observed parameters, one sentence each."""

    def write(self, file: Path) -> None:
        """Write the page."""
        residuals = [
            (name, [Residual.of(each) for each in distances.reshape(-1, len(self.rig)).T])
            for name, distances in self.missed_px.items()
        ]
        text = filled(
            "cameras.html",
            self._scene(),
            title=file.stem,
            summary="; ".join(self.lines[1:]),
            caption=f"{self.lines[0]}.",
            remarks=[*self.remarks],
            heads=[*self.heads],
            rows=[(name, [*figures]) for name, figures in self.rows],
            residuals=residuals,
            longest=max((each.high_px or 0.0 for _, of in residuals for each in of), default=0.0),
        )
        write_atomically(file, lambda stream: stream.write(text.encode("utf-8", "replace")))

    def _scene(self) -> PageScene | None:
        if not np.isfinite(self.points).all(axis=-1).any():
            return None
        P, J = self.points.shape[:2]
        people = Reconstruction(
            frame=self.frame.astype(np.int64),
            person=followed(self.frame, self.points).astype(np.int64),
            joint_names=np.array([self.skeleton.joints[joint] for joint in self.skeleton.core]),
            joints=self.points,
            covariance=np.full((P, J, 3, 3), np.nan),
            confidence=np.ones((P, J)),
            status=np.full(P, str(Status.OK)),
            time_s=self.time_s[self.frame],
            known=np.where(np.isfinite(self.points[..., 0]), Known.SEEN, Known.UNKNOWN).astype(
                np.uint8
            ),
            betas=np.full((P, 10), np.nan),
            global_orient=np.full((P, 3), np.nan),
            body_pose=np.full((P, 23, 3), np.nan),
            transl=np.full((P, 3), np.nan),
        )
        up = self.rig.up
        scene = scene_of(Take.of(people, up, rig=self.rig), None, 4_000_000)
        if self.before is None:
            return scene
        before = [scene_camera(each, z_up(up)) for each in self.before.cameras]
        return replace(scene, data=scene.data | {"before": before})
