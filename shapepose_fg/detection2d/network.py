"""A heat-map network in an ONNX file, run by OpenCV or by onnxruntime."""

import hashlib
import os
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.networks import NetworkLayout, find_layout
from shapepose_fg.detection2d.onnx_file import read_onnx

Backend = Literal["opencv", "onnxruntime"]
"""What runs the network."""

_Forward = Callable[[NDArray[np.float32]], NDArray[np.float32]]
_TRIAL = 64
"""Side of the empty picture that a new network is tried on, pixels."""


class HeatMapNetwork:
    """A network that makes heat maps and part affinity fields of a picture."""

    def __init__(
        self, layout: NetworkLayout, sha256: str, forward: _Forward, only_size: tuple[int, int] | None = None
    ) -> None:
        self.layout = layout
        """How its output is to be read."""
        self.sha256 = sha256
        """Checksum of its file."""
        self.only_size = only_size
        """(width, height) of the pictures that it takes; None where it takes any."""
        self._forward = forward

    @classmethod
    def load(cls, file: str | Path, layout: str | None = None, backend: Backend = "opencv") -> "HeatMapNetwork":
        """The network in the ONNX `file`. `layout` names one of `layouts()`; without it the file must tell.

        InputError where the file is missing, is no ONNX network, or does not fit the layout.
        """
        file = Path(file)
        content = read_onnx(file)
        sha256 = hashlib.sha256(content).hexdigest()
        forward, only_size = (_with_onnxruntime if backend == "onnxruntime" else _with_opencv)(file, content)
        width, height = only_size or (_TRIAL, _TRIAL)
        try:
            shape = forward(np.zeros((1, 3, height, width), dtype=np.float32)).shape
        except Exception as error:
            raise InputError(
                f"{file}: the network cannot be run on a picture of {width} x {height} ({_first_line(error)});"
                " give one that takes pictures (1, 3, height, width)"
            ) from None
        channels = shape[1] if len(shape) == 4 else None
        found = find_layout(layout, sha256, channels, file)
        wanted = (1, found.channels, height // found.stride, width // found.stride)
        if shape != wanted:
            raise InputError(
                f"{file}: of a picture of {width} x {height} the network makes {_words(shape)} numbers, layout"
                f" {found.name} expects {_words(wanted)}; give the layout of this network"
            )
        return cls(found, sha256, forward, only_size)

    def run(self, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The output (C, H / stride, W / stride) of a `picture` (H, W, 3): blue, green, red.

        Its sides are multiples of `layout.multiple`.
        """
        blob = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32)
        if (self.layout.scale, self.layout.offset) != (1.0, 0.0):
            blob = blob * np.float32(self.layout.scale) + np.float32(self.layout.offset)
        return self._forward(blob)[0]


def _with_opencv(file: Path, content: bytes) -> tuple[_Forward, None]:
    """The network run by OpenCV's dnn, which takes pictures of any size."""
    import cv2

    try:
        net = cv2.dnn.readNetFromONNX(np.frombuffer(content, dtype=np.uint8))
        empty = net.empty()
    except cv2.error as error:
        raise InputError(f"{file}: not an ONNX network that OpenCV can read ({_first_line(error)})") from None
    if empty:
        raise InputError(f"{file}: not an ONNX network; give the ONNX file of a network")

    def forward(blob: NDArray[np.float32]) -> NDArray[np.float32]:
        net.setInput(blob)
        return np.asarray(net.forward(), dtype=np.float32)

    return forward, None


def _with_onnxruntime(file: Path, content: bytes) -> tuple[_Forward, tuple[int, int] | None]:
    """The network run by onnxruntime, on as many threads as OpenCV has, and the size that its file fixes."""
    import cv2

    try:
        onnxruntime: Any = import_module("onnxruntime")
    except ImportError:
        raise InputError('--backend onnxruntime needs a package: pip install "shapepose-fg[detect]"') from None
    options: Any = onnxruntime.SessionOptions()
    options.intra_op_num_threads = min(cv2.getNumThreads(), os.cpu_count() or 1)
    options.log_severity_level = 4
    try:
        session: Any = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"{file}: not an ONNX network that onnxruntime can read ({_first_line(error)})") from None
    takes = session.get_inputs()[0]
    fixed = list(takes.shape)[2:] if len(takes.shape) == 4 else []
    only_size = (int(fixed[1]), int(fixed[0])) if len(fixed) == 2 and all(type(n) is int for n in fixed) else None

    def forward(blob: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(session.run(None, {takes.name: blob})[0], dtype=np.float32)

    return forward, only_size


def _words(shape: Sequence[int]) -> str:
    """An array's shape in words."""
    return " x ".join(map(str, shape))


def _first_line(error: BaseException) -> str:
    """The first line of a library's message, short."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:160]
