"""A result drawn over all cameras' pictures, wherever these are: videos or still images, whole or not at all."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import OpenedReconstruction, Reconstruction
from shapepose_fg.io.footage.footage import Footage, Picture, open_footage
from shapepose_fg.io.footage.placement import FOOTAGE, CameraFootage, placements_of, read_used_footage
from shapepose_fg.io.footage.places import find_footage
from shapepose_fg.viz.bodies import surfaces
from shapepose_fg.viz.overlay import drawing

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

_MOST_FRAMES = 10_000_000
"""No recording is as long: numbers in the names of pictures that are not those of frames."""


def pictures_of(
    run: Mapping[str, Any],
    rig: Rig,
    drawn: Sequence[str],
    videos: Sequence[str] | None = None,
    detections: Path | None = None,
    image_placement: Sequence[str] = (),
    open_one: Callable[[str, Path], Footage] = lambda _, path: open_footage(path),
    tell: Callable[[str], None] = print,
) -> list[tuple[CameraFootage, Footage]]:
    """The pictures of the cameras `drawn`, and which belongs to which frame; InputError where they are missing.

    `run` is what the result's run.json says. They are in `videos`, as `find_footage` takes it, or where `detect`
    says in the folder `detections`, or beside what the result was made from. `image_placement` is how those of
    another size than the calibration's came about, as `placements_of` takes it. `open_one` opens the pictures of a
    camera, by its name; `tell` is given what was taken to be what.
    """
    used = {each.name: each for each in _used_footage(run, detections)}
    unknown = [name for name in drawn if name not in used]
    notes: list[str] = []
    if videos is not None:
        places, notes = find_footage(videos, drawn)
        paths = dict(zip(drawn, places, strict=True))
    elif len(unknown) > 0:
        raise InputError(
            f"nothing says where the pictures of camera {unknown[0]} are; give --videos, or with --detections the"
            " folder that `shapepose-fg detect` wrote"
        )
    else:
        paths = {name: used[name].path for name in drawn}
    for name, path in paths.items():
        if not path.exists():
            raise InputError(f"{path}: the pictures of camera {name} are not there any more; give --videos")
    opened = {name: open_one(name, path) for name, path in paths.items()}
    # What detect was told of the pictures holds as long as they have the same size.
    alike = {
        name: used[name].placement
        for name, each in opened.items()
        if name in used and used[name].placement.picture_size == each.size and not image_placement
    }
    for name, placement in alike.items():
        size = rig.cameras[rig.names.index(name)].image_size
        if placement.calibrated_size != size:
            theirs, ours = (f"{width} x {height}" for width, height in (placement.calibrated_size, size))
            raise InputError(
                f"{FOOTAGE}: camera {name} was calibrated for pictures of {theirs}, and the cameras.json of the"
                f" result is for {ours}; give --detections with the folder of this result, or --image-placement"
            )
    sizes = {name: each.size for name, each in opened.items() if name not in alike}
    placements, concluded = placements_of(image_placement, sizes, rig)
    notes += concluded
    if len(unknown) > 0:
        first = run.get("numbered_from")
        picture = "the first picture" if first is None else f"picture {first}"
        notes.append(
            f"frame {first or 0} of the result is taken to be {picture} of {' '.join(unknown)}, and so on"
        )
    for text in notes:
        tell(text)
    pairs = []
    for name, footage in opened.items():
        index = used[name].places if name in used else _counted(footage, "numbered_from" in run)
        index = np.where(index < len(footage.number), index, -1)
        pairs.append((CameraFootage(name, footage.path, (placements | alike)[name], index), footage))
    return pairs


def _counted(footage: Footage, numbered: bool) -> Index:
    """(T,) the picture of each frame, -1 where one is missing: that of its number, or counted from the first."""
    first = 0 if numbered else int(footage.number[0])
    count = int(footage.number[-1]) - first + 1
    if count > _MOST_FRAMES:
        raise InputError(
            f"{footage.path}: pictures are numbered from {footage.number[0]} to {footage.number[-1]}; number them"
            " by the frames of the recording"
        )
    index = np.full(count, -1, dtype=np.intp)
    index[footage.number - first] = np.arange(len(footage.number))
    return index


def _used_footage(run: Mapping[str, Any], detections: Path | None) -> list[CameraFootage]:
    """What `detect` wrote of the pictures, beside the detections that the result was made from."""
    if detections is not None:
        file = detections / FOOTAGE if detections.is_dir() else detections
        if not file.is_file():
            raise InputError(f"{file}: there is no such file; give the folder that `shapepose-fg detect` wrote")
        return read_used_footage(file)
    inputs = run.get("inputs")
    texts = [Path(str(each)) for each in (inputs if isinstance(inputs, dict) else ())]
    files = [each.parent / FOOTAGE for each in texts if each.suffix in (".txt", ".json")]
    return next((read_used_footage(file) for file in files if file.is_file()), [])


_INK: drawing.Colour = (45, 45, 45)
_GRID = "grid"
"""What the file with all cameras is called."""


@dataclass(frozen=True)
class Overlay:
    """A result over the pictures of some cameras."""

    people: OpenedReconstruction
    """The result, as it was saved."""
    rig: Rig
    """Its cameras."""
    cameras: Sequence[tuple[CameraFootage, Footage]]
    """The pictures of the cameras that are drawn."""
    skeletons: bool = True
    """Whether bones and joints are drawn, with the person's number."""
    detections: bool = True
    """Whether 2D detections are drawn that were used, and in another colour those that were not."""
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
            view = drawing.PictureView(camera, used.placement, size)
            picture = _picture(used, footage, frame, size)
            if body is not None:
                colours = [drawing.blue_green_red(int(people.person[row])) for row in rows]
                picture = drawing.draw_bodies(picture, view, vertices, body.faces, colours)
            if self.detections:
                _draw_detections(picture, view, people)
            if self.skeletons:
                drawing.draw_skeletons(picture, view, drawing.Skeletons.of(people))
            drawing.draw_label(picture, f"camera {used.name}, frame {frame}", (0, 0), _INK, centred=False)
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
    """Draw `frames` and write them into `folder`: a video of `fps` frames a second, or without a rate still
    pictures.

    All cameras are in a grid `width` pixels wide, or each has a file of its own where that is None. `done` is told
    how many frames are. Returns the files.
    """
    # Videos want even sides.
    own = [(footage.size[0] // 2 * 2, footage.size[1] // 2 * 2) for _, footage in over.cameras]
    columns, cells = (1, own) if width is None else grid_shape(own, width)
    names = [used.name for used, _ in over.cameras] if width is None else [_GRID]
    paths: list[Path] = []
    videos: list[cv2.VideoWriter] = []
    with ExitStack() as stack:
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
                videos[index].write(np.ascontiguousarray(picture))
            done(at + 1, len(frames))
    return paths


@contextmanager
def _video(path: Path, size: Sequence[int], fps: float) -> Iterator[cv2.VideoWriter]:
    """An mp4 video that is put in place when it is complete."""
    part = path.with_name(f".{path.stem}.part.mp4")  # OpenCV tells the container by the ending
    path.parent.mkdir(parents=True, exist_ok=True)
    part.unlink(missing_ok=True)  # it may be a link
    writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    try:
        if not writer.isOpened():
            raise InputError(f"{path}: a video of {size[0]} x {size[1]} cannot be written; check space and rights")
        yield writer
        writer.release()
        part.replace(path)
    finally:
        writer.release()
        part.unlink(missing_ok=True)


def _draw_detections(picture: Picture, view: drawing.PictureView, people: Reconstruction) -> None:
    """Draw what the camera of `view` saw of the people of one frame."""
    table = people.observations
    if table is None or view.camera.name not in table.view_names.tolist():
        return
    v = table.view_names.tolist().index(view.camera.name)
    gate = table.gate[..., v]
    row, joint = np.nonzero(gate != Gate.NOT_SEEN)
    xy = view.through_lens(table.xy[row, joint, v])
    colours = np.array([drawing.blue_green_red(person) for person in table.person[row].tolist()]).reshape(-1, 3)
    drawing.draw_detections(picture, xy, gate[row, joint] == Gate.USED, colours)


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
    missing = [max(row.shape[1] for row in rows) - row.shape[1] for row in rows]
    pairs = zip(rows, missing, strict=True)
    return np.vstack([np.pad(row, ((0, 0), (0, n), (0, 0)), constant_values=30) for row, n in pairs])
