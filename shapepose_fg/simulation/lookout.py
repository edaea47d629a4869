"""What cameras see of many frames: found here or in worker processes, in order, with the same result."""

from collections.abc import Generator, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.pipeline.workers import Workers
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see

People = tuple[NDArray[np.float64], NDArray[np.float32]]
"""One frame: BODY_25 joints (P, 25, 3) and surfaces (P, M, 3) of everybody, metres."""

AHEAD = 4
"""Frames a worker that are under way: they are short work."""
FRAMES_WORTH_A_WORKER = 100
"""A recording must have this many for each worker, or starting them takes longer than it saves."""


@dataclass(frozen=True)
class Lookout:
    """Who looks: the same for all frames of a recording."""

    rig: Rig
    """The cameras."""
    skin: Skin
    """The surface that is drawn."""
    config: VisibilityConfig
    """How it is drawn and read."""

    def look(self, people: People) -> Visibility:
        """What the cameras see of one frame."""
        joints, surfaces = people
        return see(self.rig, joints, surfaces, self.skin, self.config)

    def watch(self, frames: Iterable[People], workers: int = 1) -> Generator[Visibility, None, None]:
        """What the cameras see, frame after frame; in `workers` processes, or here if that is 1.

        Frames are taken from `frames` as they are needed. Close the iterator (`contextlib.closing`) to end the
        processes early. RuntimeError where one of them dies.
        """
        with Workers(workers, self, AHEAD) as pool:
            yield from pool.map(Lookout.look, frames)
