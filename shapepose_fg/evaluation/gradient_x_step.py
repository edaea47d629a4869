"""Algorithm 1 as it is written: bodies, then gradient steps on the joints; beside it the graph's solver."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factors import make_camera
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.body_step import BodyStep
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, mean_confidence, weakest_sigma
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.window_graph import Message, WindowGraph

_NO_GATE_M = 1e6
"""Farther than anything in a room."""


@dataclass(frozen=True)
class Energy:
    """E(X) of Eq. 5 for N rows while Theta and the gates are fixed."""

    observations: Observations
    """Those that the gates kept."""
    sigmas: NDArray[np.float64]
    """(N, J, V) pixels."""
    views: Views
    """The cameras."""
    body: Message
    """E_shape."""
    config: EstimatorConfig
    """Weights of both."""

    @property
    def ungated(self) -> ObservationConfig:
        """Gates are decided once a round, not in every step."""
        return replace(self.config.observations, rho_2d_m=_NO_GATE_M)

    def gradient(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """dE/dX (N, J, 3) of half the sum of squares, 1/m, at `X` (N, J, 3); zero where nothing pulls."""
        seen = linearise(self.observations, self.sigmas, X, self.views, self.ungated)
        away = np.where(self.body.known[..., None], X - np.nan_to_num(self.body.xyz), 0.0)
        shape = np.einsum("...ij,...j->...i", self.body.information, away)
        return self.config.graph.weight_2d * seen.gradient + self.config.graph.weight_shape * np.nan_to_num(shape)

    def value(self, X: NDArray[np.float64]) -> float:
        """Half the sum of squares, for a configuration without a robust kernel."""
        projected, _, _ = self.views.project(X)
        residual = np.where(self.observations.seen[..., None], projected - self.observations.xy, 0.0)
        sigma = np.where(self.observations.seen, self.sigmas, 1.0)
        seen = np.nansum((residual / sigma[..., None]) ** 2)
        away = np.where(self.body.known[..., None], X - np.nan_to_num(self.body.xyz), 0.0)
        shape = np.nansum(np.einsum("...i,...ij,...j->...", away, self.body.information, away))
        return 0.5 * float(self.config.graph.weight_2d * seen + self.config.graph.weight_shape * shape)


XStep = Callable[[Energy, NDArray[np.float64]], NDArray[np.float64]]
"""From an energy and X_n to X_n+1 (N, J, 3)."""


@dataclass(frozen=True)
class GradientStep:
    """X_n+1 = X_n - lambda dE/dX: Algorithm 1, whose plus sign is a slip."""

    step_m2: float
    """lambda, m²: gradients are in 1/m."""
    count: int = 1
    """Steps in a round; the paper has one."""

    def __call__(self, energy: Energy, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """So many steps from `X`."""
        for _ in range(self.count):
            X = X - self.step_m2 * energy.gradient(X)
        return X


class GraphStep:
    """X_n+1 = argmin E: Levenberg-Marquardt in a factor graph for each row, as `Estimator` does it."""

    def __init__(
        self, observations: Observations, sigmas: NDArray[np.float64], rig: Rig, config: EstimatorConfig
    ) -> None:
        """Make the graphs' factors once; `sigmas` (N, J, V) in pixels."""
        motion = MotionModel.load(tuple(map(str, range(sigmas.shape[1]))), config.motion)  # frames alone have none
        cameras = [make_camera(camera.K, camera.wTc) for camera in rig.cameras]
        first = np.zeros(1, dtype=np.intp)
        self._graphs = [
            WindowGraph(
                [cameras], xy[None], sigma[None], config.graph, config.observations.robust_kernel, motion,
                track=n, frames=first, times_s=np.zeros(1),
            )
            for n, (xy, sigma) in enumerate(zip(observations.xy, sigmas, strict=True))
        ]  # fmt: skip

    def __call__(self, energy: Energy, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """The minimum near `X`; joints that nothing determines stay where they are."""
        seen = linearise(energy.observations, energy.sigmas, X, energy.views, energy.ungated).sigma_m
        determined = (seen <= energy.config.refine.max_sigma_m) | energy.body.known
        inlier = energy.observations.seen & determined[..., None]
        start = np.where(determined[..., None], X, np.nan)
        solved = []
        for n, graph in enumerate(self._graphs):
            row = np.array([n])
            body = energy.body.rows(row)
            solved.append(graph.solve(inlier[row], body, body, start[row])[0])
        found = np.stack(solved) if solved else X
        return np.where(np.isfinite(found), found, X)


@dataclass(frozen=True)
class Alternated:
    """What the alternation came to."""

    joints: NDArray[np.float64]
    """(N, J, 3) X_N, metres; NaN where nothing places a joint."""
    energy: Energy
    """That of the last round."""
    body_s: float
    """Processor time of the bodies and gates."""
    step_s: float
    """Processor time of the X steps."""


def alternate_with(
    observations: Observations,
    sigmas: NDArray[np.float64],
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    x_step: XStep,
    rounds: int,
) -> Alternated:
    """Algorithm 1 with `rounds` rounds from the proposals `observations.initial`, each row by itself.

    `sigmas` (N, J, V) in pixels are those of `observation_sigmas`.
    """
    X, step = observations.initial, BodyStep(fitter, None, config)
    last = BodyFit.failed(np.full(len(X), FitStatus.TOO_FEW_JOINTS), X.shape[1])
    body_s, step_s, energy = 0.0, 0.0, None
    enough = np.isfinite(X).all(axis=-1).sum(axis=1) >= LEAST_JOINTS
    for _ in range(rounds):
        began = time.process_time()
        evidence = linearise(observations, sigmas, X, views, config.observations)
        targets = step.targets(evidence, enough)
        last = step.fit(targets, last)
        pulled = mean_confidence(observations, evidence.inlier) <= config.graph.rho_3d
        pulled |= weakest_sigma(evidence.information) > config.refine.max_sigma_m
        said = step.message(last, targets, pulled, ())
        start = np.where(np.isfinite(X), X, np.where(said.known[..., None], said.xyz, np.nan))
        kept = replace(observations, confidence=np.where(evidence.inlier, observations.confidence, 0.0))
        energy = Energy(kept, sigmas, views, said, config)
        solving = time.process_time()
        X = x_step(energy, start)
        body_s, step_s = body_s + solving - began, step_s + time.process_time() - solving
    assert energy is not None
    return Alternated(X, energy, body_s, step_s)
