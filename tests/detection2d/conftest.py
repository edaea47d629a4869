"""People painted as coloured discs, a network that sees them, and networks as ONNX files."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.detection2d.network import HeatMapNetwork
from shapepose_fg.detection2d.networks import layouts
from shapepose_fg.viz.rendering import look_at

CODES = np.array([code for code in itertools.product((0, 128, 255), repeat=3) if any(code)][:25])
"""The colour of each joint of BODY_25."""


def paint(camera: Camera, joints: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """A black picture with a disc for every joint (P, 25, 3) of BODY_25, where the lens puts it."""
    picture = np.zeros((camera.image_size[1], camera.image_size[0], 3), dtype=np.uint8)
    for person in joints:
        xy = camera.distort(camera.project(person)[0])
        for (x, y), code in zip(np.round(xy * 16).astype(int).tolist(), CODES.tolist(), strict=True):
            cv2.circle(picture, (x, y), 7 * 16, code, -1, cv2.LINE_8, 4)
    return picture if size is None else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def see_discs(blob: np.ndarray) -> np.ndarray:
    """What a network for such pictures gives: of each cell and joint the share of pixels with its colour.

    Neighbours are mixed in, so that peaks are as smooth as a network's. Fields of affinity are empty.
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
    return HeatMapNetwork(layouts()["openpose-body25"], "0" * 64, see_discs)


@pytest.fixture(scope="session")
def rolled_rig() -> Rig:
    """Three cameras around the origin, the second rolled by 30 degrees, the third with a lens that bends."""
    cameras = []
    for name, angle, roll, distortion in (("a", 0, 0, 0), ("b", 100, 30, 0), ("c", 200, -15, -0.12)):
        eye = 4.0 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.4])
        wTc = look_at(eye, np.array([0, 0, 0.9]), np.array([0.0, 0, 1]))
        c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
        wTc[:3, :3] = wTc[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
        cameras.append(Camera(name, K, wTc, (640, 480), np.array([distortion, 0.0, 0, 0, 0])))
    return Rig(tuple(cameras), "z")


def onnx_file(path: Path, weights: np.ndarray, fixed: tuple[int, int] | None = None) -> Path:
    """An ONNX file of one convolution with a stride of its kernel's size: `weights` (out, 3, k, k).

    Written by hand, after the format's own description (onnx.proto), so that no test needs the package onnx.
    """
    size = weights.shape[2]
    tensor = b"".join(varint(1, n) for n in weights.shape) + varint(2, 1) + blob(8, b"w")
    tensor += blob(9, weights.astype("<f4").tobytes())
    attributes = _ints(b"kernel_shape", [size] * 2) + _ints(b"strides", [size] * 2)
    node = blob(1, b"x") + blob(1, b"w") + blob(2, b"y") + blob(4, b"Conv") + attributes
    height, width = fixed or (b"h", b"w")
    graph = blob(1, node) + blob(2, b"g") + blob(5, tensor) + blob(11, _value(b"x", [1, 3, height, width]))
    graph += blob(12, _value(b"y", [1, weights.shape[0], b"p", b"q"]))
    model = varint(1, 7) + blob(7, graph) + blob(8, blob(1, b"") + varint(2, 13))
    path.write_bytes(model)
    return path


def _varint(n: int) -> bytes:
    out = b""
    while n > 127:
        out, n = out + bytes([n & 127 | 128]), n >> 7
    return out + bytes([n])


def varint(field: int, n: int) -> bytes:
    return _varint(field << 3) + _varint(n)


def blob(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _ints(name: bytes, values: list[int]) -> bytes:
    return blob(5, blob(1, name) + b"".join(varint(8, n) for n in values) + varint(20, 7))


def _value(name: bytes, shape: list[int | bytes]) -> bytes:
    sides = b"".join(blob(1, blob(2, side) if isinstance(side, bytes) else varint(1, side)) for side in shape)
    return blob(1, name) + blob(2, blob(1, varint(1, 1) + blob(2, sides)))
