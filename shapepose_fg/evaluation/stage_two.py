"""Stage II alone: rows whose 2D detections are given, each by itself, and how many steps their bodies took."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.fitting.learned import LearnedFitter
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator import Estimates, Estimator
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig


@dataclass(frozen=True)
class StageTwo:
    """What stage II made of N rows."""

    estimates: Estimates
    """Joints and bodies."""
    cpu_s: float
    """Processor time of all rows together, seconds."""
    body_steps: float
    """Steps that the fit of a row's body took in all alternations, the mean over rows; without fits that leave
    joints out, and rows that the plain optimiser took over. NaN for another fitter than the learned one."""


def solve_alone(
    observations: Observations, rig: Rig, config: PipelineConfig, offsets: KeypointOffsets | None
) -> StageTwo:
    """Stage II of N rows (BODY_25) that have nothing to do with each other, as in `reconstruct` without time."""
    fitter = make_fitter(config.body)
    if offsets is not None:
        fitter = fitter.with_keypoint_offsets(offsets)
    counted = _Counted(fitter)
    settings = EstimatorConfig(config.observations, config.window_graph, config.refine, config.motion)
    estimator = Estimator(rig, counted, BODY_25.joints, settings)
    alone = replace(observations, track=np.arange(len(observations)))  # no two rows are one person's
    with torch_threads(config.threads):
        began = time.process_time()
        estimates = estimator.estimate(alone)
        spent = time.process_time() - began
    steps = np.nan
    if isinstance(fitter, LearnedFitter):
        steps = fitter.weights.network.config.steps + fitter.config.polish_steps
    return StageTwo(estimates, spent, steps * counted.rows / max(len(observations), 1))


class _Counted:
    """A fitter that counts the rows it fits."""

    def __init__(self, fitter: BodyFitter) -> None:
        self._fitter = fitter
        self.rows = 0

    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: NDArray[np.intp] | None = None
    ) -> BodyFit:
        """See `BodyFitter`."""
        self.rows += len(targets)
        return self._fitter.fit(targets, initial, groups)
