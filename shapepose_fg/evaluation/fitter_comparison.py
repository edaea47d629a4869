"""Body fitters compared on bodies that are known, their joints made worse step by step.

In poses of people whom nothing was learnt from or chosen on (`training.split`, "test"), the same targets for every
fitter. Times are of whole fits (evidence, start, steps, covariances), and the processor's: of one thread.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.errors import InputError
from shapepose_fg.evaluation.fitting import (
    SETTINGS,
    Corruption,
    FitErrors,
    TrueBodies,
    corrupt,
    fit_errors,
    true_bodies,
)
from shapepose_fg.evaluation.fitting_methods import (
    Curve,
    Method,
    curve,
    learned_methods,
    plain_methods,
    timed_fit,
)
from shapepose_fg.simulation.sequences import DANCERS
from shapepose_fg.simulation.training.motions import load_motions

BODIES = 2048
"""Half of them dance salsa, half are everybody else of the test subjects."""
CURVE_BODIES = 512
BATCH, LARGE_BATCH = 64, 128
ALONE = 12
"""How many single fits are timed."""


@dataclass(frozen=True)
class Outcome:
    """What one fitter made of one kind of targets."""

    fit: BodyFit
    """All rows."""
    errors: FitErrors
    """Against the truth."""
    ms_batch: NDArray[np.float64]
    """Milliseconds a fit, in batches of 64: one value for each batch."""
    ms_alone: NDArray[np.float64]
    """Milliseconds for single rows."""


class Comparison:
    """All fitters on all targets; what is asked for is computed once."""

    def __init__(self, motions: Path, bodies: int = BODIES):
        self.motions, self.bodies = motions, bodies

    @cached_property
    def methods(self) -> tuple[Method, ...]:
        """What is compared."""
        return (*plain_methods(), *learned())

    @cached_property
    def model(self) -> BodyModel:
        """The body that all of them fit."""
        return BodyModel.default()

    @cached_property
    def drawn(self) -> tuple[TrueBodies, NDArray[np.bool_]]:
        """The bodies, and which of them dance salsa; frames evenly spread over each group's recordings."""
        test = load_motions(self.motions).of("test")
        salsa = np.isin(test.subject, sorted(DANCERS))
        half = self.bodies // 2
        rows = [
            group[np.linspace(0, len(group) - 1, half).astype(np.intp)]
            for group in map(np.flatnonzero, (salsa, ~salsa))
        ]
        rows = np.stack(rows, axis=1).ravel()  # alternating, so that any part of them is half salsa
        return true_bodies(test.poses[rows].astype(np.float64), self.model, np.random.default_rng(0)), salsa[rows]

    @cached_property
    def targets(self) -> dict[Corruption, tuple[JointTargets, NDArray[np.bool_]]]:
        """For each setting the targets, and which joints are missing."""
        keypoints = self.drawn[0].keypoints
        return {each: corrupt(keypoints, each, np.random.default_rng(1)) for each in SETTINGS}

    @cached_property
    def outcomes(self) -> dict[Corruption, dict[str, Outcome]]:
        """By setting, by method."""
        return {each: {m.name: self._outcome(each, m) for m in self.methods} for each in SETTINGS}

    def _outcome(self, setting: Corruption, method: Method) -> Outcome:
        targets, missing = self.targets[setting]
        fitter = method.make(None)
        fit, in_batches = timed_fit(fitter, targets, BATCH)
        _, alone = timed_fit(fitter, first(targets, ALONE), 1)
        return Outcome(fit, fit_errors(fit, self.drawn[0], missing, self.model), in_batches, alone)

    @cached_property
    def curves(self) -> dict[Corruption, dict[str, Curve]]:
        """Error against time, by setting, by method."""
        truth = self.drawn[0].keypoints[:CURVE_BODIES]
        return {
            each: {m.name: curve(m, first(self.targets[each][0], CURVE_BODIES), truth) for m in self.methods}
            for each in SETTINGS
        }


def first(targets: JointTargets, count: int) -> JointTargets:
    return JointTargets(targets.xyz[:count], targets.information[:count])


def learned() -> tuple[Method, ...]:
    try:
        methods = learned_methods()
        methods[0].make(None)  # reads the weights
    except (ImportError, InputError) as error:
        print(f"(the learned fitter is left out: {error})\n")
        return ()
    return methods
