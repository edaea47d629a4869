"""One body per person over a recording: one shape, and poses that move as people do, fitted to solved joints."""

from dataclasses import replace
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


def with_bodies_over_time(
    people: Reconstruction, fitter: SequenceFitting, known: SubjectShapes | None = None
) -> Reconstruction:
    """The same rows with one body per person, fitted to the joints as they were solved, and everybody's shape.

    `known` are people from other recordings: who is recognised by shape (`recognise`) is fitted again with that as
    the prior. Nothing of this returns into the joints or their covariances. Rows without a body keep the body that
    they had. `shapes` of the result are everybody's, those who were recognised by their known names.
    """
    if len(people) == 0:
        return people
    solved = np.isfinite(people.joints.sum(axis=-1)) & np.isfinite(people.covariance.sum(axis=(-1, -2)))
    information = np.zeros_like(people.covariance)
    information[solved] = np.linalg.inv(people.covariance[solved])
    targets = JointTargets(
        np.where(solved[..., None], people.joints, 0.0), (information + information.swapaxes(-1, -2)) / 2
    )
    body, person = fingerprint(fitter.model), people.person.astype(np.intp)
    known = SubjectShapes.empty(body) if known is None else known
    found = fitter.fit_sequence(targets, person, people.time_s)
    whose = recognise(_subjects(found, body), known)
    if (whose >= 0).any():
        found = fitter.fit_sequence(targets, person, people.time_s, _prior(known, whose))
    ok = found.fit.ok
    columns = {}
    for name in ("betas", "global_orient", "body_pose", "transl"):
        old, new = getattr(people, name), getattr(found.fit, name)
        columns[name] = np.where(ok.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
    status = np.where(ok & (people.status == Status.BODY_UNDETERMINED), Status.OK, people.status)
    shapes = _subjects(found, body).named(_names(found.groups, known, whose))
    return replace(people, status=status, shapes=shapes, **columns)


def _subjects(found: SequenceFit, body: str) -> SubjectShapes:
    """The shapes of a fit, named by their numbers."""
    names = np.array([str(each) for each in found.groups.tolist()])
    return SubjectShapes(names, found.shapes.mean, found.shapes.information, body)


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
