"""A result drawn over the pictures of all cameras, frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import OpenedReconstruction, Reconstruction
from shapepose_fg.io.footage.footage import Footage, Picture
from shapepose_fg.io.footage.placement import CameraFootage
from shapepose_fg.viz.bodies import surfaces
from shapepose_fg.viz.overlay.drawing import (
    Colour,
    Skeletons,
    blue_green_red,
    draw_bodies,
    draw_detections,
    draw_label,
    draw_skeletons,
)
from shapepose_fg.viz.overlay.picture_view import PictureView

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

_INK: Colour = (45, 45, 45)


@dataclass(frozen=True)
class OverlayContent:
    """What is drawn."""

    skeletons: bool = True
    """Bones and joints, with the person's number."""
    detections: bool = True
    """2D detections that were used, and in another colour those that were not."""


@dataclass(frozen=True)
class Overlay:
    """A result over the pictures of some cameras."""

    people: OpenedReconstruction
    """The result, as it was saved."""
    rig: Rig
    """Its cameras."""
    cameras: Sequence[tuple[CameraFootage, Footage]]
    """The pictures of the cameras that are drawn."""
    content: OverlayContent = OverlayContent()
    """What is drawn."""
    body: "BodyModel | None" = None
    """The model of the bodies; None where they are not drawn."""

    def draw(self, frame: int, sizes: Sequence[tuple[int, int]]) -> list[Picture]:
        """Each camera's picture of `frame`, drawn on, at a size (width, height) of its own.

        Where there is no picture it is grey.
        """
        people = self.people.at(frame)
        people = people.rows(np.argsort(people.person, kind="stable"))
        body = self.body
        vertices, rows = (np.zeros((0, 0, 3)), ()) if body is None else surfaces(people, body)
        drawn = []
        for (used, footage), size in zip(self.cameras, sizes, strict=True):
            camera = self.rig.cameras[self.rig.names.index(used.name)]
            view = PictureView(camera, used.placement, size)
            picture = _picture(used, footage, frame, size)
            if body is not None:
                colours = [blue_green_red(person) for person in people.person[list(rows)].tolist()]
                picture = draw_bodies(picture, view, vertices, body.faces, colours)
            if self.content.detections:
                self._draw_detections(picture, view, people)
            if self.content.skeletons:
                draw_skeletons(picture, view, Skeletons.of(people))
            draw_label(picture, f"camera {used.name}, frame {frame}", (0, 0), _INK, centred=False)
            drawn.append(picture)
        return drawn

    def _draw_detections(self, picture: Picture, view: PictureView, people: Reconstruction) -> None:
        """What this camera saw of the people of one frame."""
        table = people.observations
        if table is None or view.camera.name not in table.view_names.tolist():
            return
        v = table.view_names.tolist().index(view.camera.name)
        gate = table.gate[..., v]
        row, joint = np.nonzero(gate != Gate.NOT_SEEN)
        xy = view.through_lens(table.xy[row, joint, v])
        colours = np.array([blue_green_red(person) for person in table.person[row].tolist()]).reshape(-1, 3)
        draw_detections(picture, xy, gate[row, joint] == Gate.USED, colours)


def _picture(used: CameraFootage, footage: Footage, frame: int, size: tuple[int, int]) -> Picture:
    """The camera's picture of a frame at the size that is drawn; grey where there is none."""
    place = int(used.places[frame]) if frame < len(used.places) else -1
    picture = footage.at(place) if place >= 0 else None
    if picture is None:
        return np.full((size[1], size[0], 3), 96, dtype=np.uint8)
    if picture.shape[1::-1] == size:
        return picture.copy()
    smaller = size[0] < picture.shape[1]
    scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return np.asarray(scaled, dtype=np.uint8)


def grid_shape(sizes: Sequence[tuple[int, int]], width: int) -> tuple[int, list[tuple[int, int]]]:
    """How many columns a grid of pictures has that is nearest to 16:9, and the size of each picture in it.

    All have one height, that of a row; sides are even, as videos want them.
    """
    widest = max(w / h for w, h in sizes)

    def aspect(columns: int) -> float:
        return columns * widest / -(-len(sizes) // columns)

    columns = min(range(1, len(sizes) + 1), key=lambda c: abs(np.log(aspect(c) * 9 / 16)))
    height = 2 * max(1, round(width / columns / widest / 2))
    return columns, [(2 * max(1, round(height * w / h / 2)), height) for w, h in sizes]


def grid(pictures: Sequence[Picture], columns: int) -> Picture:
    """Pictures of one height side by side, `columns` in a row; short rows are filled up in dark grey."""
    rows = [np.hstack(pictures[at : at + columns]) for at in range(0, len(pictures), columns)]
    width = max(row.shape[1] for row in rows)
    padded = [
        np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=30)
        if row.shape[1] < width
        else row
        for row in rows
    ]
    return np.vstack(padded)
