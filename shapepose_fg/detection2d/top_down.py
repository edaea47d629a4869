"""People one by one, as RTMPose and its like see them: boxes around people, and the joints of whoever is in each.

Boxes and joints are those of `rtmlib` to a hundredth of a pixel.
"""

import json
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.detection2d.boxes import BoxNetwork
from shapepose_fg.detection2d.keypoints import KeypointNetwork
from shapepose_fg.detection2d.upright import UprightView


@dataclass(frozen=True)
class People:
    """People of one picture, whose joints the network grouped."""

    xy: Array
    """(P, K, 2) positions, in the order of the skeleton's keypoints."""
    score: Array
    """(P, K) as the network gives them; 0 or less is a joint that was not seen."""

    def __len__(self) -> int:
        return int((self.score > 0).sum())

    def moved(self, xy: Array, inside: Mask) -> "People":
        """The same at other positions; those that are not `inside` (P, K) are left out."""
        return replace(self, xy=xy, score=np.where(inside, self.score, 0.0))


@dataclass(frozen=True)
class TopDownNetwork:
    """Boxes, and a network that finds the joints of the person in each."""

    keypoints: KeypointNetwork
    """What finds joints."""
    boxes: BoxNetwork | None
    """What finds people; None where the network is shown whole pictures."""
    suffix, tail = ".json", "\n]\n"

    @property
    def settings(self) -> dict[str, Any]:
        """What the detections depend on."""
        parts = {"network": self.keypoints, "boxes": self.boxes}
        said = {
            key: part and {"sha256": part.network.sha256, **part.form.model_dump(mode="json", exclude={"boxes"})}
            for key, part in parts.items()
        }
        return {"network": said["network"], "detection": {"boxes": said["boxes"]}}

    def head(self, frames: int) -> str:
        """The beginning of MMPose's JSON of a video."""
        return "["

    def text(self, number: int, found: Any, size: tuple[int, int]) -> str:
        """Frame `number` in it: `People`, None where there was no picture. Joints that were not seen are 0 0 0."""
        people = []
        for xy, score in zip(found.xy, found.score, strict=True) if found else ():
            if (seen := score > 0).any():
                xy, score = np.where(seen[:, None], xy, 0.0).round(3), np.where(seen, score, 0.0).round(6)
                people.append({"keypoints": xy.tolist(), "keypoint_scores": score.tolist()})
        return f"{',' if number else ''}\n{json.dumps({'frame_id': number, 'instances': people}, allow_nan=False)}"

    def view(self, region: tuple[float, float, float, float], roll_deg: float) -> UprightView:
        """What it is shown of pictures with such a region and roll: as many pixels as there are."""
        return UprightView.of(region, roll_deg)

    def detect(self, picture: NDArray[np.uint8]) -> People:
        """The people in a `picture` (H, W, 3), blue green red, in its pixels."""
        size, padding = np.array(self.keypoints.size, dtype=np.float64), 1.0
        boxes = np.array([[0.0, 0.0, picture.shape[1], picture.shape[0]]])
        if self.boxes is not None:
            boxes, padding = self.boxes.find(picture), self.keypoints.form.padding
        centre, extent = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) * padding
        aspect, (wide, high) = float(size[0] / size[1]), extent.T
        extent = np.where(wide > high * aspect, [wide, wide / aspect], [high * aspect, high]).T
        count, step = self.keypoints.skeleton.keypoint_count, self.keypoints.network.at_once
        positions, scores = [np.zeros((0, count, 2))], [np.zeros((0, count))]
        for n in range(0, len(boxes), step):
            middle, sides = centre[n : n + step], extent[n : n + step]
            crops = [_crop(picture, *each, size) for each in zip(middle, sides, strict=True)]
            xy, score = self.keypoints.find(np.stack(crops))
            # A network of whole pictures may find several people in each.
            middle, sides = (np.repeat(each, len(xy) // len(crops), axis=0)[:, None] for each in (middle, sides))
            positions.append((xy / size - 0.5) * sides + middle)
            scores.append(score)
        return People(np.concatenate(positions), np.concatenate(scores))


def _crop(picture: NDArray[np.uint8], centre: Array, extent: Array, size: Array) -> NDArray[np.uint8]:
    """What is in a frame around `centre` (2,) with the sides `extent` (2,), at the `size` (2,) of the network.

    It is black outside of the picture.
    """
    # By the three points that rtmlib takes, rounded as there: others would make other pixels here and there.
    points = np.array([[centre, centre], [size / 2, size / 2]])
    points[:, 1, 1] -= extent[0] / 2, size[0] / 2
    points = points.astype(np.float32)
    beside = points[:, 1] + (points[:, 1] - points[:, 0])[:, ::-1] * np.float32([1, -1])
    matrix = cv2.getAffineTransform(*np.concatenate([points, beside[:, None]], axis=1))
    return np.asarray(cv2.warpAffine(picture, matrix, size.astype(int).tolist(), flags=cv2.INTER_LINEAR), np.uint8)
