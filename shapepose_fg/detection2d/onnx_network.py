"""A network in an untrusted ONNX file, read within bounds and run by OpenCV or by onnxruntime."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError, optional
from shapepose_fg.detection2d.onnx_file import read_onnx

Backend = Literal["opencv", "onnxruntime"]
"""The library that runs the network."""
Blob = NDArray[np.float32]
"""Inputs and outputs of a network."""
PROVIDERS = {"cpu": "CPU", "cuda": "CUDA", "rocm": "ROCM", "coreml": "CoreML", "directml": "Dml"}
"""Devices, and onnxruntime's names of their execution providers."""
_TRY = """
import sys, cv2, numpy
cv2.dnn.readNetFromONNX(numpy.frombuffer(sys.stdin.buffer.read(), dtype=numpy.uint8))
"""
_LOADS_S = 120
"""Longest time to load a network, s; 400 MB take a few seconds."""


@dataclass(frozen=True)
class OnnxNetwork:
    """A network from pictures to arrays."""

    file: Path
    """Path of the file, for messages."""
    sha256: str
    """SHA-256 of the file."""
    forward: Callable[[Blob], list[Blob]]
    """Function from pictures (B, 3, height, width) to all outputs."""
    size: tuple[int, int] | None = None
    """Width and height that the file fixes; None if any size is possible."""
    inputs: tuple[str, ...] = ()
    """Names of the inputs, if known."""
    outputs: tuple[str, ...] = ()
    """Names of the outputs, if known."""
    at_once: int = 1
    """Maximum number of pictures in a batch."""

    @classmethod
    def open(
        cls, file: str | Path, backend: Backend = "onnxruntime", device: str = "cpu"
    ) -> "OnnxNetwork":
        """The network in `file`; `device` is one of `PROVIDERS`, "cuda:1" its second.

        InputError if the file is missing, no network or too large, if the device is not available,
        or if weights are in other files: their paths are relative to the working directory, and may
        point to any file.
        """
        file = Path(file)
        content = read_onnx(file)
        run_by = _with_opencv if backend == "opencv" else _with_onnxruntime
        return cls(file, hashlib.sha256(content).hexdigest(), *run_by(file, content, device))

    def run(self, pictures: Blob) -> list[Blob]:
        """All outputs for pictures (B, 3, height, width); InputError if the network cannot process
        them.
        """
        try:
            return self.forward(pictures)
        except Exception as error:
            raise InputError(
                f"{self.file}: the network cannot be run on input of {words(pictures.shape)}"
                f" ({_first_line(error)}); give one with pictures as input, 1 x 3 x height x width;"
                " networks such as RTMPose need --boxes"
            ) from None


def _with_opencv(file: Path, content: bytes, device: str) -> tuple[Any, ...]:
    """`forward` of the network run by OpenCV's dnn module, on the CPU, for pictures of any size."""
    _try_elsewhere(file, content)
    try:
        net = cv2.dnn.readNetFromONNX(np.frombuffer(content, dtype=np.uint8))
        empty = net.empty()
    except cv2.error as error:
        raise InputError(
            f"{file}: cannot be read as an ONNX network by OpenCV ({error.err.strip()[:160]})"
        ) from None
    if empty:
        raise InputError(
            f"{file}: cannot be read as an ONNX network; give the ONNX file of a network"
        )

    def forward(pictures: Blob) -> list[Blob]:
        net.setInput(pictures)
        return [np.asarray(net.forward(), dtype=np.float32)]

    return (forward,)


def _try_elsewhere(file: Path, content: bytes) -> None:
    """Raise InputError if OpenCV, run in another process, crashes or hangs with a network, as it
    may with damaged files.
    """
    if not sys.executable:
        return
    command = [
        sys.executable,
        "-P",
        "-c",
        _TRY,
    ]  # -P: nothing is imported from the working directory
    try:
        done = subprocess.run(
            command,
            input=content,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=_LOADS_S,
            check=False,
        )
        what = "OpenCV crashes" if done.returncode < 0 else ""
    except subprocess.TimeoutExpired:
        what = f"OpenCV needs more than {_LOADS_S} s"
    if what:
        raise InputError(
            f"{file}: cannot be read as an ONNX network by OpenCV ({what}); give another copy of it"
        )


def runtime_for(device: str) -> tuple[Any, str, str]:
    """onnxruntime, its provider for `device`, and the number of the device, "" for the first;
    InputError if it is not installed, or has no such provider.
    """
    onnxruntime: Any = optional("onnxruntime", "detect")
    kind, _, number = device.partition(":")
    provider, available = (
        f"{PROVIDERS.get(kind)}ExecutionProvider",
        onnxruntime.get_available_providers(),
    )
    if provider not in available or not (number or "0").isdecimal():
        known = " ".join(
            name for name, each in PROVIDERS.items() if f"{each}ExecutionProvider" in available
        )
        raise InputError(
            f"--device {device}: the installed onnxruntime supports {known}; install the "
            "onnxruntime package for this device"
        )
    return onnxruntime, provider, number


def _with_onnxruntime(file: Path, content: bytes, device: str) -> tuple[Any, ...]:
    """`forward` and the following fields of `OnnxNetwork`, by onnxruntime; on the CPU with as many
    threads as OpenCV has.
    """
    onnxruntime, provider, number = runtime_for(device)
    options: Any = onnxruntime.SessionOptions()
    options.intra_op_num_threads = min(cv2.getNumThreads(), os.cpu_count() or 1)
    options.log_severity_level = 4
    options.add_session_config_entry(
        "session.load_model_format", "ONNX"
    )  # as checked by `read_onnx`
    try:
        providers = [(provider, {"device_id": number} if number else {})]
        session: Any = onnxruntime.InferenceSession(
            content, options, providers=providers, read_config_from_model=0
        )
    except Exception as error:
        raise InputError(
            f"{file}: cannot be read as an ONNX network by onnxruntime ({_first_line(error)})"
        ) from None
    if provider not in session.get_providers():  # it fell back to the CPU
        raise InputError(
            f"--device {device}: this device cannot be used; check its driver, or leave out "
            "--device"
        )
    takes = session.get_inputs()
    if len(takes) != 1:
        raise InputError(
            f"{file}: the network has {len(takes)} inputs; give one that has pictures as its "
            "only input"
        )
    shape = [side if type(side) is int else None for side in takes[0].shape]
    batch, _, height, width = shape if len(shape) == 4 else (1, 3, None, None)

    def forward(pictures: Blob) -> list[Blob]:
        return [
            np.asarray(each, dtype=np.float32)
            for each in session.run(None, {takes[0].name: pictures})
        ]

    size = None if height is None or width is None else (width, height)
    names = [tuple(each.name for each in ends) for ends in (takes, session.get_outputs())]
    # Maximum number of pictures in a batch, which bounds the memory for a crowd.
    return forward, size, *names, 32 if batch is None else 1


def words(shape: Sequence[int]) -> str:
    """Text of an array's shape."""
    return " x ".join(map(str, shape))


def _first_line(error: BaseException) -> str:
    """The first line of a library's message, shortened."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:160]
