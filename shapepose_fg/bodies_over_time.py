"""One body per person over a recording: one shape, and poses that move as people do, fitted to solved joints."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.body_sequence import SequenceFit, Shapes
from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import SubjectShapes, recognise
from shapepose_fg.kept_arrays import InMemory, KeptArrays
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

    @classmethod
    def of(
        cls,
        number: int,
        joints: NDArray[np.float64],
        covariance: NDArray[np.float64],
        time_s: NDArray[np.float64],
    ) -> "Person":
        """From the solved rows of one person: `joints` (N, J, 3), `covariance` (N, J, 3, 3), `time_s` (N,)."""
        solved = np.isfinite(joints.sum(axis=-1)) & np.isfinite(covariance.sum(axis=(-1, -2)))
        information = np.zeros_like(covariance)
        information[solved] = np.linalg.inv(covariance[solved])
        information = (information + information.swapaxes(-1, -2)) / 2
        return cls(number, JointTargets(np.where(solved[..., None], joints, 0.0), information), time_s)

    def fitted(self, fitter: SequenceFitting) -> "PersonBodies":
        """The bodies, and the shape that they share."""
        group = np.full(len(self.time_s), self.number)
        found = fitter.fit_sequence(self.targets, group, self.time_s, self.shapes)
        fit = found.fit
        return PersonBodies(fit.ok, fit.betas, fit.global_orient, fit.body_pose, fit.transl, found.shapes)


@dataclass(frozen=True)
class PersonBodies:
    """One person's bodies in N rows."""

    ok: NDArray[np.bool_]
    """(N,) which rows have one."""
    betas: NDArray[np.float64]
    """(N, 10), and the next three as in `Reconstruction`."""
    global_orient: NDArray[np.float64]
    body_pose: NDArray[np.float64]
    transl: NDArray[np.float64]
    shape: Shapes
    """(1) what all rows say of the shape."""


Fits = Callable[[Iterable[Person]], Iterable[PersonBodies]]
"""Fits the bodies of people, in order."""

_COLUMNS = ("betas", "global_orient", "body_pose", "transl")


@dataclass(frozen=True)
class BodiesOverTime:
    """Everybody's bodies, kept person by person."""

    kept: KeptArrays
    """Where they are."""
    places: Mapping[int, str]
    """Under which name each person's are."""
    shapes: SubjectShapes
    """Everybody's shape; those who were recognised by their known names."""

    def filled(
        self, column: str, values: NDArray[Any], person: NDArray[np.integer], before: Mapping[int, int]
    ) -> NDArray[Any]:
        """Rows of a column of a result with these bodies, where there are any; `status` says that there are.

        `values` (R, ...) are the rows as they were, `person` (R,) whose they are, and `before` how many rows of
        each person there are before them. Other columns stay as they are.
        """
        if column not in (*_COLUMNS, "status"):
            return values
        values = values.copy()
        for number in np.unique(person).tolist():
            mine = np.flatnonzero(person == number)
            first = before.get(number, 0)
            part = slice(first, first + len(mine))
            ok = self.kept.array(self.places[number], "ok", part)
            if column == "status":
                undetermined = values[mine] == Status.BODY_UNDETERMINED
                values[mine[ok & undetermined]] = Status.OK
            else:
                values[mine[ok]] = self.kept.array(self.places[number], column, part)[ok]
        return values


def fit_everybody(
    numbers: Sequence[int],
    person: Callable[[int], Person],
    fits: Fits,
    kept: KeptArrays,
    known: SubjectShapes,
) -> BodiesOverTime:
    """Fit one body per person to the joints as they were solved; who is kept already is not fitted again.

    `known` are people from other recordings: who is recognised by shape (`recognise`) is fitted again with that as
    the prior. `person` gives what somebody's bodies are fitted to, `fits` fits people, side by side if it likes.
    """
    places = {number: f"bodies-{number}" for number in numbers}
    _fit_missing(places, lambda number: person(number), fits, kept)
    whose = recognise(_subjects(places, kept, known.body), known)
    met = {numbers[n]: int(whose[n]) for n in np.flatnonzero(whose >= 0).tolist()}
    again = {number: f"recognised-{number}" for number in met}
    _fit_missing(
        again, lambda number: replace(person(number), shapes=_prior(known, np.array([met[number]]))), fits, kept
    )
    places |= again
    names = _names(np.array(numbers, dtype=np.intp), known, whose)
    return BodiesOverTime(kept, places, _subjects(places, kept, known.body).named(names))


def with_bodies_over_time(
    people: Reconstruction, fitter: SequenceFitting, known: SubjectShapes | None = None
) -> Reconstruction:
    """The same rows with one body per person, fitted to the joints as they were solved, and everybody's shape.

    `known`: see `fit_everybody`. Nothing of this returns into the joints or their covariances. Rows without a body
    keep the body that they had. `shapes` of the result are everybody's.
    """
    if len(people) == 0:
        return people
    known = SubjectShapes.empty(fingerprint(fitter.model)) if known is None else known
    if known.body != fingerprint(fitter.model):
        raise ValueError("shapes must be of the same body model as the fitter's")

    def person(number: int) -> Person:
        mine = people.person == number
        return Person.of(number, people.joints[mine], people.covariance[mine], people.time_s[mine])

    bodies = fit_everybody(
        np.unique(people.person).tolist(),
        person,
        lambda jobs: (job.fitted(fitter) for job in jobs),
        InMemory(),
        known,
    )
    columns = {
        name: bodies.filled(name, getattr(people, name), people.person, {}) for name in (*_COLUMNS, "status")
    }
    return replace(people, shapes=bodies.shapes, **columns)


def _fit_missing(places: Mapping[int, str], person: Callable[[int], Person], fits: Fits, kept: KeptArrays) -> None:
    """Fit who is not kept, and keep them."""
    there = set(kept.names(""))
    missing = [number for number, place in places.items() if place not in there]
    for number, bodies in zip(missing, fits(map(person, missing)), strict=True):
        arrays = {name: getattr(bodies, name) for name in ("ok", *_COLUMNS)}
        kept.keep(places[number], arrays | {"mean": bodies.shape.mean, "information": bodies.shape.information})


def _subjects(places: Mapping[int, str], kept: KeptArrays, body: str) -> SubjectShapes:
    """Everybody's shape, named by their numbers."""
    mean, information = (
        np.concatenate([kept.array(place, name) for place in places.values()]) for name in ("mean", "information")
    )
    return SubjectShapes(np.array([str(number) for number in places]), mean, information, body)


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
