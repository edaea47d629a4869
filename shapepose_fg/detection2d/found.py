"""What a network finds in one picture: candidates with affinities, or people; and how either is written."""

import json
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.io.detections.association_text import TextSkeleton
from shapepose_fg.io.write_detections import association_lines


@dataclass(frozen=True)
class Candidates:
    """Joint candidates of one picture, sorted by joint, and affinities between them."""

    joint: Index
    """(D,) joint of each candidate, in the layout's order."""
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
        return Candidates(
            self.joint[inside],
            xy[inside],
            self.score[inside],
            place[self.pairs[both]],
            self.limb[both],
            self.affinity[both],
        )


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


class AssociationFile:
    """Candidates as 4D Association's text."""

    suffix, tail = ".txt", ""

    def __init__(self, kind: TextSkeleton) -> None:
        self.kind = kind

    def head(self, frames: int) -> str:
        """What the file of so many frames begins with."""
        return f"{self.kind.number} {frames}\n"

    def frame(self, number: int, found: Candidates | None, size: tuple[int, int]) -> str:
        """What was found in a picture of the calibrated `size`; None where there was no picture."""
        if found is None:
            return "0\n" * len(self.kind.joints)
        fractions = found.xy / (np.array(size) - 1.0)
        lines = association_lines(self.kind, found.joint, fractions, found.score, found.pairs, found.affinity)
        return "".join(f"{line}\n" for line in lines)


class PeopleFile:
    """People as MMPose's JSON of a video, which lists every frame."""

    suffix, tail = ".json", "\n]\n"

    def head(self, frames: int) -> str:
        """What the file begins with."""
        return "["

    def frame(self, number: int, found: People | None, size: tuple[int, int]) -> str:
        """Who was found in a picture; joints that were not seen are 0 0 0."""
        people = []
        for xy, score in zip(found.xy, found.score, strict=True) if found is not None else ():
            if (seen := score > 0).any():
                xy, score = np.where(seen[:, None], xy, 0.0).round(3), np.where(seen, score, 0.0).round(6)
                people.append({"keypoints": xy.tolist(), "keypoint_scores": score.tolist()})
        return f"{',' if number else ''}\n{json.dumps({'frame_id': number, 'instances': people}, allow_nan=False)}"
