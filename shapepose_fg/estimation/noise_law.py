"""A detector's noise law: the distribution of its keypoint errors by score.

The law is learnt from the recording itself, without ground truth. Each keypoint of a person in one
view is compared with the position triangulated from confident detections of the other views.
Keypoints that the solver rejected are compared too, since gates have removed the large errors of
the others. The prior is the law shipped with the package (`covariances.json`), so a short recording
changes it little.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.shipped_numbers import shipped_numbers
from shapepose_fg.core.storage.files import read_json
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    inverses,
    linearise,
    observation_sigmas,
    triangulate,
)
from shapepose_fg.estimation.in_time import KNOWN_M

EDGES = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9)
"""Bounds between the K = 7 ranges of scores. Relative to the shipped law, a law is constant in
each."""
GROSS_M = 0.2
"""Standard deviation of a gross error along an axis, m. It lies on another joint or person."""
_GOOD_SCORE = 0.5
"""Minimum score of a detection in another view to be used for triangulation."""
_AGREE_SIGMA = 3.5
"""Maximum residual of each triangulated detection, standard deviations. Above it, they disagree."""
_PRIOR_COUNT = 30.0
"""Weight of the shipped law in each range of scores, as a number of detections."""
_ROUNDS = 40
"""Number of iterations of expectation maximisation."""


@dataclass(frozen=True)
class NoiseLaw:
    """Error distribution in K ranges of scores: a Gaussian core and a share of gross errors."""

    times: tuple[float, ...]
    """(K,) standard deviation of the core, as a multiple of that of Eq. 1's weights
    (`core_sigma_m`)."""
    gross: tuple[float, ...]
    """(K,) share of gross errors, 0 to 1."""
    count: tuple[int, ...] = (0,) * (len(EDGES) + 1)
    """(K,) number of detections from which the law was learnt; 0 in the shipped law."""
    COLUMNS: ClassVar = ("times", "gross", "count")

    def __post_init__(self) -> None:
        for name in self.COLUMNS:
            values = getattr(self, name)
            most = 1.0 if name == "gross" else 1e9
            if len(values) != len(EDGES) + 1 or not all(0 <= each <= most for each in values):
                raise ValueError(
                    f"{name} must be {len(EDGES) + 1} numbers, 0 to {most:g}, got {values}"
                )
        if min(self.times) <= 0:
            raise ValueError(f"times must be above 0, got {self.times}")

    @classmethod
    @cache
    def shipped(cls) -> "NoiseLaw":
        """The mean law of simulated recordings (`scripts/fit_covariances.py`)."""
        return cls.from_dict(shipped_numbers("estimation", "covariances")["noise"])

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "NoiseLaw":
        """The law from the result of `as_dict`; KeyError, TypeError or ValueError for other
        content.
        """
        times, gross, count = (content[name] for name in cls.COLUMNS)
        return cls(tuple(map(float, times)), tuple(map(float, gross)), tuple(map(int, count)))

    @classmethod
    def load(cls, path: str | Path) -> "NoiseLaw":
        """The law in a run.json, or the shipped law if it has none. InputError if the law is
        damaged.
        """
        return cls.read(read_json(Path(path)), Path(path))

    @classmethod
    def read(cls, run: Any, path: Path) -> "NoiseLaw":
        """The law in `run`, the content of the run.json at `path`; otherwise as `load`."""
        saved = run.get("noise_law") if isinstance(run, dict) else None
        try:
            return cls.shipped() if saved is None else cls.from_dict(saved)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{path}: noise_law is damaged ({error}); reconstruct the recording again"
            ) from None

    def as_dict(self) -> dict[str, Any]:
        """The law as JSON values, with the score and sigma of each range for readers of
        run.json.
        """
        bounds = np.array([0.0, *EDGES, 1.0])
        score = ((bounds[1:] + bounds[:-1]) / 2).round(2)
        return {
            "score": score.tolist(),
            "sigma_mm": (1e3 * np.array(self.times) * core_sigma_m(score)).round(1).tolist(),
            **{name: list(getattr(self, name)) for name in self.COLUMNS},
        }

    def ratios(self, scores: Array) -> Array:
        """Variances (...) of the cores of detections with these `scores` (...), relative to those
        of the shipped law.
        """
        core = np.square(np.divide(self.times, self.shipped().times))
        return core[np.digitize(scores, EDGES)]

    def typical(self, scores: Array) -> float:
        """Standard deviation of detections with these `scores` (N,), relative to the shipped law's;
        at least 1.
        """
        return max(1.0, float(np.sqrt(self.ratios(scores).mean()))) if len(scores) > 0 else 1.0


def core_sigma_m(scores: Array | float, config: ObservationConfig | None = None) -> Array:
    """(...) standard deviation that Eq. 1 assumes for detections with these `scores` (...), m.

    It is that of the mean joint, and infinite where a score has no weight.
    """
    config = ObservationConfig() if config is None else config
    with np.errstate(divide="ignore"):
        return config.sigma_m / np.sqrt(config.weight(np.asarray(scores, dtype=np.float64)))


@dataclass(frozen=True)
class Residuals:
    """Residuals of R detections to their joints, triangulated from the other views."""

    score: Array
    """(R,) score of the detection."""
    scatter: Array
    """(R,) standard deviation of the detection by Eq. 1's weights, at the depth of the joint, m."""
    squared: Array
    """(R, 2) squared residuals along the principal axes of the triangulated covariance, m²."""
    others: Array
    """(R, 2) variances of the triangulated position along its principal axes by Eq. 1, ascending,
    m²."""
    of_others: Array
    """(R, V) scores of the triangulated detections in the other views; 0 for none."""

    @classmethod
    def of(
        cls,
        chosen: Observations,
        every: Observations,
        views: Views,
        config: ObservationConfig,
        joints: Sequence[str],
    ) -> "Residuals":
        """Residuals of N rows, one for each person in a frame.

        `chosen` has the detections assigned to the person. `every` has all keypoints of the 2D
        people to which these belong.
        """
        parts, scatter = [], config.scatter(joints)
        for view in range(len(views)):
            good = chosen.seen & (chosen.confidence >= _GOOD_SCORE)
            good[..., view] = False
            good &= (good.sum(axis=-1) >= 2)[..., None]
            nowhere = np.full(chosen.initial.shape, np.nan)
            rows = replace(
                chosen, confidence=np.where(good, chosen.confidence, 0.0), initial=nowhere
            )
            points = triangulate(rows, views, config)
            sigmas = observation_sigmas(rows, points, views, config, joints)
            evidence = linearise(rows, sigmas, points, views, config)
            evidence = linearise(rows, sigmas, evidence.target, views, config)
            off = np.nan_to_num(np.linalg.norm(evidence.residual_px, axis=-1)) / np.where(
                good, sigmas, 1.0
            )
            agree = (evidence.inlier == good).all(axis=-1) & (off < _AGREE_SIGMA).all(axis=-1)
            agree &= every.seen[..., view] & (evidence.sigma_m < KNOWN_M)
            row, joint = np.nonzero(agree)
            xy, depth, slope = views.rows(row).project(evidence.target[agree][:, None])
            focal = np.broadcast_to(views.focal_px, (len(chosen), len(views)))[row, view]
            length = depth[:, 0, view] / focal
            off_m = length[:, None] * (xy[:, 0, view] - every.xy[agree][:, view])
            slope = length[:, None, None] * slope[:, 0, view]
            covariance = slope @ inverses(evidence.information[agree]) @ slope.mT
            variance, whole = np.linalg.eigvalsh(covariance), np.square(off_m).sum(axis=1)
            along = np.einsum("ni,nij,nj->n", off_m, covariance, off_m) - variance[:, 0] * whole
            second = np.clip(along / np.maximum(np.ptp(variance, axis=1), 1e-12), 0.0, whole)
            squared = np.column_stack([whole - second, second])
            score = every.confidence[agree][:, view]
            known = np.isfinite(squared + variance).all(axis=1)
            columns = (
                score,
                core_sigma_m(score, config) * scatter[joint],
                squared,
                variance,
                rows.confidence[agree],
            )
            parts.append([column[known] for column in columns])
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def law(self, prior: NoiseLaw | None = None) -> NoiseLaw:
        """The most probable law with this `prior` (default: the shipped law).

        It is found by expectation maximisation.
        """
        prior = NoiseLaw.shipped() if prior is None else prior
        score, seen = np.digitize(self.score, EDGES), self.of_others > 0
        of_others = np.digitize(self.of_others, EDGES)

        def total(values: Array) -> Array:
            return np.bincount(score, values, len(EDGES) + 1).astype(np.float64)

        count, expected = total(np.ones(len(score))), np.square(prior.times)
        squared_times, gross = expected, np.array(prior.gross)
        for _ in range(_ROUNDS):
            of_views = np.where(seen, squared_times[of_others], 0.0).sum(axis=1) / np.maximum(
                seen.sum(axis=1), 1
            )
            others, own = (
                self.others * of_views[:, None],
                (squared_times[score] * self.scatter**2)[:, None],
            )
            likely = [
                -0.5 * (self.squared / variance + np.log(variance)).sum(axis=1)
                for variance in (others + own, others + own + GROSS_M**2)
            ]
            odds = gross[score] / np.maximum(1 - gross[score], 1e-9)
            core = 1 / (1 + odds * np.exp(np.clip(likely[1] - likely[0], -50.0, 50.0)))
            # Expected square of the error of the detection itself, which is part of the residual.
            share = own / (others + own)
            error = (share**2 * self.squared + share * others).mean(axis=1) / self.scatter**2
            squared_times = (_PRIOR_COUNT * expected + total(core * error)) / (
                _PRIOR_COUNT + total(core)
            )
            gross = (_PRIOR_COUNT * np.array(prior.gross) + total(1 - core)) / (
                _PRIOR_COUNT + count
            )
        # Rounded as in run.json, from which a later run reads the law.
        times, gross = np.sqrt(squared_times).round(4), gross.round(4)
        return NoiseLaw(
            tuple(times.tolist()), tuple(gross.tolist()), tuple(count.astype(int).tolist())
        )
