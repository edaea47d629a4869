"""People painted as coloured discs, a network that sees them, and networks as ONNX files."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.rendering import look_at
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork, layouts
from shapepose_fg.detection2d.onnx_network import OnnxNetwork

Sides = Sequence[int | str]
"""The shape of an input or output; names are sides of any length."""

CODES = np.array([code for code in itertools.product((0, 128, 255), repeat=3) if any(code)][:25])
"""The colour of each joint of BODY_25."""


def paint(camera: Camera, joints: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """A black picture with a disc for every joint (P, 25, 3) of BODY_25, where the lens puts it."""
    picture = np.zeros((camera.image_size[1], camera.image_size[0], 3), dtype=np.uint8)
    for person in joints:
        xy = camera.distort(camera.project(person)[0])
        for (x, y), code in zip(
            np.round(xy * 16).astype(int).tolist(), CODES.tolist(), strict=True
        ):
            cv2.circle(picture, (x, y), 7 * 16, code, -1, cv2.LINE_8, 4)
    return (
        picture
        if size is None
        else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    )


def see_discs(blob: np.ndarray) -> np.ndarray:
    """What a network for such pictures gives: of each cell and joint the share of pixels with its
    colour.

    Neighbours are mixed in, so that peaks are as smooth as a network's. Fields of affinity are
    empty.
    """
    picture = (blob[0] + 0.5) * 256  # the layout's own scaling undone
    level = np.rint(picture / 127.5)
    clear = (np.abs(picture - 127.5 * level) < 45).all(axis=0)
    code = np.where(clear, np.tensordot([9, 3, 1], level, axes=1), 0).astype(int)
    height, width = code.shape[0] // 8, code.shape[1] // 8
    rows, columns = np.indices(code.shape)
    cell = (rows // 8 * width + columns // 8) * 27 + code
    share = np.bincount(cell.ravel(), minlength=height * width * 27).reshape(height, width, 27) / 64
    cells = cv2.GaussianBlur(np.ascontiguousarray(share[..., 1:26], dtype=np.float32), (0, 0), 1.0)
    output = np.zeros((1, 78, height, width), dtype=np.float32)
    output[0, :25] = (2.0 * cells).transpose(2, 0, 1)
    return output


@pytest.fixture
def painted_network() -> HeatMapNetwork:
    network = OnnxNetwork(Path("painted.onnx"), "0" * 64, lambda blob: [see_discs(blob)])
    return HeatMapNetwork(network, layouts()["openpose-body25"])


@pytest.fixture(scope="session")
def rolled_rig() -> Rig:
    """Three cameras around the origin, the second rolled by 30 degrees, the third with a lens that
    bends.
    """
    cameras = []
    for name, angle, roll, distortion in (
        ("a", 0, 0, 0),
        ("b", 100, 30, 0),
        ("c", 200, -15, -0.12),
    ):
        eye = 4.0 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.4])
        wTc = look_at(eye, np.array([0, 0, 0.9]), np.array([0.0, 0, 1]))
        c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
        wTc[:3, :3] = wTc[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
        cameras.append(Camera(name, K, wTc, (640, 480), np.array([distortion, 0.0, 0, 0, 0])))
    return Rig(tuple(cameras), "z")


def onnx_file(path: Path, weights: np.ndarray, fixed: tuple[int, int] | None = None) -> Path:
    """An ONNX file of one convolution with a stride of its kernel's size: `weights` (out, 3, k,
    k).
    """
    side = weights.shape[2]
    nodes = [node("Conv", "x w", "y", kernel_shape=[side] * 2, strides=[side] * 2)]
    height, width = fixed or ("h", "w")
    return onnx_model(
        path, nodes, {"w": weights}, (1, 3, height, width), {"y": (1, len(weights), "p", "q")}
    )


def onnx_model(
    path: Path, nodes: list[bytes], weights: dict[str, np.ndarray], takes: Sides, gives: dict
) -> Path:
    """An ONNX file that takes x of the shape `takes` and gives arrays of known names and shapes.

    Written by hand, after the format's own description (onnx.proto), so that no test needs the
    package onnx.
    """
    graph = b"".join(blob(1, each) for each in nodes) + blob(2, b"g")
    for name, array in weights.items():
        whole = array.dtype.kind == "i"
        tensor = (
            b"".join(varint(1, n) for n in array.shape)
            + varint(2, 7 if whole else 1)
            + blob(8, name.encode())
        )
        graph += blob(5, tensor + blob(9, array.astype("<i8" if whole else "<f4").tobytes()))
    graph += blob(11, _value("x", takes))
    for name, shape in gives.items():
        graph += blob(12, _value(name, shape, whole=name == "labels"))
    path.write_bytes(varint(1, 7) + blob(7, graph) + blob(8, blob(1, b"") + varint(2, 13)))
    return path


def node(operator: str, takes: str, gives: str, **attributes: int | list[int]) -> bytes:
    """A step of a network: names of what it takes and gives, separated by blanks, and its
    attributes.
    """
    content = b"".join(blob(1, name.encode()) for name in takes.split())
    content += b"".join(blob(2, name.encode()) for name in gives.split()) + blob(
        4, operator.encode()
    )
    for name, value in attributes.items():
        whole = varint(3, value) + varint(20, 2) if isinstance(value, int) else b""
        several = (
            b"".join(varint(8, n) for n in value) + varint(20, 7)
            if isinstance(value, list)
            else b""
        )
        content += blob(5, blob(1, name.encode()) + whole + several)
    return content


def _varint(n: int) -> bytes:
    out = b""
    while n > 127:
        out, n = out + bytes([n & 127 | 128]), n >> 7
    return out + bytes([n])


def varint(field: int, n: int) -> bytes:
    return _varint(field << 3) + _varint(n)


def blob(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _value(name: str, shape: Sides, *, whole: bool = False) -> bytes:
    sides = b"".join(
        blob(1, blob(2, side.encode()) if isinstance(side, str) else varint(1, side))
        for side in shape
    )
    return blob(1, name.encode()) + blob(2, blob(1, varint(1, 7 if whole else 1) + blob(2, sides)))


def rtmpose_file(
    path: Path, joints: int, size: tuple[int, int], seed: int, batch: int | str = "batch"
) -> Path:
    """A network with RTMPose's input and outputs, of random weights; its curves depend on all of
    the crop.
    """
    rng, (width, height) = np.random.default_rng(seed), size
    cells = width * height // 256
    weights = {
        "w": rng.normal(0, 0.03, (joints, 3, 16, 16)),
        "flat": np.array([0, joints, -1]),
        "along_x": rng.normal(0, 0.02, (cells, 2 * width)),
        "along_y": rng.normal(0, 0.02, (cells, 2 * height)),
    }
    nodes = [
        node("Conv", "x w", "cells", kernel_shape=[16, 16], strides=[16, 16]),
        node("Reshape", "cells flat", "seen"),
        node("MatMul", "seen along_x", "simcc_x"),
        node("MatMul", "seen along_y", "simcc_y"),
    ]
    gives = {"simcc_x": (batch, joints, 2 * width), "simcc_y": (batch, joints, 2 * height)}
    return onnx_model(path, nodes, weights, (batch, 3, height, width), gives)


def yolox_file(
    path: Path, size: tuple[int, int], seed: int, classes: int = 1, suppressed: bool = False
) -> Path:
    """A network with YOLOX's input and outputs, `suppressed` as mmdeploy exports it: boxes that
    overlap a lot.
    """
    rng, (width, height) = np.random.default_rng(seed), size
    steps = (32,) if suppressed else (8, 16, 32)
    nodes, weights, grids = [], {"flat": np.array([1, 5 + classes - suppressed, -1])}, []
    for step in steps:
        how = {"kernel_shape": [step, step], "strides": [step, step]}
        for part, channels, bias in (
            ("place", 4, [0.5, 0.5, 2.0, 2.0]),
            ("sure", 1 + classes - suppressed, [-0.6 if suppressed else 1.1]),
        ):
            weights[f"{part}{step}"] = rng.normal(0, 1 / (200 * step), (channels, 3, step, step))
            weights[f"{part}{step}"] -= weights[f"{part}{step}"].mean(
                axis=(1, 2, 3), keepdims=True
            )  # grey tells nothing
            weights[f"{part}{step}b"] = np.resize(bias, channels)
            nodes.append(node("Conv", f"x {part}{step} {part}{step}b", f"{part}{step}o", **how))
        nodes.append(node("Sigmoid", f"sure{step}o", f"sure{step}s"))
        nodes.append(node("Concat", f"place{step}o sure{step}s", f"both{step}", axis=1))
        nodes.append(node("Reshape", f"both{step} flat", f"grid{step}"))
        grids.append(f"grid{step}")
    count = sum((width // step) * (height // step) for step in steps)
    last = "moved" if suppressed else "dets"
    nodes += [
        node("Concat", " ".join(grids), "every", axis=2),
        node("Transpose", "every", last, perm=[0, 2, 1]),
    ]
    gives: dict[str, Sides] = {"dets": (1, count, 4 + 1 + classes - suppressed)}
    if suppressed:
        low = rng.uniform(0, 0.7, (count, 2)) * size
        weights["base"] = np.hstack(
            [low, low + rng.uniform(0.1, 0.3, (count, 2)) * size, np.zeros((count, 1))]
        )[None]
        weights["given"] = np.arange(count)[None] % classes
        nodes += [node("Add", "moved base", "dets"), node("Identity", "given", "labels")]
        gives["labels"] = (1, count)
    return onnx_model(path, nodes, weights, (1, 3, height, width), gives)
