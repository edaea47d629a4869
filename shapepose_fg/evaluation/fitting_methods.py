"""The fitters that are compared, each with the means to cut it short, and how fast they are."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter, PlainFitterConfig
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.evaluation.closed_form import ClosedFormStart
from shapepose_fg.evaluation.fitting import batches, concatenated
from shapepose_fg.evaluation.gradient_descent import GradientDescentConfig, GradientDescentFitter

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]

PLAIN_STEPS = 100
"""Steps of the plain optimiser that learned descent is compared with, as in the paper."""


@dataclass(frozen=True)
class Method:
    """One row of the tables."""

    name: str
    """For tables and figures."""
    make: Callable[[int | None], BodyFitter]
    """The fitter, with so many steps at the most; with None as it is used."""
    steps: tuple[int, ...] = ()
    """Numbers of steps at which error and time are measured; none for a method without steps."""


@dataclass(frozen=True)
class Curve:
    """What a method has reached after how long."""

    ms: Array
    """(M,) milliseconds a fit, in batches."""
    error_mm: Array
    """(M,) mean error of all joints."""

    def time_to(self, error_mm: float) -> float:
        """Milliseconds until the error was this low for the first time; infinite if it never was."""
        reached = self.error_mm <= error_mm
        return float(self.ms[reached].min()) if reached.any() else float("inf")


class ClosedFormFitter(LevenbergMarquardtFitter):
    """`ClosedFormStart` as it is, or as the start of Levenberg-Marquardt's `steps`; implements `BodyFitter`."""

    def __init__(self, model: BodyModel | None = None, pose_prior: PosePrior | None = None, steps: int | None = 0):
        plain = PlainFitterConfig()
        steps = plain.max_iterations if steps is None else steps
        super().__init__(model, pose_prior, PlainFitterConfig(max_iterations=max(steps, 1), unfinished=1e6))
        self._steps = steps
        self._closed_form = ClosedFormStart(self._energy.model, self._prior)

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "ClosedFormFitter":
        """The same fitter for a detector that puts its joints `offsets` away from the body's."""
        return ClosedFormFitter(self.model.with_keypoint_offsets(offsets), self._prior, self._steps)

    def _start(self, xyz: "torch.Tensor", variance: Array) -> "torch.Tensor":
        import torch

        body = self._closed_form(xyz, torch.from_numpy(variance).float())
        pose = body.body_pose.flatten(1)[:, torch.from_numpy(self._energy.angles)]
        return torch.cat((body.betas, body.global_orient, pose, body.transl), 1)

    def _solve(self, free, targets, warm, held=None):
        return free if self._steps == 0 else super()._solve(free, targets, warm, held)


def plain_methods() -> tuple[Method, ...]:
    """The methods that learn nothing but the prior: same start, energy, prior and batching."""
    return (
        Method("closed form alone", lambda steps: ClosedFormFitter()),
        Method(
            f"gradient descent, {PLAIN_STEPS} steps",
            _gradient_descent,
            (5, 10, 20, 40, 60, 80, PLAIN_STEPS),
        ),
        Method("Levenberg-Marquardt, converged", _levenberg_marquardt, (1, 2, 3, 4, 6, 10, 40)),
    )


def learned_methods() -> tuple[Method, ...]:
    """The learned fitter: its steps alone, and with its polish; InputError where its weights are not there."""
    from shapepose_fg.body.fitting.learned import LearnedFitter, LearnedFitterConfig

    def polished(steps: int | None) -> BodyFitter:
        config = LearnedFitterConfig()
        short = replace(config, polish_steps=steps or 0, unfinished=1e6)  # no row is given up
        return LearnedFitter(config=config if steps is None else short)

    return (
        Method("learned, network alone", lambda steps: polished(0)),
        Method("learned", polished, (0, 1, 2, 3)),
    )


def _gradient_descent(steps: int | None) -> BodyFitter:
    """Fewer steps than 60 are shorter in proportion: so they came farthest on the validation subjects."""
    usual = GradientDescentConfig()
    steps = PLAIN_STEPS if steps is None else steps
    share = min(1.0, steps / 60)
    lengths = {name: share * getattr(usual, name) for name in ("step_rad", "step_beta", "step_m")}
    return GradientDescentFitter(config=replace(usual, max_iterations=steps, **lengths))


def _levenberg_marquardt(steps: int | None) -> BodyFitter:
    if steps is None:
        return LevenbergMarquardtFitter()
    return LevenbergMarquardtFitter(config=PlainFitterConfig(max_iterations=steps, unfinished=1e6))


def timed_fit(fitter: BodyFitter, targets: JointTargets, batch: int, rounds: int = 1) -> tuple[BodyFit, Array]:
    """All rows, `batch` at a time, and (R,) milliseconds a fit of every full batch, `rounds` times over.

    The time is the processor's, which other work on the machine does not stretch much: with one thread it is what
    a clock shows on a machine that does nothing else. The first batch is fitted once more before, to warm up.
    """
    parts = batches(targets, batch)
    if len(parts[0]) < batch:
        raise ValueError(f"{len(targets)} rows do not fill a batch of {batch}: give more, or a smaller batch")
    fitter.fit(parts[0])
    fits, ms = [], []
    for part in parts * rounds:
        start = time.process_time()
        fits.append(fitter.fit(part))
        if len(part) == batch:
            ms.append(1e3 * (time.process_time() - start) / batch)
    return concatenated(fits[: len(parts)]), np.array(ms)


def fits_per_second(fitter: BodyFitter, targets: JointTargets, batch: int, workers: int) -> float:
    """By the clock on the wall, the best of three rounds; for a machine that does nothing else.

    Each of the `workers` is a thread that fits one batch after the other, torch on one core in each: the matrices
    are too small to share.
    """
    import torch

    parts, seconds = batches(targets, batch), []
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for _ in range(4):  # the first warms up
            start = time.perf_counter()
            fits = list(pool.map(fitter.fit, parts))
            seconds.append(time.perf_counter() - start)
    return sum(len(fit) for fit in fits) / min(seconds[1:])


def curve(method: Method, targets: JointTargets, truth: Array, batch: int = 64) -> Curve:
    """Error of all joints against `truth` (N, 25, 3) and time, for each of the method's numbers of steps.

    The time is the median over the batches. Every number of steps is a run of its own from the start: what comes
    before and after the steps is in it.
    """
    ms, error = [], []
    for steps in method.steps if len(method.steps) > 0 else (None,):
        fit, times = timed_fit(method.make(steps), targets, batch)
        ms.append(np.median(times))
        error.append(1e3 * np.nanmean(np.linalg.norm(fit.joints - truth, axis=-1)))
    return Curve(np.array(ms), np.array(error))
