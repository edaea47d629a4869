"""Small errors of cameras, and biases of single people: their probabilities as explanations of the
residuals.

All explanations are compared with each other and with none, by the likelihood of `biases`,
marginalised over detector biases and joint positions.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.cameras.check.biases import BiasedResiduals, BiasMarginal
from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.parameters import (
    CENTRE,
    FOCAL,
    MOVE,
    POSE,
    TURN,
    Q,
    changed,
    changed_one,
    difference,
)
from shapepose_fg.cameras.sightings import followed
from shapepose_fg.cameras.triangulation import observed
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views

ONE = {
    Kind.TURNED: [TURN],
    Kind.MOVED: [POSE, MOVE],
    Kind.FOCAL: [FOCAL],
    Kind.PRINCIPAL_POINT: [CENTRE],
}
"""Small mistakes of a single camera, and their parameters; a moved camera may be turned, or not."""
_TURN, _MOVE, _FOCAL = np.deg2rad(3.0), 0.05, 0.1
"""Standard deviations of a small mistake of a camera: a rotation, or an equivalent shift of the
principal point, rad; a translation, as a share of the people's distance; the logarithm of the focal
length."""
_EVERY = np.deg2rad(0.5)
"""Standard deviation of the principal points of several cameras, as an angle, rad."""
BIAS = 0.1
"""Standard deviation of an unusual bias of one person, as a share of the size."""
_WRONG = 0.5
"""Prior probability that some camera has a small mistake, and that some person has an
unusual bias."""
_KNOCKED = 3
"""Prior frequency of rotated or translated cameras, relative to other mistakes."""
MOST_PEOPLE = 150
"""Maximum number of people used, spread over the recording."""
_LEAST_OF_ONE = 6
"""Minimum number of frames of a person for biases of that person's own; people with fewer are
pooled."""
LEAST_DEG = 0.25
"""Minimum rotation, or shift of a principal point, that is reported, degrees."""


@dataclass(frozen=True)
class ErrorCause:
    """One explanation of the residuals."""

    finding: Finding | None
    """The mistake; None for no mistake."""
    log: float
    """Logarithm of likelihood times prior probability."""
    views: Views
    """The corrected cameras."""
    person: int = -1
    """Person with the bias; -1 for none."""


@dataclass(frozen=True)
class SmallErrors:
    """The residuals of a recording, to be explained."""

    residuals: BiasedResiduals
    """Residuals of people associated under the cameras of a set-up."""
    frame: Index
    """(N,) frame of each person."""
    given: Views
    """The cameras without any explanation."""
    biased: tuple[tuple[int, ...], ...] = ()
    """People and views with an unusual bias already accounted for."""

    @classmethod
    def of(cls, setup: SetupHypothesis, given: Views | None = None) -> "SmallErrors":
        """Build the problem from people spread over the frames, relative to `given`, by default the
        set-up's own cameras.
        """
        groups, structure = setup.structure(steps=2)
        identity = followed(groups.frame, structure.points)
        step = max(1, -(-len(groups) // MOST_PEOPLE))
        groups, identity = groups.rows(slice(None, None, step)), identity[::step]
        frame = groups.frame
        enough = np.bincount(identity, minlength=1) >= _LEAST_OF_ONE
        person = np.unique(np.where(enough[identity], identity, len(enough)), return_inverse=True)[
            1
        ]
        # Maximum number of parts of a recording at whose borders a camera may be bumped; errors of
        # a detector last for some frames, so a part has `_LEAST_OF_ONE` or more.
        parts = min(8, len(np.unique(frame)) // _LEAST_OF_ONE)
        ends = np.quantile(frame, np.arange(1, parts) / parts) if parts > 1 else np.zeros(0)
        part = np.unique(
            np.searchsorted(np.unique(np.ceil(ends)), frame, side="right"), return_inverse=True
        )[1]
        seen = observed(groups, setup.sightings)
        return cls(
            BiasedResiduals.of(seen, setup.views, person, part),
            frame,
            setup.views if given is None else given,
        )

    @cached_property
    def _marginals(self) -> list[BiasMarginal]:
        return self.residuals.marginals(self.given)

    def _likelihood(
        self,
        directions: Array,
        sigma: Array,
        views: Views | None = None,
        before: Array | None = None,
    ) -> tuple[float, Array]:
        """Log-likelihood of changes along `directions` (C, n) with standard deviations (n,), and
        the best change (n,).

        With `views` it is linearised at these cameras, which already include the change `before`
        (n,).
        """
        marginals = (
            self._marginals
            if views is None or views is self.given
            else self.residuals.marginals(views)
        )
        others = [self.residuals.of_person(*each) for each in self.biased]
        to = np.concatenate([directions * sigma, *(BIAS * each for each in others)], axis=1)
        done = np.zeros(to.shape[1])
        if before is not None:
            done[: len(sigma)] = before / sigma
        columns = np.flatnonzero(to.any(axis=1))
        to = to[columns]
        H = to.T @ np.array([each.H[np.ix_(columns, columns)] for each in marginals]) @ to
        g = np.array([each.g[columns] for each in marginals]) @ to - done
        known = H + np.eye(len(done))
        best = np.linalg.solve(known, g[..., None])[..., 0]
        gain = (g * best).sum(axis=1) - done @ done - np.linalg.slogdet(known)[1]
        likely = np.array([each.log for each in marginals]) + 0.5 * gain
        logs = np.nan_to_num(likely, nan=-np.inf)  # people behind a camera
        return float(np.logaddexp.reduce(logs)), best[int(np.argmax(logs)), : len(sigma)] * sigma

    @cached_property
    def causes(self) -> list[ErrorCause]:
        """Possible explanations including no mistake, most probable first, with probabilities."""
        found = [self.as_they_are(None, self.given), *self.biases(), *self._of_several()]
        for view in range(len(self.given)):
            found += [*self.explained(view, dict.fromkeys(ONE, self.given)), *self._over_time(view)]
        return probable(found)

    def as_they_are(self, finding: Finding | None, views: Views) -> ErrorCause:
        """The explanation that cameras are as in `views`, which corrects a finding; None for no
        mistake.
        """
        likely, _ = self._likelihood(self.residuals.camera(0, []), np.zeros(0), views)
        return ErrorCause(
            finding, likely if finding is None else likely + self._rare(finding.kind), views
        )

    def explained(self, view: int, starts: Mapping[Kind, Views]) -> list[ErrorCause]:
        """Mistakes of a single camera; `starts` are the cameras with each mistake approximately
        corrected.
        """
        found, tried = [], [(kind, which) for kind in starts for which in ONE[kind]]
        for kind, which in tried:
            views = self.given if which is MOVE else starts[kind]  # others are fitted with turns
            directions, sigma = self.residuals.camera(view, which), self._usual(view)[which]
            for _ in range(1 if starts[kind] is self.given else 2):
                before = _between(self.given, views, view)[which]
                likely, change = self._likelihood(directions, sigma, views, before)
                views = changed_one(views, view, which, change)
            likely += self._rare(kind) - float(np.log(len(ONE[kind])))
            found.append(ErrorCause(named(kind, view, self.given, views), likely, views))
        return found

    def biases(self) -> Iterator[ErrorCause]:
        """A bias of each person in each view."""
        people, views = int(self.residuals.person.max(initial=-1)) + 1, len(self.given)
        seen = np.zeros((people, views))
        np.add.at(seen, self.residuals.person, (self.residuals.weight > 0).any(axis=1))
        for person, view in np.argwhere(seen >= _LEAST_OF_ONE).tolist():
            directions = self.residuals.of_person(person, view)
            likely, bias = self._likelihood(directions, np.full(3, BIAS))
            finding = Finding(Kind.BIASED, (view,), float(np.hypot(*bias[:2])))
            yield ErrorCause(
                finding, likely + np.log(_WRONG / (people * views)), self.given, person
            )

    def _over_time(self, view: int) -> Iterator[ErrorCause]:
        """Rotations of one camera in the parts before or after a frame, and linear drifts."""
        K, times = self.residuals.parts, np.unique(self.residuals.part, return_index=True)[1]
        if K < 3:
            return
        first, t = self.frame[times].tolist(), (np.arange(K) + 0.5) / K
        stories = [(Kind.DRIFTING, t, (None, None)), (Kind.DRIFTING, 1 - t, (None, None))]
        for k in range(1, K):
            stories += [
                (Kind.BUMPED, np.arange(K) >= k, (first[k], None)),
                (Kind.BUMPED, np.arange(K) < k, (None, first[k])),
            ]
        for kind, share, frames in stories:
            likely, turn = self._likelihood(
                self.residuals.camera(view, TURN, share), np.full(3, _TURN)
            )
            finding = Finding(kind, (view,), float(np.rad2deg(np.linalg.norm(turn))), frames=frames)
            count = 2 if kind == Kind.DRIFTING else 2 * K - 2
            yield ErrorCause(finding, likely + self._rare(kind) - np.log(count), self.given)

    def _of_several(self) -> list[ErrorCause]:
        """Independent errors of the principal points of all cameras."""
        V = len(self.given)
        directions = np.concatenate(
            [self.residuals.camera(view, CENTRE) for view in range(V)], axis=1
        )
        sigma = np.repeat(_EVERY * self.given.focal_px, 2)
        likely, change = self._likelihood(directions, sigma)
        change = change.reshape(V, 2)
        degrees = np.rad2deg(np.hypot(*change.T) / self.given.focal_px)
        rest = np.flatnonzero(degrees > LEAST_DEG).tolist()
        if len(rest) < 2:
            return []
        shifts = tuple((float(x), float(y)) for x, y in change[rest])
        finding = Finding(Kind.PRINCIPAL_POINT, tuple(rest), float(degrees.max()), shifts)
        return [ErrorCause(finding, likely + self._rare(Kind.PRINCIPAL_POINT), self.given)]

    def relaxed(self) -> Views:
        """The cameras with the small errors that are likely in all of them."""
        V, which = len(self.given), [TURN[2], *CENTRE, *FOCAL]
        directions = np.concatenate(
            [self.residuals.camera(view, which) for view in range(V)], axis=1
        )
        sigma = np.array([np.append(_EVERY, self._usual(view)[which[1:]] / 5) for view in range(V)])
        change = np.zeros((V, Q))
        change[:, which] = self._likelihood(directions, sigma.ravel())[1].reshape(V, -1)
        return changed(self.given, change)

    def off(self, usual: Array, reference: int | None = None) -> float:
        """Probability that cameras, except `reference`, have errors of about `usual` (Q,) standard
        deviations; the prior is 0.5.
        """
        which = np.flatnonzero(usual).tolist()
        views = [view for view in range(len(self.given)) if view != reference]
        directions = [self.residuals.camera(view, which) for view in views]
        likely, _ = self._likelihood(
            np.concatenate(directions, axis=1), np.tile(usual[which], len(views))
        )
        return float(1 / (1 + np.exp(min(self.as_they_are(None, self.given).log - likely, 700.0))))

    def _usual(self, view: int) -> Array:
        """(Q,) standard deviations of small mistakes of a camera's parameters."""
        seen = self.residuals.weight[:, :, view] > 0
        cTw = self.given.cTw[view, 2]
        depth = (
            float(np.median(self.residuals.points[seen] @ cTw[:3] + cTw[3])) if seen.any() else 1.0
        )
        return np.array(
            [_TURN] * 3 + [_MOVE * depth] * 3 + [_TURN * self.given.focal_px[view]] * 2 + [_FOCAL]
        )

    def _rare(self, kind: Kind) -> float:
        """Log prior probability of one kind of mistake of one camera."""
        frequency = _KNOCKED if kind in (Kind.TURNED, Kind.MOVED) else 1
        return float(np.log(_WRONG * frequency / (len(self.given) * (len(ONE) + 2 * _KNOCKED))))


def probable(causes: list[ErrorCause]) -> list[ErrorCause]:
    """Mutually exclusive causes, most probable first, with the probability of each finding."""
    total = np.logaddexp.reduce([each.log for each in causes])
    ranked = list[ErrorCause]()
    for each in sorted(causes, key=lambda each: -each.log):
        probability = float(np.exp(each.log - total))
        ranked.append(
            replace(
                each,
                finding=None
                if each.finding is None
                else replace(each.finding, probability=probability),
            )
        )
    return ranked


def _between(given: Views, views: Views, view: int) -> Array:
    """(Q,) change (`parameters.changed`) from a camera in `given` to that in `views`."""
    turn = log_so3(views.cTw[view, :, :3] @ given.cTw[view, :, :3].T)
    move = views.cTw[view, :, 3] - exp_so3(turn[None])[0] @ given.cTw[view, :, 3]
    centre = (views.K - given.K)[view, :2, 2]
    return np.array([*turn, *move, *centre, np.log(views.K[view, 0, 0] / given.K[view, 0, 0])])


def named(kind: Kind, view: int, given: Views, views: Views) -> Finding:
    """The finding for a change of a single camera: the calibration's value relative to the fitted
    one.
    """
    if kind == Kind.FOCAL:
        return Finding(kind, (view,), float(given.K[view, 0, 0] / views.K[view, 0, 0]))
    if kind == Kind.PRINCIPAL_POINT:
        x, y = (views.K - given.K)[view, :2, 2].tolist()
        degrees = float(np.rad2deg(np.hypot(x, y) / views.focal_px[view]))
        return Finding(kind, (view,), degrees, ((x, y),))
    turn, moved = difference(given.cTw[view], views.cTw[view])
    # Rotation, degrees, above which a translated and rotated camera is called rotated.
    kind = Kind.TURNED if turn > 1.0 else kind
    return Finding(kind, (view,), float(turn), moved=float(moved))
