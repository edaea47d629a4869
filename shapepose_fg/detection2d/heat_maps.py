"""Networks of OpenPose's kind: heat maps and part affinity fields of a whole picture."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.decoding import decode
from shapepose_fg.detection2d.found import AssociationFile, Candidates
from shapepose_fg.detection2d.networks import NetworkLayout, find_layout
from shapepose_fg.detection2d.onnx_network import Backend, Blob, OnnxNetwork, words
from shapepose_fg.detection2d.upright import UprightView
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS

_TRIAL = 64
"""Side of the empty picture that a new network is tried on, pixels."""
LONG_SIDE = 656
"""The longer side of what it is shown, pixels."""


@dataclass(frozen=True)
class HeatMapNetwork:
    """A network that makes heat maps and part affinity fields of a picture."""

    layout: NetworkLayout
    """How its output is to be read."""
    sha256: str
    """Checksum of its file."""
    forward: Callable[[Blob], Blob]
    """The output (1, C, H, W) for a picture (1, 3, height, width)."""
    only_size: tuple[int, int] | None = None
    """(width, height) of the pictures that it takes; None where it takes any."""
    long_side: int = LONG_SIDE
    """The longer side of its input, pixels: more finds smaller people, and takes longer."""

    @classmethod
    def load(
        cls,
        file: str | Path,
        layout: str | None = None,
        backend: Backend = "opencv",
        device: str = "cpu",
        long_side: int = LONG_SIDE,
    ) -> "HeatMapNetwork":
        """The network in the ONNX `file`. `layout` names one of `layouts()`; without it the file must tell.

        InputError where the file is missing, is no ONNX network, or does not fit the layout.
        """
        network = OnnxNetwork.open(file, backend, device)
        width, height = network.size or (_TRIAL, _TRIAL)
        shape = network.run(np.zeros((1, 3, height, width), dtype=np.float32))[0].shape
        channels = shape[1] if len(shape) == 4 else None
        found = find_layout(layout, network.sha256, channels, file)
        wanted = (1, found.channels, height // found.stride, width // found.stride)
        if shape != wanted:
            raise InputError(
                f"{file}: of a picture of {width} x {height} the network makes {words(shape)} numbers, layout"
                f" {found.name} expects {words(wanted)}; give the layout of this network"
            )
        return cls(found, network.sha256, lambda blob: network.run(blob)[0], network.size, long_side)

    @property
    def settings(self) -> dict[str, Any]:
        """What its detections depend on."""
        return {
            "network": {"sha256": self.sha256, "layout": self.layout.name},
            "detection": {"long_side": self.long_side},
        }

    @property
    def written(self) -> AssociationFile:
        """How its detections are written."""
        return AssociationFile(TEXT_SKELETONS[self.layout.skeleton])

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """What it is shown of pictures with such a region and roll."""
        return UprightView.of(region, roll_deg, self.long_side, self.layout.multiple, self.only_size)

    def run(self, picture: NDArray[np.uint8]) -> Blob:
        """The output (C, H / stride, W / stride) of a `picture` (H, W, 3): blue, green, red.

        Its sides are multiples of `layout.multiple`.
        """
        blob = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32)
        if (self.layout.scale, self.layout.offset) != (1.0, 0.0):
            blob = blob * np.float32(self.layout.scale) + np.float32(self.layout.offset)
        return self.forward(blob)[0]

    def detect(self, picture: NDArray[np.uint8]) -> Candidates:
        """Candidates in a `picture` (H, W, 3) of the view's size, in its pixels."""
        found = decode(self.run(picture), self.layout)
        return replace(found, xy=(found.xy + 0.5) * self.layout.stride - 0.5)
