"""YOLOX: boxes around the people in a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from shapepose_fg.core.arrays import Real
from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.onnx_network import Blob, OnnxNetwork, words

Side = Annotated[int, Field(ge=16, le=4096)]
"""Side of a network's input, pixels."""
_Share = Annotated[FiniteFloat, Field(gt=0, lt=1)]

_STRIDES = (8, 16, 32)
"""Pixels per cell of the grids on which boxes are proposed."""
_PERSON = 0
"""Index of people among COCO's classes."""
_MOST_PEOPLE = 200
"""Maximum number of people in a picture; the boxes with the highest scores are kept."""
_LEAST, _LEAST_SUPPRESSED = 0.7, 0.3
"""Minimum scores of a box, as in rtmlib; the second if the network contains the non-maximum
suppression."""


class BoxForm(BaseModel, extra="forbid"):
    """Description of a box network: the table `boxes` of a network's TOML file."""

    network: str = ""
    """ONNX file of the box network."""
    size: tuple[Side, Side] = (640, 640)
    """Width and height of the network's input, pixels, if the ONNX file does not fix them."""
    min_score: _Share | None = None
    """Minimum score of a box; None for rtmlib's default."""
    max_overlap: _Share = 0.45
    """Intersection over union of two boxes above which the one with the lower score is removed."""


@dataclass(frozen=True)
class BoxNetwork:
    """YOLOX, with non-maximum suppression inside or outside of the network."""

    network: OnnxNetwork
    """The network that proposes boxes."""
    form: BoxForm
    """Description of the network."""

    def find(self, picture: NDArray[np.uint8]) -> Real:
        """(P, 4) left, top, right, bottom in pixels of a `picture` (H, W, 3), the highest score
        first.
        """
        size = np.array(self.form.size)
        scale = float((size / picture.shape[1::-1]).min())
        width, height = (max(int(side * scale), 1) for side in picture.shape[1::-1])
        # Grey value of the padding if a picture has another aspect ratio than the
        # network's input.
        shown = np.full((size[1], size[0], 3), 114, dtype=np.uint8)
        shown[:height, :width] = cv2.resize(
            picture, (width, height), interpolation=cv2.INTER_LINEAR
        )
        outputs = self.network.run(
            np.ascontiguousarray(shown.transpose(2, 0, 1)[None], dtype=np.float32)
        )
        boxes, score, least = self._proposed(outputs)
        # Written so that NaN counts as below the minimum.
        # Largest coordinate of a box, pixels of the input.
        sound = (np.abs(boxes) < 1e6).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        index = np.flatnonzero((score > (self.form.min_score or least)) & sound)
        index = index[np.argsort(-score[index], kind="stable")]
        boxes, score = boxes[index] / scale, score[index]
        if least == _LEAST:
            # Widths and heights include the last pixel.
            rectangles = np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2] + 1])
            kept = cv2.dnn.NMSBoxes(rectangles.tolist(), score.tolist(), 0.0, self.form.max_overlap)
            boxes = boxes[np.asarray(kept, dtype=np.intp)].astype(np.float64)
        return boxes[:_MOST_PEOPLE]

    def _proposed(self, outputs: Sequence[Blob]) -> tuple[Blob, Blob, float]:
        """(N, 4) boxes in pixels of the input, (N,) their scores for people, and the minimum
        score.
        """
        # Column and row of all cells of the grids, grid by grid.
        grids = [
            np.indices((self.form.size[1] // step, self.form.size[0] // step))[::-1]
            for step in _STRIDES
        ]
        cells = np.concatenate([grid.reshape(2, -1).T for grid in grids])
        stride = np.repeat(_STRIDES, [grid[0].size for grid in grids])[:, None]
        shape = outputs[0].shape
        if (
            shape[:1] != (1,)
            or len(shape) != 3
            or shape[2] < 5
            or (shape[2] > 5 and shape[1] != len(cells))
        ):
            raise InputError(
                f"{self.network.file}: for pictures of {words(self.form.size)}, YOLOX has an "
                f"output of 1 x {len(cells)} x 6 or more, or of 1 x N x 5 with non-maximum "
                f"suppression in it, but this network has {words(shape)}; give another --boxes"
            )
        found = outputs[0][0]
        if shape[2] == 5:
            labels = (
                outputs[1].reshape(-1)
                if len(outputs) > 1 and outputs[1].size == len(found)
                else None
            )
            score = found[:, 4] if labels is None else np.where(labels == _PERSON, found[:, 4], 0.0)
            return found[:, :4], score, _LEAST_SUPPRESSED
        # In single precision, as in the network: the crops of equal boxes then have equal pixels.
        centre = ((found[:, :2] + cells) * stride).astype(np.float32)
        sides = (np.exp(np.minimum(found[:, 2:4], 50)) * stride).astype(np.float32)
        boxes = np.hstack([centre - sides / 2, centre + sides / 2])
        return boxes, found[:, 4] * found[:, 5 + _PERSON], _LEAST
