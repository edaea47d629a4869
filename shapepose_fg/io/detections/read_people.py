"""The people of one camera, read once to the end: what must be known of all of them, and they themselves, kept."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.detections.scores import ScoreRule, Scores


@dataclass(frozen=True)
class ReadPeople:
    """The people of one camera, kept, and what is known of them."""

    camera: CameraPeople
    """The camera; its blocks have been read."""
    kept: KeptArrays
    """Where they are now."""
    names: tuple[str, ...]
    """Under which names."""
    keypoint_count: int | None
    """K, None where nobody was seen."""
    scores: Scores
    """What is known of their scores."""
    farthest: float | None
    """The largest coordinate of a keypoint that was seen, pixels; None where there is none."""

    def blocks(self) -> Iterator[PeopleBlock]:
        """The people in the order of their frames."""
        for name in self.names:
            yield PeopleBlock(*(self.kept.array(name, key) for key in ("frame", "keypoints")))

    def with_scores(self, rule: ScoreRule) -> CameraPeople:
        """The camera's people with scores from 0 to 1; what is asked for is not kept any longer."""

        def blocks() -> Iterator[PeopleBlock]:
            for name, block in zip(self.names, self.blocks(), strict=True):
                self.kept.drop(name)
                yield PeopleBlock(block.frame, rule.applied(block.keypoints))

        return replace(self.camera, blocks=blocks())


def read_whole(camera: CameraPeople, kept: KeptArrays, name: str) -> ReadPeople:
    """Read all people of a camera, into `kept` under names that begin with `name`."""
    names, counts, scores, farthest = list[str](), list[int](), Scores(), list[float]()
    for block in camera.blocks:
        if len(block.frame) == 0:
            continue
        names.append(f"{name}-{len(names):07d}")
        kept.keep(names[-1], {"frame": block.frame, "keypoints": block.keypoints})
        counts.append(block.keypoints.shape[1])
        scores.add(block.keypoints)
        xy = np.abs(block.keypoints[block.keypoints[..., 2] > 0][:, :2])
        if not np.isnan(xy).all():
            farthest.append(float(np.nanmax(xy)))
    return ReadPeople(
        camera, kept, tuple(names), counts[0] if counts else None, scores, max(farthest, default=None)
    )
