"""Calibrates cameras with different start times: rough offsets, then poses and offsets
alternately.
"""

from collections.abc import Callable, Sequence

import numpy as np

from shapepose_fg.cameras.bundle import Freedom, Steps, Undetermined
from shapepose_fg.cameras.calibrate.from_people import (
    KNOWN_LENS,
    Calibrated,
    calibrate,
    own_tracks,
)
from shapepose_fg.cameras.calibrate.levelling import Measured
from shapepose_fg.cameras.offsets.from_heights import offsets_without_poses
from shapepose_fg.cameras.resection import ROUNDS
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.synchronise import WHOLE_S, Synchronised, offsets
from shapepose_fg.cameras.tracks import at_regular_times, next_of, on_one_clock
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes

_STILL_S = 0.001
"""Change per round below which offsets have converged, s."""


def calibrate_unsynchronised(
    detections: DetectionSequence,
    rig: Rig,
    fps: float,
    frames: range,
    most_s: float = 60.0,
    lens: Freedom | Sequence[Freedom] = KNOWN_LENS,
    measured: Measured | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    time_s: Array | None = None,
) -> tuple[Calibrated, Synchronised]:
    """Estimate the poses of the cameras of `rig`, as `calibrate` does, and their start times, up to
    `most_s` apart.

    `time_s` (T, V) are the times of the frames on each camera's own clock, s, from 0 on; by default
    frame / `fps`.

    Raises Undetermined if the people do not determine poses or offsets.
    """
    V = len(rig)
    frames = frames[: round(WHOLE_S * fps)]
    sightings = at_regular_times(Sightings.of(detections, frames), time_s, fps)
    total = 100 * (1 + ROUNDS)
    tracks = own_tracks(sightings, rig, fps)
    paired = Steps(lambda done, pairs: progress(100 * done // pairs, total), V - 1)
    shift = offsets_without_poses(tracks, fps, most_s, paired)
    following, found, problems = next_of(sightings), None, tuple[str, ...]()
    for turn in range(ROUNDS):
        seen = on_one_clock(sightings, following, shift, detections.skeleton)
        times = FrameTimes.from_fps(fps, seen.frames.stop)
        begin = 100 * (1 + turn)
        start = None if found is None else found.rig

        def part(step: int, steps: int, begin: int = begin) -> None:
            progress(begin + round(100 * step / steps), total)

        try:
            found, problems = (
                calibrate(seen, rig, times, seen.frames, lens, measured, part, start),
                (),
            )
        except Undetermined as refused:
            if refused.found is None:
                raise
            found, problems = refused.found, refused.problems
        offset, sigma, prominence = offsets(
            sightings, found.rig, fps, frames, most_s, np.zeros(V), lambda *_: None
        )
        before, shift = shift, -offset * fps
        if np.abs(shift - before).max() < _STILL_S * fps:
            break
    assert found is not None
    progress(total, total)
    none, middle = np.zeros(V), (frames.start + frames.stop) / 2 / fps
    clocks = Synchronised(offset, sigma, prominence, none, middle)
    if problems := (*problems, *clocks.undetermined(rig)):
        raise Undetermined(problems, found)
    return found, clocks
