"""The body fitter: validates targets and fits bodies to them, with or without the network."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapepose_fg.body.fitting.energy import BATCH, BodyEnergy, EnergyTargets, Evaluated
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    BodyFit,
    BodyFitter,
    FitStatus,
    JointTargets,
)
from shapepose_fg.body.fitting.optimisers import LevenbergMarquardt, NetworkDescent
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.rows import Rows

_CONVERGED = 9.0
"""Without a network: maximum decrease of the energy that a Newton step predicts for a converged row
(3 sigma of the posterior). With a network, `BodyConfig.unfinished` is used after the plain
optimiser."""
_SPREAD = {"RWrist": 2.0, "LWrist": 2.0}
"""Factors on the variance of joints without a target. Elbows bend farther from their mean
than a Gaussian predicts: without them, 85 % of the wrists of the validation subjects
(training.motions) lie in their 90 % ellipsoids."""


def make_fitter(
    config: BodyConfig | None = None,
    model: BodyModel | None = None,
) -> "SmplFitter":
    """The fitter for `config`, on `model` or the body of the package.

    Raises InputError if the network is requested and its weights are missing or for another body.
    """
    config = BodyConfig() if config is None else config
    model = BodyModel.default() if model is None else model
    if config.method == "plain":
        return SmplFitter(model, config=config)
    weights = (
        FitterWeights.load(Path(config.weights)) if config.weights else FitterWeights.of(model)
    )
    if config.method == "auto" and not config.weights and fingerprint(model) != weights.body:
        return SmplFitter(model, config=config)
    return SmplFitter(model, config=config, weights=weights)


class SmplFitter(BodyFitter):
    """Fits a body to 3D joints by learned gradient descent, or without `weights` by
    Levenberg-Marquardt.

    Rows are independent. Rows that do not converge with the network and a short polish are fitted
    by Levenberg-Marquardt. All but the network's layers is computed in double precision.
    """

    model: BodyModel

    def __init__(
        self,
        model: BodyModel | None = None,
        pose_prior: PosePrior | None = None,
        config: BodyConfig | None = None,
        weights: FitterWeights | None = None,
    ):
        self.model = BodyModel.default() if model is None else model
        self.prior = PosePrior.default() if pose_prior is None else pose_prior
        self.config = config = BodyConfig() if config is None else config
        self.weights = weights
        """Weights of the network; None: no network is used."""
        self.energy = BodyEnergy(self.model, self.prior)
        plain = LevenbergMarquardt(self.energy, self.prior, config.kernel_scale)
        names = self.model.keypoint_names
        if weights is None:
            self.optimiser, self._fallback, self._unfinished = plain, None, _CONVERGED
            self._spread = np.array([_SPREAD.get(name, 1.0) for name in names])
        else:
            weights.check(self.model)
            self.optimiser = NetworkDescent(
                self.energy, weights, config.kernel_scale, config.polish_steps
            )
            self._fallback, self._unfinished, self._spread = (
                plain,
                config.unfinished,
                weights.spread_of(names),
            )

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "SmplFitter":
        """Return a fitter for a detector whose joints have these offsets from the body's."""
        model = self.model.with_keypoint_offsets(offsets)
        return SmplFitter(model, self.prior, self.config, self.weights)

    def fit(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """Fit a body to every row of `targets`; see `BodyFit` for the result.

        OK rows of `initial` are warm starts of Levenberg-Marquardt, without closed form and
        annealing. The network ignores them: its result depends on the targets only.
        """
        count = len(self.model.keypoint_names)
        if targets.xyz.shape[1] != count:
            raise ValueError(
                f"targets must be the {count} keypoints of the body, got {targets.xyz.shape[1]}"
            )
        if initial is not None and len(initial) != len(targets):
            raise ValueError(
                f"initial must have one row per target: {len(targets)}, got {len(initial)}"
            )
        evidence = weigh(targets, self.config.model_sigma_m)
        fit = BodyFit.failed(evidence.status, count)
        rows = np.flatnonzero(evidence.status == FitStatus.OK)
        if len(rows) == 0:
            return fit
        evidence = evidence.rows(rows)
        start = None if initial is None else self._start(initial.rows(rows), evidence.centre)
        found = self._fitted(evidence, start)
        done = found.left < self._unfinished  # false for NaN
        done &= np.isfinite(found.xyz).all(axis=(1, 2))
        done &= np.isfinite(found.covariance).all(axis=(1, 2, 3))
        fit.status[rows[~done]] = FitStatus.NOT_CONVERGED
        rows, evidence, found = rows[done], evidence.rows(done), found.rows(done)
        fit.put_bodies(rows, self.energy.complete(found.free), evidence.centre)
        fit.joints[rows] = found.xyz + evidence.centre[:, None]
        unseen = np.all(evidence.information == 0, axis=(-1, -2))[..., None, None]
        wider = np.where(unseen, self._spread[:, None, None], 1.0)
        fit.covariance[rows] = wider * found.covariance
        fit.residual_m[rows] = np.sqrt(found.squared.sum(axis=1) / evidence.total_information)
        return fit

    def _fitted(self, evidence: Evidence, start: Array | None = None) -> "JointPosterior":
        """Posteriors of R rows relative to `evidence.centre`. Rows begin at `start` (R, P) where
        the optimiser can.

        Each row separately: the choice of optimiser does not depend on the targets of another one.
        """
        parts = list[JointPosterior]()
        # Number of rows per batch of the network.
        for some in _parts(len(evidence.xyz), 128):
            targets, variance = _relative(evidence.rows(some))
            free, held = self.optimiser.arrive(
                targets, variance, None if start is None else start[some]
            )
            for near in _parts(len(free), BATCH):
                given = targets.rows(near)
                part = JointPosterior.of(
                    self.optimiser.evaluated(free[near], given, held.rows(near))
                )
                unsettled = np.flatnonzero(~(part.left < self._unfinished))  # true for NaN
                if self._fallback is not None and len(unsettled) > 0:
                    again = given.rows(unsettled)
                    arrived, usual = self._fallback.arrive(again, variance[near][unsettled])
                    body = self._fallback.evaluated(arrived, again, usual)
                    part.put(unsettled, JointPosterior.of(body))
                parts.append(part)
        return JointPosterior.concatenate(parts)

    def _start(self, initial: BodyFit, centre: Array) -> Array:
        """Free parameters (R, P) of bodies relative to the origins (R, 3); NaN where there is no
        body.
        """
        start = self.energy.parameters(initial, centre)
        start[~initial.ok] = np.nan
        return start


@dataclass(frozen=True)
class JointPosterior(Rows):
    """Posterior of the bodies of B rows."""

    free: Array
    """(B, P) parameters of the body."""
    xyz: Array
    """(B, J, 3) joints, metres."""
    covariance: Array
    """(B, J, 3, 3) covariances of the joints, m² (Laplace)."""
    squared: Array
    """(B, J) squared Mahalanobis distance of each joint to its target."""
    left: Array
    """(B,) predicted decrease of the energy by a further Newton step."""

    @classmethod
    def of(cls, body: Evaluated) -> "JointPosterior":
        """The posterior of evaluated bodies, with systems for all joints."""
        return cls(body.free, body.xyz, body.covariances()[0], body.squared, body.left)


def _parts(count: int, size: int) -> list[slice]:
    """Rows in parts of at most `size`."""
    return [slice(at, min(at + size, count)) for at in range(0, count, size)]


def _relative(evidence: Evidence) -> tuple[EnergyTargets, Array]:
    """Targets relative to the centres of their rows, and the variance of each (B, J)."""
    xyz = evidence.xyz - evidence.centre[:, None]
    return EnergyTargets(xyz, evidence.information), evidence.variance_m2
