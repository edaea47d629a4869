"""Drawn pictures as videos and still images, whole or not at all."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.footage.footage import Picture
from shapepose_fg.viz.overlay.frames import Overlay, grid, grid_shape

_GRID = "grid"
"""What the file with all cameras is called."""


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
    own = [even(footage.size) for _, footage in over.cameras]
    columns, cells = (1, own) if width is None else grid_shape(own, width)
    names = [used.name for used, _ in over.cameras] if width is None else [_GRID]
    paths: list[Path] = []
    videos: list[VideoFile] = []
    with ExitStack() as stack:
        for at, frame in enumerate(frames):
            drawn = over.draw(frame, cells)
            pictures = drawn if width is None else [grid(drawn, columns)]
            for index, (name, picture) in enumerate(zip(names, pictures, strict=True)):
                if fps is None:
                    paths.append(folder / f"{name}_{frame:06d}.jpg")
                    write_picture(paths[-1], picture)
                    continue
                if at == 0:
                    paths.append(folder / f"{name}.mp4")
                    videos.append(stack.enter_context(VideoFile(paths[-1], picture.shape[1::-1], fps)))
                videos[index].add(picture)
            done(at + 1, len(frames))
    return paths


class VideoFile:
    """An mp4 video that is put in place when it is complete; a context manager."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self._path = path
        # OpenCV tells the container by the ending.
        self._part = path.with_name(f".{path.stem}.part.mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = cv2.VideoWriter(str(self._part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        if not self._writer.isOpened():
            self._part.unlink(missing_ok=True)
            raise InputError(
                f"{path}: a video of {size[0]} x {size[1]} cannot be written here; check space and rights"
            )

    def add(self, picture: Picture) -> None:
        """The next frame, of the size that was given."""
        self._writer.write(np.ascontiguousarray(picture))

    def __enter__(self) -> "VideoFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.release()
        if kind is None:
            self._part.replace(self._path)
        else:
            self._part.unlink(missing_ok=True)


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture; the ending, .png or .jpg, says how."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, 90] if path.suffix == ".jpg" else []
    done, content = cv2.imencode(path.suffix, picture, quality)
    if not done:
        raise InputError(f"{path}: the picture cannot be written in this format; use .png or .jpg")
    write_atomically(path, lambda stream: stream.write(content.tobytes()))


def even(size: Sequence[int]) -> tuple[int, int]:
    """(width, height) made even, as videos want them."""
    return int(size[0]) // 2 * 2, int(size[1]) // 2 * 2
