"""Draws a result over the pictures of all cameras, frame by frame, and writes videos or still
images atomically.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING

import cv2
import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import (
    BODY,
    OpenedReconstruction,
    Reconstruction,
    Status,
    with_body,
)
from shapepose_fg.io.footage.footage import Footage, Picture, opencv_path, silent_opencv
from shapepose_fg.io.footage.placement import CameraFootage
from shapepose_fg.viz.overlay import drawing

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

_GRID = "grid"
"""Name of the file with all cameras."""


@dataclass(frozen=True)
class Overlay:
    """A result, and the pictures of the cameras over which it is drawn."""

    people: OpenedReconstruction
    """The saved result."""
    rig: Rig
    """Cameras of the result."""
    cameras: Sequence[tuple[CameraFootage, Footage]]
    """The pictures of the cameras that are drawn."""
    skeletons: bool = True
    """Whether bones and joints are drawn, with the numbers of people."""
    detections: bool = True
    """Whether 2D detections are drawn: used ones, and in another colour unused ones."""
    body: "BodyModel | None" = None
    """Body model; None if bodies are not drawn."""

    def draw(self, frame: int, sizes: Sequence[tuple[int, int]]) -> list[Picture]:
        """Draw on each camera's picture of `frame`, with one size (width, height) per camera.

        A missing picture is replaced by grey.
        """
        people = self.people.at(frame)
        people = people.rows(np.argsort(people.person, kind="stable"))
        body = self.body
        vertices, rows = (np.zeros((0, 0, 3)), ()) if body is None else surfaces(people, body)
        drawn, rig = [], self.rig
        if rig.moves and len(people) > 0:
            lead_s = 0.0 if people.observations is None else people.observations.lead_s[0]
            rig = rig.at(np.broadcast_to(people.time_s[0] + lead_s, len(rig)))
        for (used, footage), size in zip(self.cameras, sizes, strict=True):
            camera = rig.cameras[rig.names.index(used.name)]
            view = drawing.PictureView(camera, used.placement, size)
            picture = _picture(used, footage, frame, size)
            if body is not None:
                colours = [drawing.blue_green_red(int(people.person[row])) for row in rows]
                picture = drawing.draw_bodies(picture, view, vertices, body.faces, colours)
            if self.detections:
                _draw_detections(picture, view, people)
            if self.skeletons:
                drawing.draw_skeletons(picture, view, drawing.Skeletons.of(people))
            drawing.draw_label(
                picture, f"camera {used.name}, frame {frame}", (0, 0), (45, 45, 45), centred=False
            )
            drawn.append(picture)
        return drawn


def write_overlay(
    over: Overlay,
    frames: Sequence[int],
    folder: Path,
    width: int | None,
    fps: float | None,
    done: Callable[[int, int], None],
) -> list[Path]:
    """Draw `frames` and write them into `folder`: as video with `fps` frames a second, or as still
    pictures if `fps` is None.

    All cameras are in a grid of `width` pixels; if `width` is None, each camera has its own file.
    `done` is called with the number of finished frames and the total. Returns the files.
    """
    # Videos require even sides.
    own = [(footage.size[0] // 2 * 2, footage.size[1] // 2 * 2) for _, footage in over.cameras]
    columns, cells = (1, own) if width is None else grid_shape(own, width)
    names = [used.name for used, _ in over.cameras] if width is None else [_GRID]
    paths: list[Path] = []
    videos: list[Callable[[Picture], None]] = []
    with silent_opencv(), ExitStack() as stack:
        for at, frame in enumerate(frames):
            drawn = over.draw(frame, cells)
            pictures = drawn if width is None else [grid(drawn, columns)]
            for index, (name, picture) in enumerate(zip(names, pictures, strict=True)):
                if fps is None:
                    paths.append(folder / f"{name}_{frame:06d}.jpg")
                    drawing.write_picture(paths[-1], picture)
                    continue
                if at == 0:
                    paths.append(folder / f"{name}.mp4")
                    videos.append(stack.enter_context(_video(paths[-1], picture.shape[1::-1], fps)))
                videos[index](np.ascontiguousarray(picture))
            done(at + 1, len(frames))
    return paths


@contextmanager
def _video(path: Path, size: Sequence[int], fps: float) -> Iterator[Callable[[Picture], None]]:
    """Context manager: a function that appends a picture to an mp4 video, which is moved to `path`
    when it is complete.
    """
    # A name of its own, because two runs may write the same video; OpenCV selects the container by
    # the extension.
    part = path.with_name(f".{token_hex(8)}.part.mp4")
    name = str(Path(opencv_path(path)).with_name(part.name))
    path.parent.mkdir(parents=True, exist_ok=True)
    # OpenCV does not report that a picture was not written, such as on a full disk: the pictures of
    # the file are counted.
    count = 0
    writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)

    def append(picture: Picture) -> None:
        nonlocal count
        writer.write(picture)
        count += 1

    try:
        if not writer.isOpened():
            raise InputError(
                f"{path}: a video of {size[0]} x {size[1]} cannot be written; check the free disk"
                " space and the permissions"
            )
        yield append
        writer.release()
        if cv2.VideoCapture(name, cv2.CAP_FFMPEG).get(cv2.CAP_PROP_FRAME_COUNT) != count:
            raise InputError(
                f"{path}: the video could not be written to its end; check the free disk space"
            )
        part.replace(path)
    finally:
        writer.release()
        part.unlink(missing_ok=True)


def _draw_detections(picture: Picture, view: drawing.PictureView, people: Reconstruction) -> None:
    """Draw the detections of the people of one frame that belong to the camera of `view`."""
    table = people.observations
    if table is None or view.camera.name not in table.view_names.tolist():
        return
    v = table.view_names.tolist().index(view.camera.name)
    gate = table.gate[..., v]
    row, joint = np.nonzero(gate != Gate.NOT_SEEN)
    xy = view.through_lens(table.xy[row, joint, v])
    colours = np.array(
        [drawing.blue_green_red(person) for person in table.person[row].tolist()]
    ).reshape(-1, 3)
    drawing.draw_detections(picture, xy, gate[row, joint] == Gate.USED, colours)


def _picture(used: CameraFootage, footage: Footage, frame: int, size: tuple[int, int]) -> Picture:
    """The camera's picture of a frame at the given size; grey if there is none."""
    place = int(used.places[frame]) if frame < len(used.places) else -1
    picture = footage.at(place) if place >= 0 else None
    if picture is None:
        return np.full((size[1], size[0], 3), 96, dtype=np.uint8)
    if picture.shape[1::-1] == size:
        return picture.copy()
    smaller = size[0] < picture.shape[1]
    scaled = cv2.resize(
        picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    )
    return np.asarray(scaled, dtype=np.uint8)


def grid_shape(sizes: Sequence[tuple[int, int]], width: int) -> tuple[int, list[tuple[int, int]]]:
    """Number of columns for which a grid of pictures is nearest to 16:9, and the size of each
    picture in it.

    All pictures have the same height; sides are even, as required for videos.
    """
    widest = max(w / h for w, h in sizes)

    def aspect(columns: int) -> float:
        return columns * widest / -(-len(sizes) // columns)

    columns = min(range(1, len(sizes) + 1), key=lambda c: abs(np.log(aspect(c) * 9 / 16)))
    height = 2 * max(1, round(width / columns / widest / 2))
    return columns, [(2 * max(1, round(height * w / h / 2)), height) for w, h in sizes]


def grid(pictures: Sequence[Picture], columns: int) -> Picture:
    """Arrange pictures of equal height in rows of `columns`; short rows are padded with dark
    grey.
    """
    rows = [np.hstack(pictures[at : at + columns]) for at in range(0, len(pictures), columns)]
    missing = [max(row.shape[1] for row in rows) - row.shape[1] for row in rows]
    pairs = zip(rows, missing, strict=True)
    return np.vstack(
        [np.pad(row, ((0, 0), (0, n), (0, 0)), constant_values=30) for row, n in pairs]
    )


def surfaces(people: Reconstruction, body: "BodyModel") -> tuple[Array, Index]:
    """Vertices (P, Nv, 3), metres, of the rows with a body, and the indices (P,) of these rows."""
    from shapepose_fg.body.model.body_model import BodyParameters

    columns = [getattr(people, name) for name in BODY]
    rows = np.flatnonzero((people.status == str(Status.OK)) & with_body(*columns))
    if len(rows) == 0:
        return np.zeros((0, body.num_vertices, 3)), rows
    return body.vertices(BodyParameters(*(column[rows] for column in columns))), rows
