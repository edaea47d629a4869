"""Cameras that fit in one part of a recording only: bumped or drifting.

Where a camera's score changes most, the recording is split. A rotation is fitted to the part with
the lower score, as a step and as a linear drift, and compared by likelihood with one rotation for
the whole recording.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.cameras import resection
from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.parameters import POSE, TURN
from shapepose_fg.cameras.resection import Others, independent, likelihood, match
from shapepose_fg.cameras.sightings import GATE, Pinhole, Sightings
from shapepose_fg.core.arrays import Array, Index

_RESTLESS = 0.1
"""Difference of a camera's score between parts above which it is examined: 3 cm on people."""
_LEAST_DEG = 1.2
"""Minimum step or drift, degrees; smaller ones may be detector errors that depend on people's
orientation."""
_SURE = 6.0
"""Minimum gain in log-likelihood over the best constant rotation."""
_ROUNDS = 2
"""Number of rounds in which a rotation and its matches are fitted alternately."""
_PARTED, _POOR = 0.3, 0.5
"""Criteria for two cameras, with rays that only need to intersect, to stop agreeing: the drop of
the score, and the maximum score after it."""


@dataclass(frozen=True)
class Parting:
    """Split of a recording into two parts, in which a camera fits differently well."""

    at: int
    """First frame of the second part."""
    before: float
    after: float
    """Score of the first and of the second part (`resection.Match.score`)."""

    @property
    def drop(self) -> float:
        """Difference of the scores."""
        return abs(self.before - self.after)

    @property
    def frames(self) -> tuple[int | None, int | None]:
        """The part with the lower score (`Finding.frames`)."""
        return (self.at, None) if self.after < self.before else (None, self.at)


def parting(one: Index, other: Index, frame: Index, error: Array) -> Parting | None:
    """The split at which the score changes most, for matches in frames `frame` (E,) with errors
    (E,), of people in the frames `one` and `other`; None with too few people.
    """
    frames = np.intersect1d(one, other)
    if len(frames) < 2:
        return None
    possible = np.cumsum(
        np.minimum(*((each[:, None] == frames).sum(axis=0) for each in (one, other)))
    )
    fits = np.cumsum((1 - error / GATE) @ (frame[:, None] == frames))
    possible, rest, fits, left = (
        possible[:-1],
        (possible[-1] - possible)[:-1],
        fits[:-1],
        (fits[-1] - fits)[:-1],
    )
    before, after = fits / possible, left / rest
    # Minimum number of people in each part of a recording, and minimum share of all.
    enough = np.minimum(possible, rest) >= max(6, 0.1 * (possible + rest)[0])
    if not enough.any():
        return None
    n = int(np.argmax(np.where(enough, np.abs(before - after) * np.sqrt(possible * rest), 0.0)))
    return Parting(int(frames[n + 1]), float(before[n]), float(after[n]))


def parting_of(setup: SetupHypothesis, view: int) -> Parting | None:
    """The split of a recording at which a camera's score for the others' people changes most."""
    others, seen = setup.others(view), setup.seen_by(view)
    found = match(others, seen, setup.camera(view))
    return parting(others.frame, seen.frame, others.frame[found.person], found.error)


def parted(setup: SetupHypothesis) -> tuple[int | None, int | None] | None:
    """The frames in which two cameras disagree though they agree in the others; for more cameras
    see `motions`.
    """
    views = np.unique(setup.sightings.view).tolist()
    if len(views) != 2:
        return None
    groups, _ = setup.pair(*views)
    one, other = (setup.seen_by(view).frame for view in views)
    found = parting(one, other, groups.frame, groups.error)
    if found is None or found.drop < _PARTED or min(found.before, found.after) > _POOR:
        return None
    return found.frames


def warped(seen: Sightings, camera: Pinhole, turns: Array) -> Sightings:
    """Sightings as `camera` would have them without the rotations `turns` (S, 3), vectors about its
    own axes.
    """
    back = camera.K @ exp_so3(-turns) @ np.linalg.inv(camera.K)
    h = np.einsum("sij,snj->sni", back[:, :, :2], seen.xy) + back[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(h[..., 2:] > 0, h[..., :2] / h[..., 2:], np.nan)
    return replace(seen, xy=xy, confidence=np.where(np.isnan(xy[..., 0]), 0.0, seen.confidence))


Share = Callable[[Index], Array]
"""Function from frames (S,) to the shares (S,) of a rotation that a camera has in them."""


def motions(
    setup: SetupHypothesis, view: int, rng: np.random.Generator
) -> Iterator[tuple[Finding, SetupHypothesis, int]]:
    """Findings on motions of one camera over time that explain its sightings better than a constant
    pose.

    Each comes with the corrected set-up, and the number of parameters.
    """
    split = parting_of(setup, view)
    if split is None or split.drop < _RESTLESS:
        return
    others, seen, camera = setup.others(view), setup.seen_by(view), setup.camera(view)
    count = independent(others)
    before = likelihood(match(others, seen, camera).score, count, 0)
    for columns in (TURN, POSE):
        lasting = match(others, seen, resection.refined(others, seen, camera, columns)).score
        before = max(before, likelihood(lasting, count, len(columns)))
    ends, late = np.intersect1d(others.frame, seen.frame)[[0, -1]], split.after < split.before

    def bumped(frame: Index) -> Array:
        return ((frame >= split.at) == late).astype(np.float64)

    def drifted(frame: Index) -> Array:
        along = (frame - ends[0]) / (ends[1] - ends[0])
        return np.asarray(along if late else 1 - along)

    for finding, share, freedom in (
        (Finding(Kind.BUMPED, (view,), frames=split.frames), bumped, 4),
        (Finding(Kind.DRIFTING, (view,)), drifted, 3),
    ):
        turn = _turn(others, seen, camera, share, rng)
        after = match(others, warped(seen, camera, share(seen.frame)[:, None] * turn), camera).score
        gain = likelihood(after, count, freedom) - before
        amount = float(np.rad2deg(np.linalg.norm(turn)))
        if gain > _SURE and amount > _LEAST_DEG:
            yield replace(finding, amount=amount), _as_if_still(setup, view, share, turn), freedom


def _as_if_still(setup: SetupHypothesis, view: int, share: Share, turn: Array) -> SetupHypothesis:
    """The set-up corrected for the `share` of a rotation that a camera has in each frame."""
    return setup.seeing(
        view,
        lambda seen: warped(
            seen, setup.camera(view), share(seen.frame - setup.lag[view])[:, None] * turn
        ),
    )


def _turn(
    others: Others, seen: Sightings, camera: Pinhole, share: Share, rng: np.random.Generator
) -> Array:
    """(3,) the rotation of which the camera has a share in each frame, started at that of single
    people.
    """
    near, far = others.rows(share(others.frame) > 0.5), seen.rows(share(seen.frame) > 0.5)
    if min(len(near), len(far)) == 0:
        return np.zeros(3)
    shares = share(far.frame)
    sole = resection.best_of(
        near, far, camera, list(resection.tries(near, far, rng)), resection.turned_to
    )
    turn = np.zeros(3) if sole is None else _turn_between(camera, sole) / shares.mean()
    for _ in range(_ROUNDS):
        still = warped(far, camera, shares[:, None] * turn)
        turn = (
            turn
            + _turn_between(camera, resection.refined(near, still, camera, TURN)) / shares.mean()
        )
    return turn


def _turn_between(camera: Pinhole, other: Pinhole) -> Array:
    """(3,) rotation vector from one camera to another."""
    return log_so3(other.cTw[:, :3] @ camera.cTw[:, :3].T)
