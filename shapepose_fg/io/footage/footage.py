"""The pictures of one camera, frame by frame: from a video, a folder of pictures, or a single
picture.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_bytes
from shapepose_fg.io.camera_names import in_order, last_number
from shapepose_fg.io.footage.places import PICTURES

Picture = NDArray[np.uint8]
"""A picture: (H, W, 3) in the order blue, green, red."""
Progress = Callable[[int, int], None]
"""Callback with the number of frames that are done, and the total number."""

_READ_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_SAFE_READING = (
    "protocol_whitelist;file"
    "|format_whitelist;mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpeg,mpegts,mpegvideo,asf,h264,hevc,m4v"
)
"""Options for reading untrusted videos: only the file itself, and no playlists, which could name
other files and addresses."""


def open_footage(path: Path, progress: Progress | None = None) -> "Footage":
    """Open the footage at `path`: a video (decoded once, for its frames and times), a folder of
    pictures, or a picture.

    InputError if nothing in it can be read.
    """
    if path.is_dir() or path.suffix.lower() in PICTURES:
        return PictureFiles.open(path)
    return Video.open(path, progress)


def glance(path: Path, capture: Any = None) -> tuple[tuple[int, int], float]:
    """Size (width, height) and frame rate that a video's header states, without decoding it.

    The rate is 0 if it is missing or invalid. `capture` is the video, if it is already open.
    """
    capture = _capture(path) if capture is None else capture
    size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return size, fps if 0 < fps < 1e5 else 0.0


@dataclass
class Video:
    """The readable frames of a video file."""

    path: Path
    size: tuple[int, int]
    """Width and height of the pictures, pixels."""
    time_s: Array
    """(N,) time stamps of the frames in the file, seconds after the first."""
    notes: tuple[str, ...] = ()
    """Notes on problems of the file, one sentence each."""
    _capture: Any = field(default=None, repr=False)
    _next: int = 0
    _last: Picture | None = None

    @property
    def number(self) -> Index:
        """(N,) numbers of the frames, counted from 0."""
        return np.arange(len(self.time_s))

    @classmethod
    def open(cls, path: Path, progress: Progress | None = None) -> "Video":
        """Open the video at `path`; every frame is decoded once, to detect truncated or damaged
        files.
        """
        capture = _capture(path)
        size, fps = glance(path, capture)
        # Longest side of a picture, pixels: a file with a larger one is damaged, or
        # malicious.
        if not (min(size) > 0 and max(size) <= 16384):
            raise InputError(
                f"{path}: its pictures would have {size[0]} x {size[1]} pixels; give an "
                "undamaged video"
            )
        announced = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        stamps = []
        while capture.grab():
            stamps.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3)
            if progress is not None and len(stamps) % 64 == 0:
                progress(len(stamps), announced)
        capture.release()
        if len(stamps) == 0:
            raise InputError(f"{path}: no frame of this video can be read; give an undamaged video")
        time_s, notes = _times(path, np.array(stamps), fps)
        # Headers often count one or two frames too many; a larger difference means a truncated or
        # damaged file.
        if announced - len(stamps) > 2:
            notes.append(
                f"{path}: only {len(stamps)} of the {announced} frames in its header can be "
                "read and are used; the file is truncated or damaged: copy the video again"
            )
        return cls(path, size, time_s, tuple(notes))

    def at(self, place: int) -> Picture | None:
        """The picture of frame `place`; None if it cannot be decoded."""
        if self._capture is not None and place == self._next - 1:
            return self._last
        if self._capture is None or place < self._next:
            self._capture, self._next = _capture(self.path), 0
        while self._next <= place:
            if not self._capture.grab():
                self._next, self._last = place + 1, None
                return None
            self._next += 1
        read, picture = self._capture.retrieve()
        self._last = _fitting(picture if read else None, self.size)
        return self._last


@dataclass
class PictureFiles:
    """A folder of pictures, or one picture."""

    path: Path
    size: tuple[int, int]
    """Width and height of the pictures, pixels."""
    files: tuple[Path, ...]
    """(N,) the files in the order of their numbers."""
    number: Index
    """(N,) number of each frame, increasing."""
    notes: tuple[str, ...] = ()
    """Notes on problems of the files, one sentence each."""
    time_s: Array | None = None
    """Always None: picture files have no time stamps."""

    @classmethod
    def open(cls, path: Path) -> "PictureFiles":
        """Open the pictures at `path`; the last number in a file name is the frame number."""
        files = [path]
        if path.is_dir():
            files = [
                each
                for each in path.iterdir()
                if each.suffix.lower() in PICTURES and each.name[0] != "."
            ]
        if len(files) == 0:
            raise InputError(
                f"{path}: there are no pictures in this folder; known formats are "
                f"{' '.join(sorted(PICTURES))}"
            )
        found = [last_number(each.stem) for each in files]
        if path.is_file() or (len(files) == 1 and found[0] is None):
            return cls(path, _size(files[0]), tuple(files), np.zeros(1, dtype=np.intp))
        if None in found:
            unnumbered = files[found.index(None)]
            raise InputError(f"{unnumbered}: its name has no frame number; number the pictures")
        pairs = zip(found, files, strict=True)
        numbers, paths = zip(
            *in_order([(number, file) for number, file in pairs if number is not None]), strict=True
        )
        count = numbers[-1] - numbers[0] + 1
        notes = (
            (f"{path}: {count - len(files)} of {count} pictures are missing",)
            if count > len(files)
            else ()
        )
        return cls(path, _size(paths[0]), paths, np.array(numbers, dtype=np.intp), notes)

    def at(self, place: int) -> Picture | None:
        """The picture of frame `place`; None if the file cannot be read, or has another size."""
        try:
            return _fitting(_decoded(self.files[place]), self.size)
        except InputError:
            return None


Footage = Video | PictureFiles
"""The footage of one camera: N numbered frames, some of which may have no picture."""


def _fitting(picture: Any, size: tuple[int, int]) -> Picture | None:
    """The picture if it was readable and has the expected size, otherwise None."""
    return picture if picture is not None and picture.shape[1::-1] == size else None


def opencv_path(path: Path) -> str:
    """The path as text for OpenCV, which crashes on text that is no UTF-8. InputError if the bytes
    of the path are no UTF-8.
    """
    try:
        return os.fsencode(path).decode()
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: this path is not UTF-8, so OpenCV cannot open it; rename the file or its "
            "folders"
        ) from None


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Context manager without OpenCV's messages about videos, which are replaced by ours."""
    # FFmpeg reads its level when the first video is opened.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _capture(path: Path) -> Any:
    """The video at `path`, opened by FFmpeg with the options for untrusted files."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such video; check the path")
    name = opencv_path(path.resolve())
    before = os.environ.get(_READ_OPTIONS)
    os.environ[_READ_OPTIONS] = _SAFE_READING
    try:
        with silent_opencv():
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    finally:
        os.environ.pop(_READ_OPTIONS)
        os.environ.update({} if before is None else {_READ_OPTIONS: before})
    if not capture.isOpened():
        raise InputError(
            f"{path}: cannot be read as a video; give another copy, or convert it to H.264 in MP4"
        )
    return capture


def _times(path: Path, stamp_s: Array, fps: float) -> tuple[Array, list[str]]:
    """(N,) seconds after the first frame, and notes on irregular times.

    Time stamps of the file if they increase, otherwise times from its frame rate.
    """
    if len(stamp_s) > 1 and not (np.diff(stamp_s) > 0).all():
        if fps < 0.01:
            raise InputError(
                f"{path}: the video has neither times nor a frame rate; give --fps CAMERA=RATE"
            )
        return np.arange(len(stamp_s)) / fps, [
            (
                f"{path}: the times of frames do not increase; the frame rate of the file, {fps:g} "
                "Hz, is used instead"
            )
        ]
    time_s = stamp_s - stamp_s[0]
    steps = np.diff(time_s)
    gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) if len(steps) > 1 else steps
    return time_s, [] if len(gaps) == 0 else [
        f"{path}: the time between frames varies: {len(gaps)} steps are longer than one and a "
        f"half frames (the first after frame {gaps[0]}); the times in the file are used"
    ]


def _size(file: Path) -> tuple[int, int]:
    """Width and height of a picture, pixels."""
    picture = _decoded(file)
    if picture is None:
        raise InputError(f"{file}: cannot be read as a picture; give an undamaged one")
    return picture.shape[1], picture.shape[0]


def _decoded(file: Path) -> Any:
    """The picture in a file; None if it cannot be read. InputError for a pipe, or a file that is
    too large.
    """
    # Maximum size of a picture's file, bytes.
    content = np.frombuffer(read_bytes(file, 2**29), dtype=np.uint8)
    try:
        return cv2.imdecode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
