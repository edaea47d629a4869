"""Bodies by first-order optimisation (Adam): what a learned step is compared with."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.baseline import ANNEAL_STEPS, LevenbergMarquardtFitter, PlainFitterConfig
from shapepose_fg.body.fitting.energy import Held, WhitenedTargets
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets

_MOMENTUM, _MEMORY, _TINY = 0.8, 0.95, 1e-8
"""Averaging of gradients and of their squares. These and the lengths of the steps below are the best of a grid on
the subjects of `training.split` that settings are chosen on: after 100 steps within 0.2 mm of the optimum."""


@dataclass(frozen=True)
class GradientDescentConfig(PlainFitterConfig):
    """Settings of `GradientDescentFitter`; those of `PlainFitterConfig` that are not about damping hold too."""

    max_iterations: int = 100
    """Steps; every row takes all of them."""
    unfinished: float = math.inf
    """First-order steps leave directions unfinished in which the energy hardly changes: no failure here."""
    step_rad: float = 0.3
    """Length of the first steps, along each angle; it falls to zero as half a cosine."""
    step_beta: float = 1.0
    """The same along each beta."""
    step_m: float = 0.03
    """The same along the axes of the translation, metres."""


class GradientDescentFitter(LevenbergMarquardtFitter):
    """Minimises `BodyEnergy` by Adam; start, kernel, judgement and result as in `LevenbergMarquardtFitter`.

    The kernel begins as wide and has its final width after a fifth of the steps.
    """

    def __init__(
        self,
        model: BodyModel | None = None,
        pose_prior: PosePrior | None = None,
        config: GradientDescentConfig | None = None,
    ):
        config = GradientDescentConfig() if config is None else config
        super().__init__(model, pose_prior, config)
        self._descent = config
        self._steps = torch.full((self._energy.num_free,), config.step_rad)
        self._steps[:10], self._steps[-3:] = config.step_beta, config.step_m

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "GradientDescentFitter":
        """The same fitter for a detector that puts its joints `offsets` away from the body's."""
        return GradientDescentFitter(self.model.with_keypoint_offsets(offsets), self._prior, self._descent)

    def _solve(
        self, free: Tensor, targets: WhitenedTargets, warm: NDArray[np.bool_], held: Held | None = None
    ) -> Tensor:
        """All steps of Adam (Kingma and Ba 2015) from `free` (B, P); returns (B, P)."""
        config, steps = self._descent, self._steps.repeat(len(free), 1)
        if held is not None:
            steps[:, :10] /= held.stiffness  # Adam would jump as far however stiff
        first, second = torch.zeros_like(free), torch.zeros_like(free)
        annealing = torch.where(torch.from_numpy(warm), 0, ANNEAL_STEPS)[:, None]
        for n in range(config.max_iterations):
            done = n / config.max_iterations
            widening = annealing * max(0.0, 1 - 5 * done)
            gradient = self._energy.slope(free, targets, config.kernel_scale * 2.0**widening, held).gradient
            first = _MOMENTUM * first + (1 - _MOMENTUM) * gradient
            second = _MEMORY * second + (1 - _MEMORY) * gradient.square()
            scale = math.sqrt(1 - _MEMORY ** (n + 1)) / (1 - _MOMENTUM ** (n + 1))
            length = 0.5 * (1 + math.cos(math.pi * done)) * scale * steps
            free = self._energy.retract(free, -length * first / (second.sqrt() + _TINY))
        return free
