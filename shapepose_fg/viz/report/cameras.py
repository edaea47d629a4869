"""The page of cameras that were calibrated or refined: where they stand, stood before, and people over them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.take import Take, z_up
from shapepose_fg.viz.report.figures import Residual
from shapepose_fg.viz.report.page import filled
from shapepose_fg.viz.report.scene import camera_of, scene_of

_SCENE_BYTES = 4_000_000
_NEAR_M = 1.5
"""Who is farther away a look later is somebody else."""


def write_camera_page(
    file: Path,
    rig: Rig,
    before: Rig | None,
    points: Array,
    frame: Index,
    time_s: Array,
    joints: Sequence[str],
    heads: Sequence[str],
    rows: Sequence[tuple[str, Sequence[str]]],
    missed_px: Mapping[str, Array],
    summary: str,
    caption: str,
    remarks: Sequence[str],
) -> None:
    """Write a self-contained page of the cameras `rig`, and of those `before`, into `file`.

    People are `points` (P, J, 3) at `frame` (P,), which were taken at `time_s` (P,); `joints` are their names.
    `rows` are each camera's figures under `heads`. `missed_px` are distances (N, V) of joints from where other
    cameras put them, under a name; NaN where unknown.
    """
    scene = None
    if np.isfinite(points).all(axis=-1).any():
        P, J = points.shape[:2]
        people = Reconstruction(
            frame=frame.astype(np.int64),
            person=_followed(points, frame),
            joint_names=np.array(joints),
            joints=points,
            covariance=np.full((P, J, 3, 3), np.nan),
            confidence=np.ones((P, J)),
            status=np.full(P, str(Status.OK)),
            time_s=time_s,
            known=np.where(np.isfinite(points[..., 0]), Known.SEEN, Known.UNKNOWN).astype(np.uint8),
            betas=np.full((P, 10), np.nan),
            global_orient=np.full((P, 3), np.nan),
            body_pose=np.full((P, 23, 3), np.nan),
            transl=np.full((P, 3), np.nan),
        )
        scene = scene_of(Take.of(people, rig.up, rig=rig), None, _SCENE_BYTES)
        if before is not None:
            data = scene.data | {"before": [camera_of(each, z_up(rig.up)) for each in before.cameras]}
            scene = replace(scene, data=data)
    residuals = [
        (name, [Residual.of(each) for each in distances.reshape(-1, len(rig)).T])
        for name, distances in missed_px.items()
    ]
    longest = max((each.high_px or 0.0 for _, of in residuals for each in of), default=0.0)
    text = filled(
        "cameras.html",
        scene,
        title=file.stem,
        summary=summary,
        caption=caption,
        remarks=[*remarks],
        heads=[*heads],
        rows=[(name, [*figures]) for name, figures in rows],
        residuals=residuals,
        longest=longest,
    )
    write_atomically(file, lambda stream: stream.write(text.encode("utf-8", "replace")))


def _followed(points: Array, frame: Index) -> Index:
    """(P,) a number for each person, kept from look to look where somebody is near."""
    person, at, free = np.zeros(len(points), dtype=np.int64), dict[int, Array](), 0
    known = np.isfinite(points[..., :1])
    middle = np.where(known, points, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    for now in np.unique(frame):
        rows, numbers = np.flatnonzero(frame == now), list(at)
        new = {int(row): -1 for row in rows}
        if numbers:
            away = np.linalg.norm(middle[rows][:, None] - np.stack([at[each] for each in numbers]), axis=-1)
            for one, other in zip(*linear_sum_assignment(np.minimum(away, 2 * _NEAR_M)), strict=True):
                if away[one, other] < _NEAR_M:
                    new[int(rows[one])] = numbers[other]
        for row, number in new.items():
            person[row] = free if number < 0 else number
            free += number < 0
        at |= {int(person[row]): middle[row] for row in rows.tolist()}
    return person
