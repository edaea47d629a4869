"""Top-down networks such as RTMPose: boxes around people, and the joints of the person in each.

Boxes and joints agree with those of `rtmlib` to a hundredth of a pixel
(tests/detection2d/test_against_rtmlib.py).
"""

import json
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS, Skeleton
from shapepose_fg.detection2d.boxes import BoxForm, BoxNetwork, Side
from shapepose_fg.detection2d.decoding import between_cells
from shapepose_fg.detection2d.onnx_network import Blob, OnnxNetwork, words
from shapepose_fg.detection2d.upright import UprightView

_Three = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Above0 = Annotated[FiniteFloat, Field(gt=0)]


class KeypointForm(BaseModel, extra="forbid"):
    """Description of a keypoint network (TOML file); the defaults are those of RTMPose."""

    network: str = ""
    """ONNX file of the network."""
    skeleton: str | None = None
    """One of `SKELETONS`, or a skeleton's TOML file; None if the number of joints determines it."""
    joints: list[str] | None = None
    """Name of each joint of the network in the skeleton, "" for none; None for its keypoints in
    order."""
    decoding: Literal["simcc", "heat map", "coordinates"] = "simcc"
    """Output of the network: for each joint two 1D distributions along x and y (SimCC), a heat map,
    or x, y and score."""
    input: str | None = None
    """Name of the network's input; None for the only one."""
    outputs: list[str] | None = None
    """Names of the network's outputs: x and y of SimCC, otherwise one; None for the first ones."""
    size: tuple[Side, Side] = (192, 256)
    """Width and height of the network's input, pixels, if the ONNX file does not fix them."""
    colours: Literal["bgr", "rgb"] = "bgr"
    """Order of the colour channels of the input. RTMPose was trained on RGB; rtmlib and others run
    it with BGR."""
    mean: _Three = (123.675, 116.28, 103.53)
    """Mean that is subtracted from the colours (0 to 255), in their order."""
    std: tuple[_Above0, _Above0, _Above0] = (58.395, 57.12, 57.375)
    """Standard deviation by which the colours are divided after subtracting the mean."""
    cells: Literal["corners", "edges"] = "corners"
    """Whether the outer cells of a heat map have their centres on the input's outer pixels, or fill
    the input."""
    scale: tuple[FiniteFloat, FiniteFloat] = (1.0, 1.0)
    """Pixels of the input per unit of coordinates, x and y."""
    padding: Annotated[FiniteFloat, Field(ge=1, le=4)] = 1.25
    """Ratio of the size of the network's input to that of the box."""
    boxes: BoxForm | None = None
    """Network that detects people; None if the input is the whole picture."""


@dataclass(frozen=True)
class PicturePeople:
    """People of one picture, with their joints grouped by the network."""

    xy: Array
    """(P, K, 2) positions, in the order of the skeleton's keypoints."""
    score: Array
    """(P, K) scores of the network; 0 or less for a joint that was not detected."""

    def __len__(self) -> int:
        return int((self.score > 0).sum())

    def moved(self, xy: Array, inside: Mask) -> "PicturePeople":
        """Return the people at other positions; joints that are not `inside` (P, K) get the score
        0.
        """
        return replace(self, xy=xy, score=np.where(inside, self.score, 0.0))


@dataclass(frozen=True)
class TopDownNetwork:
    """A box network that detects people, and a network that finds the joints of the person in each
    box.
    """

    network: OnnxNetwork
    """The network that finds joints."""
    form: KeypointForm
    """Description of the network."""
    skeleton: Skeleton
    """Skeleton to which the network's joints are assigned."""
    place: Index
    """(N,) index of each of the network's joints among the skeleton's K keypoints, -1 for none."""
    boxes: BoxNetwork | None
    """Network that detects people; None if the input is the whole picture."""
    suffix, tail = ".json", "\n]}\n"

    @classmethod
    def of(
        cls,
        network: OnnxNetwork,
        form: KeypointForm,
        skeleton: Skeleton | None,
        boxes: BoxNetwork | None,
    ) -> "TopDownNetwork":
        """Load the network and run it on an empty picture: InputError if it does not fit its
        description.
        """
        count = _decoded(network, form, np.zeros((1, 3, *form.size[::-1]), dtype=np.float32))[
            1
        ].shape[1]
        skeleton = skeleton or next(
            (each for each in SKELETONS.values() if each.keypoint_count == count), None
        )
        if skeleton is None:
            raise InputError(
                f"{network.file}: no known skeleton has {count} joints; describe the "
                "network in a TOML file (docs/detection.md)"
            )
        keypoints = range(len(skeleton)) if skeleton.keypoints is None else skeleton.keypoints
        names = ["" if joint < 0 else skeleton.joints[joint] for joint in keypoints]
        listed = names if form.joints is None else form.joints
        if wrong := [
            name for name in listed if name and (name not in names or listed.count(name) > 1)
        ]:
            raise InputError(
                f"{network.file}: joints has {wrong[0]!r}, which must be a keypoint of"
                f' {skeleton.name} without repetition ({" ".join(filter(None, names))}), or ""'
            )
        if len(listed) != count:
            raise InputError(
                f"{network.file}: the network has {count} joints, but {len(listed)} are named"
                f" ({skeleton.name}); name its skeleton, or its joints, in a TOML file"
            )
        place = np.array([names.index(name) if name else -1 for name in listed], dtype=np.intp)
        return cls(network, form, skeleton, place, boxes)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that affect the detections."""
        descriptions = [
            part
            and {
                "sha256": part.network.sha256,
                **part.form.model_dump(mode="json", exclude={"network", "boxes"}),
            }
            for part in (self, self.boxes)
        ]
        return {"network": descriptions[0], "detection": {"boxes": descriptions[1]}}

    def head(self, frames: int) -> str:
        """The beginning of MMPose's JSON of a video, with the layout of the joints unless it was
        guessed.
        """
        candidates = [
            each
            for each in SKELETONS.values()
            if each.keypoint_count == self.skeleton.keypoint_count
        ]
        named = self.form.skeleton in SKELETONS or candidates == [self.skeleton]
        meta = {"dataset_name": self.skeleton.name} if named else {}
        return f'{{"meta_info": {json.dumps(meta)}, "instance_info": ['

    def text(self, number: int, found: Any, size: tuple[int, int]) -> str:
        """Frame `number` of the JSON: `PicturePeople`, or None if there was no picture. Joints that
        were not detected are 0 0 0.
        """
        people = []
        for xy, score in zip(found.xy, found.score, strict=True) if found else ():
            if (seen := score > 0).any():
                xy, score = (
                    np.where(seen[:, None], xy, 0.0).round(3),
                    np.where(seen, score, 0.0).round(6),
                )
                people.append({"keypoints": xy.tolist(), "keypoint_scores": score.tolist()})
        frame = json.dumps({"frame_id": number, "instances": people}, allow_nan=False)
        return f"{',' if number else ''}\n{frame}"

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """The input for pictures with the given region and roll, at full resolution."""
        return UprightView.of(region, roll_deg)

    def detect(self, picture: NDArray[np.uint8]) -> PicturePeople:
        """The people in a `picture` (H, W, 3), blue green red, in its pixels."""
        size, padding = np.array(self.form.size, dtype=np.float64), 1.0
        boxes = np.array([[0.0, 0.0, picture.shape[1], picture.shape[0]]])
        if self.boxes is not None:
            boxes, padding = self.boxes.find(picture), self.form.padding
        centre, extent = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) * padding
        aspect, (wide, high) = float(size[0] / size[1]), extent.T
        extent = np.where(wide > high * aspect, [wide, wide / aspect], [high * aspect, high]).T
        count, step = self.skeleton.keypoint_count, self.network.at_once
        positions, scores = [np.zeros((0, count, 2))], [np.zeros((0, count))]
        for n in range(0, len(boxes), step):
            middle, sides = centre[n : n + step], extent[n : n + step]
            crops = [_crop(picture, *each, size) for each in zip(middle, sides, strict=True)]
            xy, score = self._joints(np.stack(crops))
            # A network that gets whole pictures may find several people in each.
            middle, sides = (
                np.repeat(each, len(xy) // len(crops), axis=0)[:, None] for each in (middle, sides)
            )
            positions.append((xy / size - 0.5) * sides + middle)
            scores.append(score)
        return PicturePeople(np.concatenate(positions), np.concatenate(scores))

    def _joints(self, crops: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Positions (P, K, 2) in pixels of `crops` (B, H, W, 3), and scores (P, K).

        P is B, or a multiple of B if the network finds several people in each. Missing joints, and
        values that are not finite, have a score of 0.
        """
        ordered = crops if self.form.colours == "bgr" else crops[..., ::-1]
        blob = ((ordered - np.array(self.form.mean)) / np.array(self.form.std)).transpose(
            0, 3, 1, 2
        )
        xy, score = _decoded(self.network, self.form, np.ascontiguousarray(blob, dtype=np.float32))
        found = np.zeros((len(xy), self.skeleton.keypoint_count, 3))
        known = np.flatnonzero(self.place >= 0)
        found[:, self.place[known]] = np.dstack([xy, score])[:, known]
        found[~np.isfinite(found).all(axis=2)] = 0
        return found[..., :2], found[..., 2]


def _crop(
    picture: NDArray[np.uint8], centre: Array, extent: Array, size: Array
) -> NDArray[np.uint8]:
    """Cut the part of a picture around `centre` (2,) with the sides `extent` (2,), resized to the
    network's input `size` (2,). Outside of the picture it is black.
    """
    # The affine map of rtmlib, from the same three points with the same rounding: others would
    # change some pixels.
    points = np.array([[centre, centre], [size / 2, size / 2]])
    points[:, 1, 1] -= extent[0] / 2, size[0] / 2
    points = points.astype(np.float32)
    beside = points[:, 1] + (points[:, 1] - points[:, 0])[:, ::-1] * np.array(
        [1, -1], dtype=np.float32
    )
    matrix = cv2.getAffineTransform(*np.concatenate([points, beside[:, None]], axis=1))
    crop = cv2.warpAffine(picture, matrix, (int(size[0]), int(size[1])), flags=cv2.INTER_LINEAR)
    return np.asarray(crop, dtype=np.uint8)


def _decoded(network: OnnxNetwork, form: KeypointForm, blob: Blob) -> tuple[Array, Array]:
    """Positions (P, N, 2) of the network's joints in pixels of its input, and scores (P, N)."""
    # Number of axes of each output, for each decoding.
    axes = {"simcc": [3, 3], "heat map": [4], "coordinates": [3]}[form.decoding]
    outputs = network.run(blob)
    if form.outputs is not None:
        outputs = [outputs[network.outputs.index(name)] for name in form.outputs]
    read = [each.astype(np.float64) for each in outputs[: len(axes)]]
    if form.decoding == "coordinates" and read[0].ndim == 4:  # several people in each picture
        read = [read[0].reshape(-1, *read[0].shape[2:])]
    shapes = [each.shape for each in read]
    if (
        [*map(len, shapes)] != axes
        or not all(map(all, shapes))
        or shapes[0][0] % len(blob) != 0
        or shapes[0][:2] != shapes[-1][:2]
        or (form.decoding == "coordinates" and shapes[0][2] not in (2, 3))
    ):
        raise InputError(
            f"{network.file}: the output of the network is "
            f"{' and '.join(words(each.shape) for each in outputs)}, which is not a "
            f"{form.decoding}; describe the network in a TOML file (docs/detection.md)"
        )
    size = np.array(blob.shape[:1:-1])
    if form.decoding == "simcc":
        split = np.array([each.shape[2] for each in read]) / size
        score = np.mean([each.max(axis=2) for each in read], axis=0)
        return np.dstack([each.argmax(axis=2) for each in read]) / split, score
    if form.decoding == "heat map":
        return _peaks(read[0], size, form.cells == "corners")
    (found,) = read
    return found[..., :2] * form.scale, found[..., 2] if shapes[0][2] == 3 else np.ones(
        shapes[0][:2]
    )


def _peaks(maps: Array, size: Index, corners: bool) -> tuple[Array, Array]:
    """Positions (B, N, 2) in pixels, refined between the cells, and heights (B, N) of the maxima of
    maps (B, N, H, W).
    """
    shape = np.array(maps.shape[:1:-1])
    flat = np.nan_to_num(maps, nan=0.0, posinf=0.0, neginf=0.0).reshape(-1, *maps.shape[2:])
    row, column = np.divmod(flat.reshape(len(flat), -1).argmax(axis=1), shape[0])
    padded = np.pad(flat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    cell, height = between_cells(padded, np.arange(len(flat)), row + 1, column + 1)
    cell -= 1
    pixel = (
        cell * (size - 1) / np.maximum(shape - 1, 1)
        if corners
        else (cell + 0.5) * size / shape - 0.5
    )
    return pixel.reshape(*maps.shape[:2], 2), height.reshape(maps.shape[:2])
