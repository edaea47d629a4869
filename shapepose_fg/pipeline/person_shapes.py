"""One shape per person over a recording, and the bodies of windows with that shape.

Every window has solved bodies with a shape of its own. The shapes of a person's windows are
combined by their information, and each body is turned so that its joints stay where the window has
them.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from shapepose_fg.body.fitting.energy import (
    BATCH,
    SETTLED,
    BodyEnergy,
    EnergyTargets,
    Held,
    nothing,
)
from shapepose_fg.body.fitting.evidence import weigh
from shapepose_fg.body.fitting.fitter import BodyConfig, JointTargets
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.sizes import Sizes
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.soles import above_floor
from shapepose_fg.body.shapes import SubjectShapes, recognise
from shapepose_fg.core.arrays import Array, Index, Whole
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.floor import MEASUREMENT_S, Floor

_NOT_ROBUST = 1e9
"""Width of the robust kernel, standard deviations, at which it has no effect."""
_STEPS = 2
"""Gauss-Newton steps from a window's body to one with another shape."""


@dataclass(frozen=True)
class WindowBodies(Rows):
    """R rows with bodies, as their windows solved them."""

    person: Whole
    """(R,) numbers of people."""
    time_s: Array
    """(R,) times, seconds."""
    joints: Array
    """(R, J, 3) joints in the world, metres; NaN if unknown."""
    covariance: Array
    """(R, J, 3, 3) covariances of the joints, m²."""
    betas: Array
    """(R, 10) shapes; NaN without a body."""
    global_orient: Array
    """(R, 3) rotations of the root, axis-angle, rad."""
    body_pose: Array
    """(R, 23, 3) rotations of the other joints relative to their parents, axis-angle, rad."""
    transl: Array
    """(R, 3) translations, metres."""

    @classmethod
    def of(cls, people: Reconstruction) -> "WindowBodies":
        """Take the columns from a result."""
        return cls(*(getattr(people, name) for name in cls.__dataclass_fields__))

    @property
    def body(self) -> BodyParameters:
        """The bodies as parameters of the body model."""
        return BodyParameters(self.betas, self.global_orient, self.body_pose, self.transl)


@dataclass
class ShapeEvidence:
    """Information of rows about a person's shape, without a prior."""

    information: Array = field(default_factory=lambda: np.zeros((10, 10)))
    """(10, 10) information on the betas, summed over all rows."""
    pull: Array = field(default_factory=lambda: np.zeros(10))
    """(10,) information times betas, summed over all rows."""
    count: int = 0
    """Number of rows."""
    measurements: set[int] = field(default_factory=set)
    """Numbers of the intervals, `MEASUREMENT_S` long, in which there are rows. Errors of joints are
    correlated as long, so all rows of an interval count as one measurement of the shape."""

    def add(self, other: "ShapeEvidence") -> None:
        """Add the evidence of other rows."""
        self.information = self.information + other.information
        self.pull = self.pull + other.pull
        self.count += other.count
        self.measurements |= other.measurements

    @property
    def measured(self) -> tuple[Array, Array]:
        """Information on the betas (10, 10), and information times betas (10,), if each interval
        counts as one measurement.
        """
        share = min(len(self.measurements) / max(self.count, 1), 1.0)
        return share * self.information, share * self.pull


def _evidence(model: BodyModel, sigma_m: float, rows: WindowBodies) -> dict[int, ShapeEvidence]:
    """Information of the rows on the shape of each person, by person number."""
    found, energy = dict[int, ShapeEvidence](), BodyEnergy(model, PosePrior.default())
    for index, selected, free in _batches(rows, energy):
        count, known = len(index), JointTargets.solved(selected.joints, selected.covariance)
        xyz = energy.model.keypoints(energy.complete(free))
        targets = EnergyTargets(xyz, weigh(known, sigma_m).information)
        held = Held(np.zeros((count, 10)), np.ones(count), free[:, 13:-3])
        body = energy.evaluate(free, targets, _NOT_ROBUST, held, nothing(count))
        information = np.linalg.inv(body.covariances()[1]) - np.eye(10)
        pull = (information @ free[:, :10, None])[..., 0]
        measurements = (selected.time_s // MEASUREMENT_S).astype(np.int64).tolist()
        for n, number in enumerate(selected.person.tolist()):
            each = ShapeEvidence(information[n], pull[n], 1, {measurements[n]})
            found.setdefault(number, ShapeEvidence()).add(each)
    return found


def combined(
    found: Mapping[int, ShapeEvidence], known: SubjectShapes, model: BodyModel
) -> SubjectShapes:
    """The shapes of people, in the order of `found`; the prior is that of adults.

    `known` are people of other recordings. If one is recognised by shape (`recognise`), the known
    shape is the prior, and the name is kept; others are named by their numbers. Raises ValueError
    if they are of another body model.
    """
    people, sizes = [each.measured for each in found.values()], Sizes.of(model)
    seen = np.array([information for information, _ in people]).reshape(-1, 10, 10)
    pull = np.array([each for _, each in people]).reshape(-1, 10)
    information = seen + np.eye(10)
    betas = np.asarray(np.linalg.solve(information, pull[..., None])[..., 0], dtype=np.float64)
    numbers = np.array([str(number) for number in found], dtype=str)
    matches = recognise(SubjectShapes(numbers, betas, information, fingerprint(model)), known)
    for n, subject in enumerate(matches.tolist()):
        if subject >= 0:
            prior = known.information[subject]
            information[n] = seen[n] + prior
            betas[n] = np.linalg.solve(information[n], pull[n] + prior @ known.betas[subject])
        elif sizes.far(betas[[n]])[0]:
            betas[n] = sizes.measured(model, betas[n], seen[n], pull[n])
    names = _names(list(found), known, matches.tolist())
    return SubjectShapes(np.array(names, dtype=str), betas, information, known.body)


def _with_shape(
    model: BodyModel, sigma_m: float, job: tuple[WindowBodies, Mapping[int, Array], Floor | None]
) -> dict[str, Array]:
    """Columns of the rows' bodies, with the shapes that the job gives by person number.

    Poses change so that joints of bodies stay; no body sinks into the floor. Rows without a body
    do not change.
    """
    rows, known, floor = job
    betas = np.array([known[number] for number in rows.person.tolist()]).reshape(-1, 10)
    found = {name: getattr(rows, name).copy() for name in BODY}
    energy = BodyEnergy(model, PosePrior.default())
    for index, _, free in _batches(rows, energy):
        # All joints alike, or poses would tremble with the views that see them.
        xyz = energy.model.keypoints(energy.complete(free))
        information = np.broadcast_to(np.eye(3) / sigma_m**2, (*xyz.shape, 3))
        targets = EnergyTargets(xyz, information)
        held = Held(betas[index], np.full(len(index), SETTLED), free[:, 13:-3])
        free[:, :10] = betas[index]
        for _ in range(_STEPS):
            body = energy.evaluate(free, targets, _NOT_ROBUST, held, nothing(len(index)))
            free = energy.retract(free, body.step)
        made = replace(energy.complete(free), betas=betas[index])
        bodies = made.betas, made.global_orient, made.body_pose, made.transl + rows.transl[index]
        if floor is not None:
            bodies = above_floor(model, bodies, floor.normal, floor.height_m)
        for name, values in zip(BODY, bodies, strict=True):
            found[name][index] = values
    return found


def _batches(rows: WindowBodies, energy: BodyEnergy) -> Iterator[tuple[Index, WindowBodies, Array]]:
    """Rows with a body, in batches: their indices, the rows, and the free parameters of their
    bodies relative to their translations.
    """
    ok = np.flatnonzero(np.isfinite(rows.betas).all(axis=1))
    for at in range(0, len(ok), BATCH):
        selected = rows.rows(index := ok[at : at + BATCH])
        yield index, selected, energy.parameters(selected.body, selected.transl)


Mapped = Callable[[Callable[[BodyModel, float, Any], Any], Iterable[Any]], Iterator[Any]]
"""Applies a function to all items, in any processes, and yields the results in order, as `map`
does. The function gets the body model, the standard deviation of a detector's joint from the body's
(metres), and an item."""


def bodies_with_shapes(
    parts: Callable[[], Iterable[WindowBodies]],
    numbers: Iterable[int],
    model: BodyModel,
    known: SubjectShapes | None,
    floor: Floor | None,
    mapped: Mapped,
) -> tuple[SubjectShapes, Iterator[dict[str, Array]]]:
    """The shape of each of the people `numbers`, from all their rows (`combined`), and their bodies
    with these shapes: for each part, the columns of its rows.
    """
    found = {number: ShapeEvidence() for number in numbers}
    for of_part in mapped(_evidence, parts()):
        for number, each in of_part.items():
            found[number].add(each)
    known = SubjectShapes.empty(fingerprint(model)) if known is None else known
    shapes = combined(found, known, model)
    betas = dict(zip(found, shapes.betas, strict=True))
    return shapes, mapped(_with_shape, ((rows, betas, floor) for rows in parts()))


def with_person_shapes(
    people: Reconstruction,
    model: BodyModel,
    known: SubjectShapes | None = None,
    floor: Floor | None = None,
    sigma_m: float = BodyConfig.model_sigma_m,
) -> Reconstruction:
    """Return the rows with one shape per person, and these shapes (`combined`).

    Joints and their covariances do not change; bodies are those of `bodies_with_shapes`. `sigma_m`
    is the standard deviation of a detector's joint from the body's, metres.
    """
    if len(people) == 0:
        return people
    rows, numbers = WindowBodies.of(people), np.unique(people.person).tolist()
    mapped: Mapped = lambda work, items: map(partial(work, model, sigma_m), items)  # noqa: E731
    shapes, (bodies,) = bodies_with_shapes(lambda: [rows], numbers, model, known, floor, mapped)
    return replace(people, shapes=shapes, **bodies)


def _names(numbers: Sequence[int], known: SubjectShapes, matches: Sequence[int]) -> list[str]:
    """Names of people in the file of shapes: known names; new people get their number, or the next
    free one.
    """
    names, taken = [], set(known.names.tolist())
    for number, subject in zip(numbers, matches, strict=True):
        name = str(number) if subject < 0 else str(known.names[subject])
        if subject < 0 and name in taken:
            name = str(1 + max(int(each) for each in taken if each.isdecimal()))
        names.append(name)
        taken.add(name)
    return names
