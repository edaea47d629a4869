"""OpenPose-like networks: heat maps and part affinity fields of a whole picture."""

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.decoding import PictureCandidates, decode
from shapepose_fg.detection2d.onnx_network import Backend, Blob, OnnxNetwork, words
from shapepose_fg.detection2d.upright import UprightView
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS, TextSkeleton
from shapepose_fg.io.write_detections import association_lines

_STRIDE, _MULTIPLE = 8, 16
"""Pixels of the input per cell of the output, along each axis; and number by which both sides of
the input are divisible."""
_LONG_SIDE = 656


@dataclass(frozen=True)
class NetworkLayout:
    """Normalisation of a network's input, and order of the joints and limbs in its output
    (`decode`).
    """

    name: str
    """Name of the layout."""
    text: TextSkeleton
    """The joints and limbs, in order."""
    scale: float
    """Scale of the input, which is `scale` * colour + `offset`, with colours (blue, green, red)
    from 0 to 255."""
    offset: float
    """Offset of the input; see `scale`."""
    sha256: str = ""
    """Checksum of a known network with this layout; empty if unknown."""

    @property
    def channels(self) -> int:
        """Number of channels of the output."""
        return len(self.text.joints) + 1 + 2 * len(self.text.limbs)


@lru_cache(maxsize=1)
def layouts() -> dict[str, NetworkLayout]:
    """All layouts by name."""
    table = json.loads(
        (files("shapepose_fg.detection2d") / "data" / "layouts.json").read_text(encoding="utf-8")
    )
    return {
        name: NetworkLayout(name, text=TEXT_SKELETONS[entry.pop("text")], **entry)
        for name, entry in table.items()
    }


@dataclass(frozen=True)
class HeatMapNetwork:
    """A network that computes heat maps and part affinity fields of a picture; candidates are
    grouped to people later, in 3D.
    """

    network: OnnxNetwork
    """The network."""
    layout: NetworkLayout
    """The layout of the network's output."""
    long_side: int = _LONG_SIDE
    """Longer side of the network's input, pixels: a larger input detects smaller people, and takes
    longer."""
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
        """Load the network in the ONNX `file`. `layout` names one of `layouts()`; without it the
        file must identify it.

        OpenCV runs it on the CPU, at any size, unless `backend` is another. InputError if the file
        is missing, is no ONNX network, or does not fit the layout.
        """
        every = layouts()
        if layout not in (None, *every):
            raise InputError(f"--layout {layout}: must be one of {' '.join(every)}")
        network = OnnxNetwork.open(
            file, backend or ("opencv" if device == "cpu" else "onnxruntime"), device
        )
        # Width and height of the empty picture that a new network is tried on, pixels.
        width, height = network.size or (64, 64)
        shape = network.run(np.zeros((1, 3, height, width), dtype=np.float32))[0].shape
        fitting = [each for each in every.values() if layout in (None, each.name)]
        cells = (height // _STRIDE, width // _STRIDE)
        fitting = [each for each in fitting if shape == (1, each.channels, *cells)]
        fitting = [each for each in fitting if each.sha256 == network.sha256] or fitting
        if len(fitting) != 1:
            which = (
                "no known layout fits; give another network, or --boxes with networks such as "
                "RTMPose"
            )
            if len(fitting) > 1:
                which = (
                    "several layouts fit; give --layout "
                    f"{' or '.join(each.name for each in fitting)}"
                )
            raise InputError(
                f"{file}: its output for pictures of {width} x {height} pixels is "
                f"{words(shape)}: {which}"
            )
        return cls(network, fitting[0], long_side or _LONG_SIDE)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that affect its detections."""
        network = {"sha256": self.network.sha256, "layout": self.layout.name}
        return {"network": network, "detection": {"long_side": self.long_side}}

    def head(self, frames: int) -> str:
        """The beginning of 4D Association's text."""
        return f"{self.layout.text.number} {frames}\n"

    def text(self, number: int, found: Any, size: tuple[int, int]) -> str:
        """A frame of the text: `PictureCandidates` in a picture of the calibrated `size`, None if
        there was no picture.
        """
        if found is None:
            return "0\n" * len(self.layout.text.joints)
        fractions = found.xy / (np.array(size) - 1.0)
        lines = association_lines(
            self.layout.text, found.joint, fractions, found.score, found.pairs, found.affinity
        )
        return "".join(f"{line}\n" for line in lines)

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """The input for pictures with the given region and roll."""
        return UprightView.of(region, roll_deg, self.long_side, _MULTIPLE, self.network.size)

    def run(self, picture: NDArray[np.uint8]) -> Blob:
        """The output (C, H / 8, W / 8) of a `picture` (H, W, 3), blue green red; its sides are
        multiples of 16.
        """
        blob = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32)
        if (self.layout.scale, self.layout.offset) != (1.0, 0.0):
            blob = blob * np.float32(self.layout.scale) + np.float32(self.layout.offset)
        return self.network.run(blob)[0][0]

    def detect(self, picture: NDArray[np.uint8]) -> PictureCandidates:
        """Candidates in a `picture` (H, W, 3) of the view's size, in its pixels."""
        found = decode(self.run(picture), self.layout.text)
        return replace(found, xy=(found.xy + 0.5) * _STRIDE - 0.5)
