"""SMPL-only beside ours, on the same people and the same 2D detections."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.linearisation import triangulate
from shapepose_fg.evaluation.smplify import MultiViewSmplify, SmplifyConfig, SmplifyPeople
from shapepose_fg.evaluation.stage_two import StageTwo, solve_alone
from shapepose_fg.pipeline.pipeline import PipelineConfig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SamePeople:
    """The people of a result without time, row by row, as several methods have them from the same detections."""

    observations: Observations
    """What stage II was given of each row."""
    offsets: KeypointOffsets | None
    """Where the detector puts its joints, as the run learnt it."""
    triangulated: Array
    """(N, J, 3) X_0: robust triangulation of the views alone, metres; NaN where no two views agree."""

    @classmethod
    def of(cls, people: Reconstruction, rig: Rig, config: PipelineConfig) -> "SamePeople":
        """From a result that says what it was solved from; ValueError where it does not."""
        if people.observations is None:
            raise ValueError("people without observations: reconstruct them again")
        observations = people.observations.observations(np.full_like(people.joints, np.nan), people.time_s)
        known = people.run.get("keypoint_offsets")
        offsets = None if known is None else KeypointOffsets.from_dict(known)
        return cls(observations, offsets, triangulate(observations, Views.of(rig), config.observations))

    def smpl_only(self, rig: Rig, config: SmplifyConfig | None = None) -> tuple[SmplifyPeople, float]:
        """Bodies fitted to the detections directly, and the processor time of all rows, seconds."""
        model = BodyModel.default()
        if self.offsets is not None:
            model = model.with_keypoint_offsets(self.offsets)
        fitter = MultiViewSmplify(model, config=config)
        with torch_threads(1):
            began = time.process_time()
            people = fitter.fit(self.observations, rig, self.triangulated)
            return people, time.process_time() - began

    def stage_two(self, rig: Rig, config: PipelineConfig) -> StageTwo:
        """Ours, from the same detections."""
        return solve_alone(self.observations, rig, config, self.offsets)
