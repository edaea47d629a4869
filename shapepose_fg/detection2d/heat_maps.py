"""Networks of OpenPose's kind: a picture's heat maps and part affinity fields, as candidates with affinities.

Cao et al., "OpenPose: Realtime Multi-Person 2D Pose Estimation using Part Affinity Fields", PAMI 2021, section 3.
"""

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from shapepose_fg.core.arrays import Array, Index, Mask, Real
from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.onnx_network import Backend, Blob, OnnxNetwork, words
from shapepose_fg.detection2d.upright import UprightView
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS, TextSkeleton
from shapepose_fg.io.write_detections import association_lines

_MIN_SCORE = 0.1
"""Heights of peaks below this are noise."""
_LINE_SAMPLES = 10
"""Places along a limb at which the affinity field is read, as in OpenPose."""
_MIN_ALONG = 0.05
"""A place supports a limb where the field has at least this component along it, as in OpenPose."""
_MIN_SUPPORTED = 0.7
"""The share of places that must support a limb for it to have an affinity."""


@dataclass(frozen=True)
class Candidates:
    """Joint candidates of one picture, sorted by joint, and affinities between them."""

    joint: Index
    """(D,) joint of each candidate, in the network's order."""
    xy: Array
    """(D, 2) position."""
    score: Array
    """(D,) height of the peak, 0 to 1."""
    pairs: Index
    """(E, 2) candidates that a limb joins, the limb's first joint first."""
    limb: Index
    """(E,) the limb that joins each pair."""
    affinity: Array
    """(E,) mean of the field's component along the limb, 0 to 1; pairs without support are not listed."""

    def __len__(self) -> int:
        return len(self.joint)

    def moved(self, xy: Array, inside: Mask) -> "Candidates":
        """The same at other positions; those that are not `inside` (D,) are left out."""
        place = np.cumsum(inside) - 1
        both = inside[self.pairs].all(axis=1)
        joint, score, pairs = self.joint[inside], self.score[inside], place[self.pairs[both]]
        return Candidates(joint, xy[inside], score, pairs, self.limb[both], self.affinity[both])


def decode(output: NDArray[np.float32], skeleton: TextSkeleton) -> Candidates:
    """Candidates of one picture from the network's `output` (C, H, W).

    That is a map for each of the `skeleton`'s J joints, one of the background, and two (x, y) for each limb.
    Positions are in cells; (0, 0) is the centre of the first. What is not finite in the output is taken for 0.
    """
    output = np.nan_to_num(output, nan=0.0, posinf=0.0, neginf=0.0)
    joint, xy, score = peaks(output[: len(skeleton.joints)])
    of = [np.flatnonzero(joint == each) for each in range(len(skeleton.joints))]
    joined = [
        np.stack(np.meshgrid(of[a], of[b], indexing="ij"), axis=-1).reshape(-1, 2) for a, b in skeleton.limbs
    ]
    pairs, limb = np.concatenate(joined), np.repeat(np.arange(len(joined)), [len(each) for each in joined])
    affinity = line_integrals(output[len(skeleton.joints) + 1 :], xy[pairs[:, 0]], xy[pairs[:, 1]], limb)
    there = affinity > 0
    return Candidates(joint, xy, score, pairs[there], limb[there], affinity[there])


def peaks(heat: NDArray[np.float32], min_score: float = _MIN_SCORE) -> tuple[Index, Array, Array]:
    """Joint (D,), position (D, 2) in cells, and height (D,) of the local maxima of heat maps (J, H, W).

    A maximum is no lower than its eight neighbours. Between cells its place and height are those of a Gaussian
    through it and its neighbours, along each axis.
    """
    padded = np.pad(heat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    rows, columns = heat.shape[1:]
    is_peak = heat >= min_score
    for down, right in np.ndindex(3, 3):
        other = padded[:, down : down + rows, right : right + columns]
        # Of a plateau of equal cells only the first is kept.
        is_peak &= heat > other if (down, right) < (1, 1) else heat >= other
    joint, row, column = np.nonzero(is_peak)
    xy, height = between_cells(padded, joint, row + 1, column + 1)
    return joint, xy - 1, np.minimum(height, 1.0)


def between_cells(maps: Real, which: Index, row: Index, column: Index) -> tuple[Array, Array]:
    """Places (N, 2) and heights (N,) of maxima of `maps` (M, H, W), none of which lies at an edge."""
    centre = maps[which, row, column].astype(np.float64)
    x, rise_x = _vertex(maps[which, row, column - 1], centre, maps[which, row, column + 1])
    y, rise_y = _vertex(maps[which, row - 1, column], centre, maps[which, row + 1, column])
    return np.column_stack([column + x, row + y]), centre * np.exp(rise_x + rise_y)


def _vertex(before: Real, centre: Array, after: Real) -> tuple[Array, Array]:
    """Where a Gaussian through three neighbours is highest, -0.5 to 0.5 cells, and the logarithm of its rise.

    0 and 0 at the edge of the map.
    """
    floor = 1e-3  # logarithms of what is near 0 or below would bend the curve
    low, mid, high = (np.log(np.maximum(each.astype(np.float64), floor)) for each in (before, centre, after))
    bend = low - 2 * mid + high
    safe = np.where(bend < -1e-9, bend, -np.inf)
    shift = np.clip(0.5 * (low - high) / safe, -0.5, 0.5)
    shift = np.where(np.isinf(before) | np.isinf(after), 0.0, shift)
    return shift, -0.25 * (low - high) * shift


def line_integrals(fields: NDArray[np.float32], start: Array, end: Array, limb: Index) -> Array:
    """(E,) the mean component of the affinity `fields` (2 L, H, W) along the lines from `start` to `end` (E, 2).

    `limb` (E,) says whose field each line is read from. 0 where too few places along the line support it.
    """
    height, width = fields.shape[1:]
    along = end - start
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-9)[:, None]
    part = np.linspace(0.0, 1.0, _LINE_SAMPLES)
    x = np.clip(start[:, :1] + along[:, :1] * part, 0, width - 1)
    y = np.clip(start[:, 1:] + along[:, 1:] * part, 0, height - 1)
    component = np.zeros(x.shape)
    for axis in range(2):
        places = np.stack([np.broadcast_to(2.0 * limb[:, None] + axis, x.shape), y, x])
        component += map_coordinates(fields, places, np.float64, order=1) * direction[:, axis, None]
    supported = (component >= _MIN_ALONG).mean(axis=1) >= _MIN_SUPPORTED
    return np.where(supported & (length > 0), np.clip(component.mean(axis=1), 0.0, 1.0), 0.0)


_STRIDE, _MULTIPLE = 8, 16
"""Pixels of the input per cell of the output, along each axis; what both sides of the input are multiples of."""
_TRIAL = (64, 64)
"""(width, height) of the empty picture that a new network is tried on."""
_LONG_SIDE = 656


@dataclass(frozen=True)
class NetworkLayout:
    """What a network takes, and which joints and limbs its output has, one after the other (`decode`)."""

    name: str
    """What it is called."""
    text: TextSkeleton
    """The joints and limbs, in order."""
    scale: float
    """The input is `scale` * colour + `offset`, with colours (blue, green, red) from 0 to 255."""
    offset: float
    """See `scale`."""
    sha256: str = ""
    """Checksum of a known network that has it."""

    @property
    def channels(self) -> int:
        """How many channels the output has."""
        return len(self.text.joints) + 1 + 2 * len(self.text.limbs)


@lru_cache(maxsize=1)
def layouts() -> dict[str, NetworkLayout]:
    """All layouts by name."""
    table = json.loads((files("shapepose_fg.detection2d") / "data" / "layouts.json").read_text(encoding="utf-8"))
    return {
        name: NetworkLayout(name, text=TEXT_SKELETONS[entry.pop("text")], **entry) for name, entry in table.items()
    }


@dataclass(frozen=True)
class HeatMapNetwork:
    """A network that makes heat maps and part affinity fields of a picture; they are made people later, in 3D."""

    network: OnnxNetwork
    """What is run."""
    layout: NetworkLayout
    """How its output is to be read."""
    long_side: int = _LONG_SIDE
    """The longer side of its input, pixels: more finds smaller people, and takes longer."""
    suffix, tail = ".txt", ""

    @classmethod
    def load(
        cls,
        file: str | Path,
        layout: str | None = None,
        backend: Backend | None = None,
        device: str = "cpu",
        long_side: int | None = None,
    ) -> "HeatMapNetwork":
        """The network in the ONNX `file`. `layout` names one of `layouts()`; without it the file must tell.

        On the CPU OpenCV runs it, at any size, unless `backend` says otherwise. InputError where the file is
        missing, is no ONNX network, or does not fit the layout.
        """
        every = layouts()
        if layout not in (None, *every):
            raise InputError(f"--layout {layout}: there is no such layout; give one of {' '.join(every)}")
        network = OnnxNetwork.open(file, backend or ("opencv" if device == "cpu" else "onnxruntime"), device)
        width, height = network.size or _TRIAL
        shape = network.run(np.zeros((1, 3, height, width), dtype=np.float32))[0].shape
        fitting = [each for each in every.values() if layout in (None, each.name)]
        cells = (height // _STRIDE, width // _STRIDE)
        fitting = [each for each in fitting if shape == (1, each.channels, *cells)]
        fitting = [each for each in fitting if each.sha256 == network.sha256] or fitting
        if len(fitting) != 1:
            which = "no layout known does; give another network, or --boxes with RTMPose and its like"
            if len(fitting) > 1:
                which = f"several layouts do; give --layout {' or '.join(each.name for each in fitting)}"
            raise InputError(
                f"{file}: it makes {words(shape)} numbers of {width} x {height} pixels, which {which}"
            )
        return cls(network, fitting[0], long_side or _LONG_SIDE)

    @property
    def settings(self) -> dict[str, Any]:
        """What its detections depend on."""
        network = {"sha256": self.network.sha256, "layout": self.layout.name}
        return {"network": network, "detection": {"long_side": self.long_side}}

    def head(self, frames: int) -> str:
        """The beginning of 4D Association's text."""
        return f"{self.layout.text.number} {frames}\n"

    def text(self, number: int, found: Any, size: tuple[int, int]) -> str:
        """A frame in it: `Candidates` in a picture of the calibrated `size`, None where there was no picture."""
        if found is None:
            return "0\n" * len(self.layout.text.joints)
        fractions = found.xy / (np.array(size) - 1.0)
        lines = association_lines(
            self.layout.text, found.joint, fractions, found.score, found.pairs, found.affinity
        )
        return "".join(f"{line}\n" for line in lines)

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """What it is shown of pictures with such a region and roll."""
        return UprightView.of(region, roll_deg, self.long_side, _MULTIPLE, self.network.size)

    def run(self, picture: NDArray[np.uint8]) -> Blob:
        """The output (C, H / 8, W / 8) of a `picture` (H, W, 3), blue green red; its sides are multiples of 16."""
        blob = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32)
        if (self.layout.scale, self.layout.offset) != (1.0, 0.0):
            blob = blob * np.float32(self.layout.scale) + np.float32(self.layout.offset)
        return self.network.run(blob)[0][0]

    def detect(self, picture: NDArray[np.uint8]) -> Candidates:
        """Candidates in a `picture` (H, W, 3) of the view's size, in its pixels."""
        found = decode(self.run(picture), self.layout.text)
        return replace(found, xy=(found.xy + 0.5) * _STRIDE - 0.5)
