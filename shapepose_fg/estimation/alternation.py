"""Stage II: joints and bodies in alternation, as in Algorithm 1 of the paper."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import determined
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.camera import Rig
from shapepose_fg.estimation.linearisation import (
    Evidence,
    ObservationConfig,
    mean_confidence,
    observation_sigmas,
    triangulate,
    weigh,
)
from shapepose_fg.estimation.person_graph import PersonGraph, PersonGraphConfig, make_cameras
from shapepose_fg.observations import Observations
from shapepose_fg.reconstruction import Status

ExtraFactors = Callable[[PersonGraph], Iterable[gtsam.NonlinearFactor]]
"""Your own factors for a person's graph, made from its keys."""


@dataclass(frozen=True)
class RefineConfig:
    """How the alternation runs."""

    alternations: int = 3
    """N of Algorithm 1: how often the body is fitted and the joints are solved, at the most."""
    settled_m: float = 0.002
    """A person whose joints all moved less in a round is done: most are after one or two. 0: nobody is."""
    max_sigma_m: float = 0.5
    """A joint whose views leave it less certain than this in some direction is not determined by them."""
    disagreement: float = 4.0
    """A joint that its views put this many standard deviations from where the rest of the body puts it is seen
    wrongly: its gates are decided anew from the body's place. Of three coordinates, 0.1 % are farther by chance;
    of real joints that four or five views agree on, 0.02 % were (docs/evaluation.md)."""
    min_joints: int = 4
    """Fewer joints than this determined by the views are not a person that can be placed in space."""

    def __post_init__(self) -> None:
        for name in ("alternations", "max_sigma_m", "disagreement", "min_joints"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.settled_m < 0:
            raise ValueError(f"settled_m must not be negative, got {self.settled_m}")


@dataclass(frozen=True)
class Refined:
    """P people after stage II."""

    joints: NDArray[np.float64]
    """(P, J, 3) X, metres in the world; NaN where unknown."""
    covariance: NDArray[np.float64]
    """(P, J, 3, 3) marginal covariance of each joint, m²; NaN where unknown."""
    confidence: NDArray[np.float64]
    """(P, J) w_i of Eq. 4, mean confidence over all views of the observations that were kept."""
    inlier: NDArray[np.bool_]
    """(P, J, V) delta_ij of Eq. 2: which observations were kept."""
    fit: BodyFit
    """Theta: the bodies, P rows."""
    status: NDArray[np.str_]
    """(P,) a `Status` each."""


def refine(
    observations: Observations,
    rig: Rig,
    fitter: BodyFitter,
    observation_config: ObservationConfig,
    graph_config: PersonGraphConfig,
    config: RefineConfig,
    *,
    person: NDArray[np.intp],
    frame: NDArray[np.intp],
    extra_factors: ExtraFactors | None = None,
) -> Refined:
    """Refine P people, of one frame or of many: `person` (P,) and `frame` (P,) name them in the keys.

    In each round the body is fitted to what the views alone say of all joints, and then pulls the joints of low
    confidence. What it says of a joint leaves that joint's own views out (`BodyFit.prior_xyz`), so that nothing
    is counted twice and the covariances stay honest.
    """
    sigmas = observation_sigmas(observations, observations.initial, rig, observation_config)
    X = triangulate(observations, rig, sigmas, observation_config).copy()
    graphs = _graphs(observations, sigmas, rig, observation_config, graph_config, person, frame, extra_factors)
    inlier, confidence = np.zeros(sigmas.shape, dtype=bool), np.zeros(X.shape[:2])
    enough = np.zeros(len(X), dtype=bool)
    fit = BodyFit.failed(np.full(len(X), FitStatus.TOO_FEW_JOINTS), X.shape[1])
    moving = np.arange(len(X))
    for n in range(config.alternations):
        observed, sigma, start = observations.rows(moving), sigmas[moving], X[moving]
        evidence = weigh(observed, sigma, start, rig, observation_config)
        if n == 0:
            enough = _placed(evidence, config).sum(axis=1) >= config.min_joints
        body = fitter.fit(joint_targets(evidence, enough[moving]), fit.rows(moving))  # the Theta step
        fitted = evidence.target
        wrong = disagreement(evidence, body) > config.disagreement
        if wrong.any():
            there = np.where(wrong[..., None], body.prior_xyz, start)
            evidence = weigh(observed, sigma, there, rig, observation_config)
        confidence[moving] = mean_confidence(observed, evidence.inlier)
        pulled = _pulled(evidence, body, confidence[moving], config, graph_config)
        X[moving] = _solve([graphs[row] for row in moving], evidence, pulled, body, config)
        inlier[moving], fit = evidence.inlier, fit.with_rows(moving, body)
        # Settled: the body was fitted to where the joints are now, and pulled joints stay where they were.
        before = np.where((pulled | wrong)[..., None], start, fitted)
        shift = np.linalg.norm(X[moving] - before, axis=-1)
        unknown = np.isnan(X[moving]).any(axis=-1)
        moving = moving[~((shift < config.settled_m) | unknown).all(axis=1)]
        if len(moving) == 0:
            break
    covariance = np.stack([graph.covariance() for graph in graphs]) if graphs else np.zeros((*X.shape, 3))
    status = np.where(fit.ok, Status.OK, np.where(enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS))
    return Refined(X, covariance, confidence, inlier, fit, status)


def _graphs(
    observations: Observations,
    sigmas: NDArray[np.float64],
    rig: Rig,
    observation_config: ObservationConfig,
    graph_config: PersonGraphConfig,
    person: NDArray[np.intp],
    frame: NDArray[np.intp],
    extra_factors: ExtraFactors | None,
) -> list[PersonGraph]:
    """One graph per person, with the user's factors in it."""
    cameras = make_cameras(rig)
    graphs = []
    for row in range(len(observations)):
        graph = PersonGraph(
            cameras,
            observations.xy[row],
            sigmas[row],
            graph_config,
            observation_config.kernel,
            person=int(person[row]),
            frame=int(frame[row]),
        )
        for factor in extra_factors(graph) if extra_factors is not None else ():
            graph.add(factor)
        graphs.append(graph)
    return graphs


def _placed(evidence: Evidence, config: RefineConfig) -> NDArray[np.bool_]:
    """(P, J) whether the views alone determine a joint: the rank check that the solver does not make."""
    information = evidence.information.reshape(-1, 3, 3)
    return determined(information, max_sigma_m=config.max_sigma_m).reshape(evidence.points.shape[:2])


def disagreement(evidence: Evidence, fit: BodyFit) -> NDArray[np.float64]:
    """How far (P, J) each joint's views put it from where the rest of the body puts it, in standard deviations.

    The distance between the two, measured against the sum of their covariances; where the views leave a
    direction open, they cannot disagree in it. 0 for people without a body.
    """
    apart = np.nan_to_num(evidence.target - fit.prior_xyz)
    body = np.where(fit.ok[:, None, None, None], fit.prior_covariance, np.eye(3))
    # (L^-1 + C)^-1 = L (I + C L)^-1, which holds for information L that is singular, too.
    information = evidence.information
    weight = information @ np.linalg.inv(np.eye(3) + body @ information)
    squared = np.einsum("...i,...ij,...j->...", apart, weight, apart)
    return np.where(fit.ok[:, None], np.sqrt(np.maximum(squared, 0.0)), 0.0)


def joint_targets(evidence: Evidence, enough: NDArray[np.bool_]) -> JointTargets:
    """What the body is fitted to: what the views say of all joints, of people whom they determine (`enough`)."""
    information = np.where(enough[:, None, None, None], evidence.information, 0.0)
    return JointTargets(np.nan_to_num(evidence.target), information)


def _pulled(
    evidence: Evidence,
    fit: BodyFit,
    confidence: NDArray[np.float64],
    config: RefineConfig,
    graph_config: PersonGraphConfig,
) -> NDArray[np.bool_]:
    """(P, J) which joints the body pulls: delta of Eq. 4, and joints that their views do not determine.

    The latter need the body however sure their one view is.
    """
    return ((confidence < graph_config.rho_3d) | ~_placed(evidence, config)) & fit.ok[:, None]


def _solve(
    graphs: list[PersonGraph],
    evidence: Evidence,
    pulled: NDArray[np.bool_],
    fit: BodyFit,
    config: RefineConfig,
) -> NDArray[np.float64]:
    """The X step for every person: (P, J, 3)."""
    placed = _placed(evidence, config)
    solved = placed | pulled
    start = np.where(placed[..., None], evidence.points, np.where(pulled[..., None], fit.prior_xyz, np.nan))
    X = np.full(evidence.points.shape, np.nan)
    for row, graph in enumerate(graphs):
        graph.set_gates(evidence.inlier[row] & solved[row, :, None])
        graph.set_priors(pulled[row], fit.prior_xyz[row], fit.prior_covariance[row])
        X[row] = graph.solve(start[row])
    return X
