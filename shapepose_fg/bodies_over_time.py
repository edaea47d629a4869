"""One body per person over a recording: one shape, and poses that move as people do, fitted to solved joints."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.body_sequence import SequenceFit, Shapes
from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import SubjectShapes
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

    `known` are shapes from other recordings, by the number of the identity. Nothing of this returns into the
    joints or their covariances. Rows without a body keep the body that they had.
    """
    if len(people) == 0:
        return people
    solved = np.isfinite(people.joints).all(axis=-1) & np.isfinite(people.covariance).all(axis=(-1, -2))
    information = np.zeros_like(people.covariance)
    information[solved] = np.linalg.inv(people.covariance[solved])
    targets = JointTargets(
        np.where(solved[..., None], people.joints, 0.0), (information + information.swapaxes(-1, -2)) / 2
    )
    groups = np.unique(people.person)
    body = fingerprint(fitter.model)
    found = fitter.fit_sequence(targets, people.person, people.time_s, _prior(groups, known, body))
    ok = found.fit.ok
    columns = {}
    for name in ("betas", "global_orient", "body_pose", "transl"):
        old, new = getattr(people, name), getattr(found.fit, name)
        columns[name] = np.where(ok.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
    status = np.where(ok & (people.status == Status.BODY_UNDETERMINED), Status.OK, people.status)
    shapes = SubjectShapes(
        names=np.array([str(each) for each in found.groups.tolist()]),
        betas=found.shapes.mean,
        information=found.shapes.information,
        body=body,
    )
    return replace(people, status=status, shapes=shapes, **columns)


def _prior(groups: NDArray[np.integer], known: SubjectShapes | None, body: str) -> Shapes | None:
    """What is known of the shape of each of `groups` (G,); the population's shape for the others."""
    if known is None or len(known) == 0:
        return None
    if known.body != body:
        raise ValueError("shapes must be of the body that is fitted: leave them out, or give those of this body")
    mean, information = np.zeros((len(groups), 10)), np.tile(np.eye(10), (len(groups), 1, 1))
    names = known.names.tolist()
    for place, group in enumerate(groups.tolist()):
        if str(group) in names:
            row = names.index(str(group))
            mean[place], information[place] = known.betas[row], known.information[row]
    return Shapes(mean, information)
