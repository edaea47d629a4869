"""Rows of a result solved anew from their own observations: after who is who was corrected by hand."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.frame_times import stretches
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.estimation.estimator import Estimator, ExtraFactors
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.pipeline.bodies_over_time import SequenceFitting, with_bodies_over_time
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.solved_rows import result_rows
from shapepose_fg.pipeline.windows import near_border, window_stop


def solve_rows(
    rows: Reconstruction,
    rig: Rig,
    config: PipelineConfig,
    fitter: BodyFitter,
    *,
    extra_factors: ExtraFactors | None = None,
) -> Reconstruction:
    """Some people of a result solved anew, each over all of their rows, in the windows of the whole recording.

    Detections stay with whom they were given; gates are decided anew. `fitter` knows where the detector puts its
    joints (`run["keypoint_offsets"]`). ValueError where `rows` do not say what they were solved from.
    """
    if rows.observations is None:
        raise ValueError("rows without observations cannot be solved anew; reconstruct the recording again")
    joint_names = tuple(rows.joint_names.tolist())
    estimator = Estimator(rig, fitter, joint_names, config.estimator)
    parts = []
    with torch_threads(config.threads):
        for window in _windows(rows, config):
            part = rows.rows(window.rows(rows, config.windows.overlap_s))
            table = part.observations
            assert table is not None
            # From the views: the joints as they are may be somebody else's.
            observations = table.observations(np.full_like(part.joints, np.nan), part.time_s)
            estimates = estimator.estimate(observations, extra_factors)
            solved = result_rows(observations, estimates, table.candidate, rig, joint_names, part.person)
            parts.append(solved.rows(_inside(part.frame, window.own)))
        solved = replace(Reconstruction.concatenate(parts), run=rows.run) if parts else rows
        if not isinstance(fitter, SequenceFitting):
            return solved
        return with_bodies_over_time(solved, fitter, floor=Floor.from_dict(rows.run.get("floor")))


@dataclass(frozen=True)
class _Window:
    """A window of the recording, whoever is in it."""

    own: range
    """The frames whose rows it returns."""
    stretch: range
    """The frames from one cut to the next that it lies in."""

    def rows(self, rows: Reconstruction, overlap_s: float) -> NDArray[np.intp]:
        """Rows in its own frames, and in those within `overlap_s` of its borders, none beyond a cut."""
        frame, time_s = rows.frame, rows.time_s
        known, first = np.unique(frame, return_index=True)
        # Where no row is in the frame at a border, its time is between those of the frames around it.
        begin_s, end_s = np.interp([self.own.start, self.own.stop], known, time_s[first])
        own = _inside(frame, self.own)
        before = near_border(time_s, begin_s, overlap_s) & (frame < self.own.start)
        after = near_border(time_s, end_s, overlap_s) & (frame >= self.own.stop)
        return np.flatnonzero((own | before | after) & _inside(frame, self.stretch))


def _windows(rows: Reconstruction, config: PipelineConfig) -> list[_Window]:
    """The windows that have any of `rows`, as the recording was cut into them."""
    first, last = (int(rows.frame.min()), int(rows.frame.max()) + 1) if len(rows) > 0 else (0, 0)
    cuts: Sequence[int] = rows.run.get("cuts", ())
    covered = covered_frames(rows.run) or [range(first, last)]
    windows = []
    for stretch in (part for span in covered for part in stretches(span, cuts)):
        start = stretch.start
        while start < stretch.stop:
            stop = window_stop(start, stretch.stop, config.batch_frames)
            windows.append(_Window(range(start, stop), stretch))
            start = stop
    return [window for window in windows if _inside(rows.frame, window.own).any()]


def _inside(frame: NDArray[np.integer], span: range) -> NDArray[np.bool_]:
    """(N,) which frames are in `span`."""
    return (frame >= span.start) & (frame < span.stop)
