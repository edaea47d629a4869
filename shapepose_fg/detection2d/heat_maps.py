"""Networks of OpenPose's kind: heat maps and part affinity fields of a whole picture."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.decoding import Candidates, decode
from shapepose_fg.detection2d.networks import MULTIPLE, STRIDE, NetworkLayout, find_layout
from shapepose_fg.detection2d.onnx_network import Backend, Blob, OnnxNetwork, words
from shapepose_fg.detection2d.upright import UprightView
from shapepose_fg.io.write_detections import association_lines

_TRIAL = (64, 64)
"""(width, height) of the empty picture that a new network is tried on."""
_LONG_SIDE = 656


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
        network = OnnxNetwork.open(file, backend or ("opencv" if device == "cpu" else "onnxruntime"), device)
        width, height = network.size or _TRIAL
        shape = network.run(np.zeros((1, 3, height, width), dtype=np.float32))[0].shape
        found = find_layout(layout, network.sha256, shape[1] if len(shape) == 4 else None, file)
        wanted = (1, found.channels, height // STRIDE, width // STRIDE)
        if shape != wanted:
            raise InputError(
                f"{file}: of a picture of {width} x {height} the network makes {words(shape)} numbers, layout"
                f" {found.name} expects {words(wanted)}; give the layout of this network"
            )
        return cls(network, found, long_side or _LONG_SIDE)

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
        found = found or Candidates.none()
        fractions = found.xy / (np.array(size) - 1.0)
        lines = association_lines(
            self.layout.text, found.joint, fractions, found.score, found.pairs, found.affinity
        )
        return "".join(f"{line}\n" for line in lines)

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """What it is shown of pictures with such a region and roll."""
        return UprightView.of(region, roll_deg, self.long_side, MULTIPLE, self.network.size)

    def run(self, picture: NDArray[np.uint8]) -> Blob:
        """The output (C, H / 8, W / 8) of a `picture` (H, W, 3), blue green red; its sides are multiples of 16."""
        blob = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32)
        if (self.layout.scale, self.layout.offset) != (1.0, 0.0):
            blob = blob * np.float32(self.layout.scale) + np.float32(self.layout.offset)
        return self.network.run(blob)[0][0]

    def detect(self, picture: NDArray[np.uint8]) -> Candidates:
        """Candidates in a `picture` (H, W, 3) of the view's size, in its pixels."""
        found = decode(self.run(picture), self.layout)
        return replace(found, xy=(found.xy + 0.5) * STRIDE - 0.5)
