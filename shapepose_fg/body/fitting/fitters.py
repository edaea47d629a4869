"""The body fitter: validates targets, runs all passes, pools shapes, and fits again; with or
without the network.
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.body.fitting.body_sequence import SequenceFitter
from shapepose_fg.body.fitting.energy import BodyEnergy, Held, nothing
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    BodyFit,
    BodyFitter,
    FitStatus,
    JointTargets,
    SequenceFit,
    Shapes,
    check_groups,
)
from shapepose_fg.body.fitting.left_out import Passes, left_out_sets
from shapepose_fg.body.fitting.optimisers import LevenbergMarquardt, NetworkDescent
from shapepose_fg.body.fitting.posterior import JointPosterior, pooled_betas, shared
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.sizes import Sizes
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.arrays import Array, Index, Mask

_CHUNK = 64
"""Number of rows per batch of fits; their Hessians fit into the cache, and memory is bounded."""
_ARRIVE = 128
"""Number of rows per batch of the network."""
_VOTERS = 24
"""Maximum number of rows that determine a group's shape; errors within seconds are correlated, so
more add no information."""
_CONVERGED = 9.0
"""Without a network: maximum decrease of the energy that a Newton step predicts for a converged row
(3 sigma of the posterior). With a network, `BodyConfig.unfinished` is used after the plain
optimiser."""
_ROUNDS = 2
"""Number of fits at an adult's size; the first estimate of the size is biased by the prior of
adults."""
_SPREAD = {"RWrist": 2.0, "LWrist": 2.0}
"""Factors on the variance of joints without their own target. Elbows bend farther from their mean
than a Gaussian predicts: without them, 85 % of the wrists of the validation subjects
(training.motions) lie in their 90 % ellipsoids."""


def make_fitter(
    config: BodyConfig | None = None,
    model: BodyModel | None = None,
    law: Motion = CONSTANT_VELOCITY,
) -> "SmplFitter":
    """The fitter for `config`, on `model` or the body of the package; `law` is the motion model
    over time.

    Raises InputError if the network is requested and its weights are missing or for another body.
    """
    config = BodyConfig() if config is None else config
    model = BodyModel.default() if model is None else model
    if config.method == "plain":
        return SmplFitter(model, config=config, law=law)
    weights = (
        FitterWeights.load(Path(config.weights)) if config.weights else FitterWeights.of(model)
    )
    if config.method == "auto" and not config.weights and fingerprint(model) != weights.body:
        return SmplFitter(model, config=config, law=law)
    return SmplFitter(model, config=config, weights=weights, law=law)


class SmplFitter(BodyFitter):
    """Fits a body to 3D joints by learned gradient descent, or without `weights` by
    Levenberg-Marquardt.

    Rows are independent except for the common shape of a group. Rows that do not converge with the
    network and a short polish are fitted by Levenberg-Marquardt, with a shape of their own. All but
    the network's layers is computed in double precision.
    """

    model: BodyModel

    def __init__(
        self,
        model: BodyModel | None = None,
        pose_prior: PosePrior | None = None,
        config: BodyConfig | None = None,
        weights: FitterWeights | None = None,
        law: Motion = CONSTANT_VELOCITY,
    ):
        self.model = BodyModel.default() if model is None else model
        self.prior = PosePrior.default() if pose_prior is None else pose_prior
        self.config = config = BodyConfig() if config is None else config
        self.law = law
        """Motion model of bodies over time."""
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

    @cached_property
    def sets(self) -> Index:
        """(J,) number of the leave-one-out set of each joint."""
        return left_out_sets(self.energy, self.prior)

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "SmplFitter":
        """Return a fitter for a detector whose joints have these offsets from the body's."""
        model = self.model.with_keypoint_offsets(offsets)
        return SmplFitter(model, self.prior, self.config, self.weights, self.law)

    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: Index | None = None
    ) -> BodyFit:
        """Fit a body to every row of `targets`; see `BodyFit` for the result.

        OK rows of `initial` are warm starts of Levenberg-Marquardt, without closed form and
        annealing; leave-one-out passes start cold. The network ignores them: its result depends on
        the targets only.
        """
        return self._fit(targets, initial, groups, leave_out=True)

    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """Fit as `fit` does in a fraction of the time; `prior_xyz` and `prior_covariance` are
        NaN.
        """
        fit = self._fit(targets, initial, None, leave_out=False)
        fit.prior_xyz[:], fit.prior_covariance[:] = np.nan, np.nan
        return fit

    def fit_sequence(
        self,
        targets: JointTargets,
        groups: Index,
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
        faster: Array | None = None,
    ) -> SequenceFit:
        """See `BodyFitter`; people far from adults' size are fitted at that size first
        (`sizes`).
        """
        sequence = SequenceFitter(self.energy, self._starts, self.law, self.config)
        found = sequence.fit(
            targets, groups, time_s, shapes, fixed_shapes=fixed_shapes, faster=faster
        )
        sizes = Sizes.of(self.model)
        far = sizes.far(found.shapes.mean)
        if shapes is not None or not far.any():
            return found
        rows = np.flatnonzero(np.isin(groups, found.groups[far]))
        own, groups, time_s = targets.rows(rows), groups[rows], time_s[rows]
        faster = None if faster is None else faster[rows]
        whose = np.unique(groups, return_inverse=True)[1]
        mean, information = found.shapes.mean.copy(), found.shapes.information
        for _ in range(_ROUNDS):
            size = sizes.ratio(mean[far])
            adult = sequence.fit(own.larger(1 / size[whose]), groups, time_s, faster=faster)
            mean[far] = sizes.resized(self.model, adult.shapes.mean, size)
        again = sequence.fit(
            own,
            groups,
            time_s,
            Shapes(mean[far], information[far]),
            fixed_shapes=True,
            faster=faster,
        )
        return SequenceFit(
            found.fit.with_rows(rows, again.fit), found.groups, Shapes(mean, information)
        )

    def _fit(
        self,
        targets: JointTargets,
        initial: BodyFit | None,
        groups: Index | None,
        *,
        leave_out: bool,
    ) -> BodyFit:
        """Fit a body to every row, with or without the leave-one-out passes."""
        count = len(self.model.keypoint_names)
        if targets.xyz.shape[1] != count:
            raise ValueError(
                f"targets must be the {count} keypoints of the body, got {targets.xyz.shape[1]}"
            )
        if initial is not None and len(initial) != len(targets):
            raise ValueError(
                f"initial must have one row per target: {len(targets)}, got {len(initial)}"
            )
        groups = np.arange(len(targets)) if groups is None else check_groups(groups, len(targets))
        evidence = weigh(targets, self.config.model_sigma_m)
        fit = BodyFit.failed(evidence.status, count)
        rows = np.flatnonzero(evidence.status == FitStatus.OK)
        if len(rows) == 0:
            return fit
        evidence, groups = evidence.rows(rows), groups[rows]
        start = None if initial is None else self._start(initial.rows(rows), evidence.centre)
        passes = (
            Passes.of(evidence, self.sets, groups) if leave_out else Passes.whole(evidence, groups)
        )
        votes = passes.votes & evenly(groups, _VOTERS)[passes.row]
        self._fill(fit, rows, passes, self._posterior(replace(passes, votes=votes), start))
        return fit

    def _posterior(self, passes: Passes, start: Array | None) -> list[JointPosterior]:
        """Posteriors of all passes (M), in order, in parts."""
        free, held = self._arrive(passes, start)
        fitted = self.optimiser.evaluated
        if shared(passes.pool, passes.votes).any():
            fitted = self.optimiser.again
            free, held = self._one_shape(passes, free, held)
        parts: list[JointPosterior] = []
        for index in passes.chunks(_CHUNK):
            asked = passes.asked(index)
            body = fitted(free[index], passes.given(index)[0], held.rows(index), asked)
            part = JointPosterior.of(body)
            # Each pass separately: the choice of optimiser must not depend on the targets of
            # another pass.
            unsettled = np.flatnonzero(~(part.left < self._unfinished))  # true for NaN
            if self._fallback is not None and len(unsettled) > 0:
                (targets, variance), asked = passes.given(index[unsettled]), asked[unsettled]
                arrived, by_priors = self._fallback.arrive(targets, variance)
                body = self._fallback.evaluated(arrived, targets, by_priors, asked)
                part.put(unsettled, JointPosterior.of(body))
            parts.append(part)
        return parts

    def _arrive(self, passes: Passes, start: Array | None) -> tuple[Array, Held]:
        """Initial parameters of passes (M, P), relative to the centres of their rows, and their
        priors. Only passes with all targets may begin at `start` (R, P): an earlier body has used
        the targets that others leave out.
        """
        found = []
        for index in passes.chunks(_ARRIVE):
            first = None if start is None or index[0] >= len(start) else start[index]
            found.append(self.optimiser.arrive(*passes.given(index), first))
        held = zip(*(vars(each).values() for _, each in found), strict=True)
        return np.concatenate([free for free, _ in found]), Held(*map(np.concatenate, held))

    def _one_shape(self, passes: Passes, free: Array, held: Held) -> tuple[Array, Held]:
        """Return initial parameters and priors of passes (M) with one shape per pool.

        The passes that contribute are first fitted independently.
        """
        free, precision, settled = (
            free.copy(),
            np.zeros((len(free), 10, 10)),
            np.zeros(len(free), dtype=bool),
        )
        for index in _parts(np.flatnonzero(passes.votes), _CHUNK):
            targets, none = passes.given(index)[0], nothing(len(index))
            body = self.optimiser.evaluated(free[index], targets, held.rows(index), none)
            free[index], settled[index] = body.free, body.left < self._unfinished
            precision[index] = np.linalg.inv(body.covariances()[1])
        agreed = shared(passes.pool, settled)
        betas = pooled_betas(free[:, :10], precision, passes.pool, settled, held)
        return np.concatenate((betas, free[:, 10:]), 1), held.at_shape(betas, agreed)

    def _fill(self, fit: BodyFit, rows: Index, passes: Passes, parts: list[JointPosterior]) -> None:
        """Fill `fit`'s `rows` (R,) with the results of the passes.

        Rows that have not converged, or are not finite, become NOT_CONVERGED.
        """
        wider, evidence, chunks = (
            self._spread[:, None, None],
            passes.evidence,
            passes.chunks(_CHUNK),
        )
        whole = [part for part, index in zip(parts, chunks, strict=True) if index[0] < len(rows)]
        found = JointPosterior.concatenate(whole)
        unseen = np.all(evidence.information == 0, axis=(-1, -2))[..., None, None]
        prior_xyz, prior_covariance = found.xyz.copy(), found.covariance.copy()
        for part, index in zip(parts[len(whole) :], chunks[len(whole) :], strict=True):
            asked = passes.asked(index)
            left_out = np.take_along_axis(
                passes.without[index], asked, axis=1
            )  # smaller sets are padded
            into = np.broadcast_to(passes.row[index, None], asked.shape)[left_out], asked[left_out]
            prior_xyz[into] = np.take_along_axis(part.xyz, asked[..., None], axis=1)[left_out]
            prior_covariance[into] = part.covariance[left_out]
        done = found.left < self._unfinished  # false for NaN
        done &= np.isfinite(prior_xyz).all(axis=(1, 2)) & np.isfinite(prior_covariance).all(
            axis=(1, 2, 3)
        )
        fit.status[rows[~done]] = FitStatus.NOT_CONVERGED
        rows, origin = rows[done], evidence.centre[done]
        fit.put_bodies(rows, self.energy.complete(found.free[done]), origin)
        fit.joints[rows] = found.xyz[done] + origin[:, None]
        fit.covariance[rows] = np.where(unseen, wider * found.covariance, found.covariance)[done]
        fit.prior_xyz[rows] = prior_xyz[done] + origin[:, None]
        fit.prior_covariance[rows] = wider * prior_covariance[
            done
        ] + self.config.model_sigma_m**2 * np.eye(3)
        fit.residual_m[rows] = np.sqrt(found.squared.sum(axis=1) / evidence.total_information)[done]

    def _starts(self, evidence: Evidence) -> tuple[Array, Array, Mask]:
        """Fit rows (R) with all their targets and a shape of their own.

        Returns parameters (R, P) relative to `evidence.centre`, the centres of the pose prior (R,
        A), and a mask (R,) of converged rows.
        """
        passes = Passes.whole(evidence, np.arange(len(evidence.xyz)))
        free, held = self._arrive(passes, None)
        done = np.zeros(len(free), dtype=bool)
        for part in passes.chunks(_CHUNK):
            body = self.optimiser.evaluated(
                free[part], passes.given(part)[0], held.rows(part), nothing(len(part))
            )
            free[part], done[part] = body.free, body.left < self._unfinished
        unsettled = np.flatnonzero(~done)
        if self._fallback is not None and len(unsettled) > 0:
            targets, variance = passes.given(unsettled)
            found, by_priors = self._fallback.arrive(targets, variance)
            body = self._fallback.evaluated(found, targets, by_priors, nothing(len(unsettled)))
            free[unsettled], done[unsettled] = body.free, body.left < self._unfinished
            held.angles[unsettled] = body.free[:, 13:-3]
        return free, held.angles, done

    def _start(self, initial: BodyFit, centre: Array) -> Array:
        """Free parameters (R, P) of bodies relative to the origins (R, 3); NaN where there is no
        body.
        """
        start = self.energy.parameters(initial, centre)
        start[~initial.ok] = np.nan
        return start


def _parts(rows: Index, size: int) -> list[Index]:
    """Row indices in parts of at most `size`."""
    return [rows[at : at + size] for at in range(0, len(rows), size)]


def evenly(groups: Index, count: int) -> Mask:
    """(R,) mask of at most `count` rows of each group (R,), evenly spread."""
    order = np.argsort(groups, kind="stable")
    _, first, size = np.unique(groups[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, size)
    number = rank * count // np.maximum(np.repeat(size, size), count)
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order] = (rank == 0) | (np.diff(number, prepend=0) != 0)
    return chosen
