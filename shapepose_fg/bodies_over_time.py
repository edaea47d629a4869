"""One body per person over a recording: one shape, and poses that move as people do, fitted to solved joints."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.body_sequence import SequenceFit, Shapes
from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import SubjectShapes, recognise
from shapepose_fg.reconstruction import Reconstruction, Status


@runtime_checkable
class SequenceFitting(BodyFitter, Protocol):
    """A fitter that fits bodies over time."""

    model: BodyModel
    """The body that it fits."""

    def fit_sequence(
        self,
        targets: JointTargets,
        groups: NDArray[np.intp],
        time_s: NDArray[np.float64],
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """One shape per group and poses linked over time; see `LearnedFitter.fit_sequence`."""
        ...


@dataclass(frozen=True)
class Person:
    """What one person's bodies are fitted to, N rows; plain data, which can be sent to another process."""

    number: int
    """Who it is."""
    targets: JointTargets
    """The joints as they were solved."""
    time_s: NDArray[np.float64]
    """(N,) seconds."""
    shapes: Shapes | None = None
    """What is known of the shape, (1)."""

    def fitted(self, fitter: SequenceFitting) -> SequenceFit:
        """The bodies, and the shape that they share."""
        return fitter.fit_sequence(self.targets, np.full(len(self.time_s), self.number), self.time_s, self.shapes)


Fits = Callable[[Iterable[Person]], Iterable[SequenceFit]]
"""Fits the bodies of people, in order."""


def with_bodies_over_time(
    people: Reconstruction,
    fitter: SequenceFitting,
    known: SubjectShapes | None = None,
    fits: Fits | None = None,
) -> Reconstruction:
    """The same rows with one body per person, fitted to the joints as they were solved, and everybody's shape.

    `known` are people from other recordings: who is recognised by shape (`recognise`) is fitted again with that as
    the prior. Nothing of this returns into the joints or their covariances. Rows without a body keep the body that
    they had. `shapes` of the result are everybody's, those who were recognised by their known names. `fits` fits
    people with `fitter` elsewhere, side by side.
    """
    if len(people) == 0:
        return people
    solved = np.isfinite(people.joints.sum(axis=-1)) & np.isfinite(people.covariance.sum(axis=(-1, -2)))
    information = np.zeros_like(people.covariance)
    information[solved] = np.linalg.inv(people.covariance[solved])
    information = (information + information.swapaxes(-1, -2)) / 2
    xyz = np.where(solved[..., None], people.joints, 0.0)
    numbers = np.unique(people.person)
    rows = [np.flatnonzero(people.person == number) for number in numbers]
    everybody = [
        Person(int(number), JointTargets(xyz[mine], information[mine]), people.time_s[mine])
        for number, mine in zip(numbers, rows, strict=True)
    ]
    fits = (lambda persons: (person.fitted(fitter) for person in persons)) if fits is None else fits
    found = list(fits(everybody))
    body = fingerprint(fitter.model)
    known = SubjectShapes.empty(body) if known is None else known
    whose = recognise(_subjects(found, body), known)
    met = np.flatnonzero(whose >= 0).tolist()
    if len(met) > 0:
        prior = [_prior(known, whose[[n]]) for n in met]
        again = fits(replace(everybody[n], shapes=shape) for n, shape in zip(met, prior, strict=True))
        for n, fit in zip(met, again, strict=True):
            found[n] = fit
    columns = {name: getattr(people, name).copy() for name in ("betas", "global_orient", "body_pose", "transl")}
    status = people.status.copy()
    for mine, each in zip(rows, found, strict=True):
        done = mine[each.fit.ok]
        for name, column in columns.items():
            column[done] = getattr(each.fit, name)[each.fit.ok]
        status[done[status[done] == Status.BODY_UNDETERMINED]] = Status.OK
    shapes = _subjects(found, body).named(_names(numbers.astype(np.intp), known, whose))
    return replace(people, status=status, shapes=shapes, **columns)


def _subjects(found: Sequence[SequenceFit], body: str) -> SubjectShapes:
    """Everybody's shape, named by their numbers."""
    names = np.array([str(group) for each in found for group in each.groups.tolist()])
    mean = np.concatenate([each.shapes.mean for each in found])
    return SubjectShapes(names, mean, np.concatenate([each.shapes.information for each in found]), body)


def _prior(known: SubjectShapes, whose: NDArray[np.intp]) -> Shapes:
    """The shapes of those of `known` whom each person is, `whose` (G,); the population's for strangers."""
    mean, information = np.zeros((len(whose), 10)), np.tile(np.eye(10), (len(whose), 1, 1))
    mean[whose >= 0], information[whose >= 0] = (
        known.betas[whose[whose >= 0]],
        known.information[whose[whose >= 0]],
    )
    return Shapes(mean, information)


def _names(groups: NDArray[np.intp], known: SubjectShapes, whose: NDArray[np.intp]) -> list[str]:
    """What people are called in the file of shapes: known names; strangers by their number, or the next free."""
    names, taken = [], set(known.names.tolist())
    for group, subject in zip(groups.tolist(), whose.tolist(), strict=True):
        number = group
        while subject < 0 and str(number) in taken:
            number = 1 + max(int(name) for name in taken if name.isdecimal())
        names.append(str(known.names[subject]) if subject >= 0 else str(number))
        taken.add(names[-1])
    return names
