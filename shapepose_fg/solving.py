"""Rows of a result solved anew from their own observations: after who is who was corrected by hand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.bodies_over_time import with_bodies_over_time
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.camera import Rig
from shapepose_fg.estimation.estimator import Estimator, ExtraFactors
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.frame_times import stretches
from shapepose_fg.person_bodies import SequenceFitting
from shapepose_fg.pipeline import PipelineConfig
from shapepose_fg.reconstruction import Reconstruction
from shapepose_fg.run_summary import covered_frames
from shapepose_fg.solved_rows import result_rows


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
    settings = EstimatorConfig(config.observations, config.window_graph, config.refine, config.motion)
    joint_names = tuple(rows.joint_names.tolist())
    estimator = Estimator(rig, fitter, joint_names, settings)
    parts = []
    with torch_threads(config.threads):
        for own in _windows(rows, config):
            near = _near(rows, own, config)
            part = rows.rows(near)
            table = part.observations
            assert table is not None
            # From the views: the joints as they are may be somebody else's.
            observations = table.observations(np.full_like(part.joints, np.nan), part.time_s)
            estimates = estimator.estimate(observations, extra_factors)
            solved = result_rows(observations, estimates, table.candidate, rig, joint_names, part.person)
            parts.append(solved.rows(np.isin(part.frame, np.array(own))))
        solved = replace(Reconstruction.concatenate(parts), run=rows.run) if parts else rows
        return with_bodies_over_time(solved, fitter) if isinstance(fitter, SequenceFitting) else solved


def _windows(rows: Reconstruction, config: PipelineConfig) -> list[range]:
    """The frames of each window that has any of `rows`, as the recording was cut into them."""
    first, last = (int(rows.frame.min()), int(rows.frame.max()) + 1) if len(rows) > 0 else (0, 0)
    cuts: Sequence[int] = rows.run.get("cuts", ())
    covered = covered_frames(rows.run) or [range(first, last)]
    windows = []
    for stretch in (part for span in covered for part in stretches(span, cuts)):
        size = config.batch_frames
        inside = rows.frame[(rows.frame >= stretch.start) & (rows.frame < stretch.stop)]
        starts = stretch.start + size * np.unique((inside - stretch.start) // size)
        windows += [range(start, min(start + size, stretch.stop)) for start in starts.tolist()]
    return windows


def _near(rows: Reconstruction, own: range, config: PipelineConfig) -> NDArray[np.intp]:
    """Rows in the frames `own` and in those around them that the window overlaps, none beyond a cut."""
    cuts = np.array(rows.run.get("cuts", ()), dtype=np.int64)
    begin = cuts[cuts <= own.start].max(initial=0)
    end = cuts[cuts >= own.stop].min(initial=np.iinfo(np.int64).max)
    inside = (rows.frame >= own.start) & (rows.frame < own.stop)
    times = rows.time_s[inside]
    overlap_s = config.windows.overlap_s
    around = (rows.time_s >= times.min() - overlap_s) & (rows.time_s <= times.max() + overlap_s)
    return np.flatnonzero((inside | around) & (rows.frame >= begin) & (rows.frame < end))
