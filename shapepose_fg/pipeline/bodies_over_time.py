"""One body per person over a recording: one shape, and a smooth motion, fitted to the solved
joints.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets, Shapes
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.soles import above_floor
from shapepose_fg.body.shapes import SubjectShapes, recognise
from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.errors import naming
from shapepose_fg.core.reconstruction import BODY, Reconstruction, Status
from shapepose_fg.core.storage.kept_arrays import ANEW, InMemory, KeptArrays
from shapepose_fg.core.storage.schema import Column, columns_of
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.pipeline.keyframes import bodies_between, spaced

SEGMENT_ROWS = 4000
"""Maximum number of a person's rows fitted together. For a longer track, the shape is fitted to
this many rows in pieces spread evenly over it; poses are then fitted with that shape, segment by
segment, so that neither memory nor the time per row grows with the recording."""
PIECE_ROWS = 160
"""Rows of such a piece: some seconds, so that poses within it are linked in time."""
_OVERLAP_ROWS = 32
"""Rows that a segment shares with its neighbours, on either side, when poses are fitted."""


@dataclass(frozen=True)
class Person:
    """Data for fitting one person's bodies, N rows; plain data that can be sent to
    another process.
    """

    number: int
    """Number of the person."""
    targets: JointTargets
    """Solved joints as targets of the fit."""
    time_s: Array
    """(N,) times, seconds."""
    shapes: Shapes | None = None
    """The known shape, one row; None where none is known."""
    fixed_shapes: bool = False
    """Whether the shape is kept fixed."""
    kept: range | None = None
    """The rows for which bodies are returned, None for all. Others overlap with neighbouring
    segments, or contribute to the shape only."""
    floor: Floor | None = None
    """Floor that bodies must not sink into; None for none."""
    keyframe_s: float = 0.0
    """Maximum time between fitted rows, s, with poses interpolated between them; 0: every row."""

    @classmethod
    def of(cls, number: int, joints: Array, covariance: Array, time_s: Array) -> "Person":
        """Data of the solved rows of one person: `joints` (N, J, 3), `covariance` (N, J, 3, 3),
        `time_s` (N,).
        """
        return cls(number, JointTargets.solved(joints, covariance), time_s)

    def fitted(self, fitter: BodyFitter) -> dict[str, NDArray[Any]]:
        """Fit the bodies; returns arrays: `ok` (N,) rows with a body, `betas` to `transl` as in
        `Reconstruction`; and the common shape, `mean` (1, 10) and `information` (1, 10, 10), from
        all rows.
        """
        rows = np.flatnonzero(spaced(self.time_s, self.keyframe_s))
        targets, time_s, group = (
            self.targets.rows(rows),
            self.time_s[rows],
            np.full(len(rows), self.number),
        )
        found = fitter.fit_sequence(
            targets,
            group,
            time_s,
            self.shapes,
            fixed_shapes=self.fixed_shapes,
            faster=_faster(fitter, targets, time_s),
        )
        kept = range(len(self.time_s)) if self.kept is None else self.kept
        first, last = (
            np.searchsorted(rows, kept.start, side="right") - 1,
            np.searchsorted(rows, kept.stop - 1),
        )
        around = np.arange(first, last + 1) if len(kept) > 0 else np.arange(0)
        fit = found.fit.rows(around)
        bodies = fit.betas, fit.global_orient, fit.body_pose, fit.transl
        if self.floor is not None and fitter.model is not None:
            bodies = above_floor(fitter.model, bodies, self.floor.normal, self.floor.height_m)
        ok = fit.ok
        if len(rows) < len(self.time_s):
            ok, bodies = bodies_between(
                ok, bodies, time_s[around], self.time_s[kept.start : kept.stop]
            )
        shape = {"mean": found.shapes.mean, "information": found.shapes.information}
        return {"ok": ok, **dict(zip(BODY, bodies, strict=True)), **shape}


def _faster(fitter: BodyFitter, targets: JointTargets, time_s: Array) -> Array:
    """(N, J) how many times the usual density of acceleration each joint of a person has around
    each row, at least 1.
    """
    assert fitter.model is not None
    found = np.ones(targets.xyz.shape[:2])
    if len(targets) > 1:
        information = np.trace(targets.information, axis1=-2, axis2=-1) / 3
        motion = MotionModel.load(tuple(fitter.model.keypoint_names))
        steps = motion.faster(targets.xyz, 1 / np.maximum(information, 1e-6), time_s)
        found[:-1] = steps
        found[1:] = np.maximum(found[1:], steps)
    return found


_BODIES = {name: column for name, column in columns_of(Reconstruction).items() if name in BODY} | {
    "ok": Column("N", np.bool_),
    "mean": Column("1 10", most=1e3),
    "information": Column("1 10 10", most=1e12),
}
"""Columns of the arrays that `Person.fitted` returns."""
Fits = Callable[[Iterable[Person]], Iterable[dict[str, NDArray[Any]]]]
"""Function that fits the bodies of people (`Person.fitted`), in order."""


@dataclass(frozen=True)
class BodiesOverTime:
    """The bodies of all people, stored in segments."""

    kept: KeptArrays
    """Storage of the segments."""
    places: Mapping[int, Mapping[str, range]]
    """For each person the names of the stored segments, and the range of the person's rows in each,
    in order."""
    shapes: SubjectShapes
    """The shapes of all people; recognised people keep their known names."""

    def filled(
        self, column: str, values: NDArray[Any], person: Whole, before: Mapping[int, int]
    ) -> NDArray[Any]:
        """Rows of a column of a result with these bodies, where available; `status` changes to that
        of a row with a body.

        `values` (R, ...) are the rows before, `person` (R,) their people, and `before` the number
        of preceding rows of each person. Other columns are unchanged.
        """
        if column not in (*BODY, "status"):
            return values
        values = values.copy()
        for number in np.unique(person).tolist():
            mine = np.flatnonzero(person == number)
            first = before.get(number, 0)
            part = range(first, first + len(mine))
            ok = self._rows(number, "ok", part)
            if column == "status":
                undetermined = values[mine] == Status.BODY_UNDETERMINED
                values[mine[ok & undetermined]] = Status.OK
            else:
                values[mine[ok]] = self._rows(number, column, part)[ok]
        return values

    def _rows(self, number: int, column: str, rows: range) -> NDArray[Any]:
        """A column of some of a person's own rows."""
        pieces = []
        for name, own in self.places[number].items():
            first, last = max(rows.start, own.start), min(rows.stop, own.stop)
            if first < last:
                pieces.append(
                    self.kept.array(name, column, slice(first - own.start, last - own.start))
                )
        return np.concatenate(pieces)


def fit_everybody(
    counts: Mapping[int, int],
    person: Callable[[int, Sequence[range]], Person],
    fits: Fits,
    kept: KeptArrays,
    known: SubjectShapes,
    lengths: tuple[int, int] = (SEGMENT_ROWS, PIECE_ROWS),
) -> BodiesOverTime:
    """Fit one body per person to the solved joints; stored segments are not fitted again.

    `counts` is the number of rows per person; `person` returns the data of a person in some of
    these rows, as ranges in order, and `fits` fits several people, in parallel if possible. `known`
    are people from other recordings: a person who is recognised by shape (`recognise`) is fitted
    again with the known shape as the prior. `lengths` are the rows of a segment and of a piece.
    """
    most, piece = lengths
    long = [number for number, count in counts.items() if count > most]
    places: dict[int, dict[str, range]] = {}

    def fit(jobs: Mapping[str, tuple[int, Callable[[], Person]]]) -> None:
        """Fit the jobs that are not stored yet, by name: number of rows, and function for their
        data.
        """
        there = set(kept.names(""))
        for name in jobs.keys() & there:
            bodies = kept.columns(name, _BODIES, {"N": jobs[name][0]})
            with naming(kept.place(name), ANEW):
                SubjectShapes(np.array([name]), bodies["mean"], bodies["information"], known.body)
        missing = [name for name in jobs if name not in there]
        for name, bodies in zip(missing, fits(jobs[name][1]() for name in missing), strict=True):
            kept.keep(name, bodies)

    def whole(number: int, prior: Shapes | None) -> Person:
        """Data for fitting the shape, and for short tracks the bodies."""
        if number in long:
            rows = person(number, _spread(counts[number], most, piece))
            return replace(rows, shapes=prior, kept=range(0))
        return replace(person(number, [range(counts[number])]), shapes=prior)

    def found(kind: str, prior: Mapping[int, Shapes | None]) -> dict[int, Shapes]:
        """Shapes of some people, and for short tracks their bodies."""
        names = {number: f"{kind}-{number}" for number in prior}
        rows = {number: 0 if number in long else counts[number] for number in names}
        fit(
            {
                name: (rows[number], partial(whole, number, prior[number]))
                for number, name in names.items()
            }
        )
        places.update({number: {name: range(counts[number])} for number, name in names.items()})
        return {
            n: Shapes(kept.array(name, "mean"), kept.array(name, "information"))
            for n, name in names.items()
        }

    shapes = found("bodies", dict.fromkeys(counts))
    whose = recognise(_subjects(shapes, known.body), known)
    prior = {
        number: Shapes(known.betas[[subject]], known.information[[subject]])
        for number, subject in zip(counts, whose.tolist(), strict=True)
        if subject >= 0
    }
    shapes |= found("recognised", prior)

    def segment(number: int, own: range) -> Person:
        first = max(own.start - _OVERLAP_ROWS, 0)
        rows = person(number, [range(first, min(own.stop + _OVERLAP_ROWS, counts[number]))])
        inside = range(own.start - first, own.stop - first)
        return replace(rows, shapes=shapes[number], fixed_shapes=True, kept=inside)

    for number in long:
        edges = (
            np.linspace(0, counts[number], 1 - (-counts[number] // most))
            .round()
            .astype(int)
            .tolist()
        )
        places[number] = {
            f"segment-{number}-{n:04d}": range(*ends) for n, ends in enumerate(pairwise(edges))
        }
    fit(
        {
            name: (len(own), partial(segment, number, own))
            for number in long
            for name, own in places[number].items()
        }
    )
    names = _names(list(counts), known, whose.tolist())
    return BodiesOverTime(kept, places, _subjects(shapes, known.body).named(names))


def _spread(count: int, most: int, length: int) -> list[range]:
    """Ranges of at most `most` of `count` rows, in pieces of equal `length`, spread evenly from the
    first to the last.
    """
    length = min(length, most)
    starts = np.linspace(0, count - length, most // length).round().astype(int).tolist()
    return [range(start, start + length) for start in starts]


def with_bodies_over_time(
    people: Reconstruction,
    fitter: BodyFitter,
    known: SubjectShapes | None = None,
    floor: Floor | None = None,
    keyframe_s: float = 0.0,
) -> Reconstruction:
    """Return the rows with one body per person, fitted to the solved joints, and each person's
    shape.

    `known`: see `fit_everybody`; `floor`, `keyframe_s`: see `Person`. Joints and their covariances
    do not change. Rows without a new body keep their previous one. `shapes` of the result are those
    of all people.
    """
    if len(people) == 0:
        return people
    if fitter.model is None:
        raise ValueError(f"{type(fitter).__name__} has no model: it fits no bodies over time")
    known = SubjectShapes.empty(fingerprint(fitter.model)) if known is None else known
    if known.body != fingerprint(fitter.model):
        raise ValueError("shapes must be of the same body model as the fitter's")

    numbers, counts = np.unique(people.person, return_counts=True)

    def person(number: int, parts: Sequence[range]) -> Person:
        mine = np.flatnonzero(people.person == number)[np.concatenate(parts)]
        one = Person.of(number, people.joints[mine], people.covariance[mine], people.time_s[mine])
        return replace(one, floor=floor, keyframe_s=keyframe_s)

    bodies = fit_everybody(
        dict(zip(numbers.tolist(), counts.tolist(), strict=True)),
        person,
        lambda jobs: (job.fitted(fitter) for job in jobs),
        InMemory(),
        known,
    )
    columns = {
        name: bodies.filled(name, getattr(people, name), people.person, {})
        for name in (*BODY, "status")
    }
    return replace(people, shapes=bodies.shapes, **columns)


def _subjects(shapes: Mapping[int, Shapes], body: str) -> SubjectShapes:
    """The shapes of all people, named by their numbers."""
    mean, information = (
        [getattr(each, name) for each in shapes.values()] for name in ("mean", "information")
    )
    names = np.array([str(number) for number in shapes])
    return SubjectShapes(names, np.concatenate(mean), np.concatenate(information), body)


def _names(numbers: Sequence[int], known: SubjectShapes, whose: Sequence[int]) -> list[str]:
    """Names of people in the file of shapes: known names; new people get their number, or the next
    free one.
    """
    names, taken = [], set(known.names.tolist())
    for number, subject in zip(numbers, whose, strict=True):
        name = str(number) if subject < 0 else str(known.names[subject])
        if subject < 0 and name in taken:
            name = str(1 + max(int(each) for each in taken if each.isdecimal()))
        names.append(name)
        taken.add(name)
    return names
