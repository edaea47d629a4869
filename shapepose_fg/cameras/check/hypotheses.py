"""Hypotheses on gross mistakes of a set-up, each tested as a correction."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from shapepose_fg.cameras import resection
from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import SURE, Finding, Kind, one_of
from shapepose_fg.cameras.check.lags import lag_of
from shapepose_fg.cameras.check.over_time import motions
from shapepose_fg.cameras.check.small_errors import ONE, SmallErrors, named, probable
from shapepose_fg.cameras.parameters import CENTRE, FOCAL, POSE, TURN
from shapepose_fg.cameras.resection import ERROR, independent, likelihood, match
from shapepose_fg.cameras.sightings import GATE, Pinhole, Sightings
from shapepose_fg.core.arrays import Array, Index

_MISREAD: dict[Kind, Callable[[Array, Array], tuple[Array, Array]]] = {
    Kind.INVERTED: lambda R, t: (R.T, -R.T @ t),
    Kind.TRANSPOSED: lambda R, t: (R.T, t),
    Kind.AXES: lambda R, t: (np.diag([1.0, -1.0, -1.0]) @ R, t * (1.0, -1.0, -1.0)),
}
"""Effect of common misinterpretations of a pose from a file, of one camera or of all."""
_FITTED: tuple[tuple[Kind, resection.Fitted, list[int]], ...] = (
    (Kind.TURNED, resection.turned_to, TURN),
    (Kind.MOVED, resection.posed_to, POSE),
    (Kind.PRINCIPAL_POINT, resection.centred_to, CENTRE),
    (
        Kind.FOCAL,
        lambda points, xy, camera: resection.scaled_to(points, xy, camera, camera.K[:2, 2]),
        FOCAL,
    ),
    (
        Kind.RESIZED,
        lambda points, xy, camera: resection.scaled_to(points, xy, camera, resection.CORNER),
        [],
    ),
)
"""Corrections of one camera: an exact fit to one person, then `parameters.PARAMETERS` fitted to
all."""

GOOD = 0.45
"""Score for the others' people above which a camera's pose is correct, except for small errors."""
GOOD_PAIR = 0.65
"""Score above which two cameras fit each other; it is higher, because rays only need to intersect:
correct pairs had 0.67 and more, and most pairs with a mirrored camera, or one rotated by 8 degrees
half-way, less."""
GAIN, _LIKELY = 0.12, 10.0
"""Minimum gain of a change in a camera's score, and in log-likelihood."""
_FEW_FRAMES = 40
"""Number of frames that are sufficient for mistakes of all cameras."""
_EXPLAINED = 0.65
"""Total score above which no other explanation than detector errors is searched for."""
_PENALTY = 0.02
"""Minimum gain in score per fitted parameter: half a centimetre of a person's joints is 0.02."""


@dataclass(frozen=True)
class Change:
    """A change of the set-up, and its effect."""

    finding: Finding
    """The mistake that the change corrects."""
    setup: SetupHypothesis
    """The set-up after the change."""
    freedom: int = 0
    """Number of fitted parameters."""
    fitted: Kind | None = None
    """Fitted kind of one camera (`small_errors.ONE`), if any."""


def mistake_of_cameras(setup: SetupHypothesis, rng: np.random.Generator) -> Change | None:
    """The change that best explains why cameras see different people; None if they agree or nothing
    explains it.
    """
    fits = setup.scores
    weak = np.flatnonzero(fits < (GOOD if setup.view_count > 2 else GOOD_PAIR)).tolist()
    tried: list[Change] = []
    for view in weak:
        count = independent(setup.others(view))
        least = likelihood(fits[view], count, 0) + _LIKELY
        options = [(score_of(setup, each), each) for each in _of_one(setup, view, rng)]
        options = [
            (score, each)
            for score, each in options
            if score - fits[view] > GAIN and likelihood(score, count, each.freedom) > least
        ]
        options.sort(key=lambda option: option[0] - _PENALTY * option[1].freedom, reverse=True)
        tried += [each for _, each in options if not _slight(each.finding)][:4]
    for first, second in combinations(weak, 2):
        cameras = {first: setup.camera(second), second: setup.camera(first)}
        change = Change(Finding(Kind.EXCHANGED, (first, second)), setup.with_cameras(cameras))
        if setup.view_count == 3 or (
            score_of(setup, change) - max(fits[first], fits[second]) > GAIN
        ):
            tried.append(change)
    if setup.view_count == 2 and len(weak) > 0:
        tried += [_misread(setup, kind, (view,)) for view in (0, 1) for kind in _MISREAD]
        tried += [change for view in (0, 1) for change in _in_mirror(setup, view)]
    found = [(judged(setup, change), change) for change in tried]
    best = max((gain for gain, _ in found), default=0.0) + setup.total
    misfits = [view for view in weak if setup.score_without_biases(view) < GOOD]
    if len(misfits) > setup.view_count / 2 and best < _EXPLAINED:
        thinned = replace(setup, evidence=setup.evidence.thinned(_FEW_FRAMES))
        found += [
            (
                judged(thinned, change),
                replace(change, setup=replace(change.setup, evidence=setup.evidence)),
            )
            for change in _of_all(thinned)
        ]
    found = [(gain, change) for gain, change in found if gain > GAIN / setup.view_count]
    # A camera that moves by little is looked for among all, once none is far off.
    for view in (weak or range(setup.view_count)) if setup.cameras_used > 2 else ():
        changes = [
            Change(finding, after, freedom) for finding, after, freedom in motions(setup, view, rng)
        ]
        found += [(judged(setup, change), change) for change in changes]
    return _likeliest(setup, found)


def _likeliest(setup: SetupHypothesis, found: list[tuple[float, Change]]) -> Change | None:
    """The best of the changes with scores of `judged`, with its probability and alternatives.

    A change that moves a camera must be more probable than biases of the detector, else it is
    rejected.
    """
    if len(found) == 0:
        return None
    # Evidence counts all independent joints of people and cameras.
    gains = np.array([gain for gain, _ in found]) * GATE / ERROR
    gains *= setup.view_count * max(
        independent(setup.others(view)) for view in range(setup.view_count)
    )
    weights = np.exp(gains - gains.max()) / np.exp(gains - gains.max()).sum()
    changes = [
        replace(change, finding=replace(change.finding, probability=float(weight)))
        for weight, (_, change) in sorted(
            zip(weights, found, strict=True), key=lambda each: -each[0]
        )
    ]
    best, (view, *_) = changes[0], changes[0].finding.cameras
    if best.setup.evidence is not setup.evidence or best.setup.lag is not setup.lag:
        return replace(best, finding=one_of([each.finding for each in changes]))
    # Which parameters of a camera are wrong is decided on single joints, with the people's
    # positions free.
    rivals = [
        each
        for each in changes
        if each.fitted is not None and each.finding.cameras == best.finding.cameras
    ]
    problem = SmallErrors.of(best.setup, setup.views)
    if best.fitted is None:
        of_camera = [problem.as_they_are(best.finding, best.setup.views)]
    else:
        starts = {
            each.fitted: each.setup.views for each in reversed(rivals) if each.fitted is not None
        }
        of_camera = problem.explained(view, starts)
    causes = probable([problem.as_they_are(None, setup.views), *problem.biases(), *of_camera])
    mistakes = [
        (each.finding, each.views)
        for each in causes
        if each.finding is not None and each.person < 0
    ]
    p_mistake = sum(finding.probability for finding, _ in mistakes)
    if p_mistake < SURE:
        return _likeliest(
            setup, [each for each in found if each[1].finding.cameras != best.finding.cameras]
        )
    if best.fitted is not None:
        share = sum(each.finding.probability for each in rivals) / p_mistake
        fitted = [
            replace(
                best,
                finding=replace(f, probability=f.probability * share),
                setup=replace(setup, views=views),
            )
            for f, views in mistakes
        ]
        changes = fitted + [each for each in changes if each not in rivals]
    return replace(changes[0], finding=one_of([each.finding for each in changes]))


def _slight(finding: Finding) -> bool:
    """Whether a scale change is too small for a gross mistake: no pictures are resized by 4 %."""
    return finding.kind in (Kind.FOCAL, Kind.RESIZED) and abs(np.log(finding.amount)) < 0.08


def judged(setup: SetupHypothesis, change: Change) -> float:
    """Gain in total score by a change, less the penalty for its parameters."""
    return change.setup.total - setup.total - _PENALTY * change.freedom / setup.view_count


def score_of(setup: SetupHypothesis, change: Change) -> float:
    """Lowest score of the changed cameras for the people that all others see (`Match.score`); 0 if
    the others see none.
    """
    others = setup.others(*change.finding.cameras)
    return min(
        match(others, change.setup.seen_by(view), change.setup.camera(view)).score
        for view in change.finding.cameras
    )


def _of_one(setup: SetupHypothesis, view: int, rng: np.random.Generator) -> Iterator[Change]:
    """Changes of one camera that fit it to the people of the others, the best of each kind."""
    others, seen, camera = setup.others(view), setup.seen_by(view), setup.camera(view)
    if len(others) == 0 or len(seen) == 0:
        return
    for kind in _MISREAD:
        yield _misread(setup, kind, (view,))
    yield from _in_mirror(setup, view)
    yield _with_other_sides(setup, view)
    lag = lag_of(setup, view).frames
    yield Change(Finding(Kind.LATE, (view,), lag), setup.later(view, lag), 1)
    pairs = list(resection.tries(others, seen, rng))
    for kind, fitted, columns in _FITTED:
        best = resection.best_of(others, seen, camera, pairs, fitted)
        if best is None:
            continue
        best = resection.refined(others, seen, best, columns) if columns else best
        after = setup.with_cameras({view: best})
        if kind == Kind.RESIZED:
            finding = Finding(kind, (view,), float(best.K[0, 0] / camera.K[0, 0]))
        else:
            finding = named(kind, view, setup.views, after.views)
        # Cameras are bumped more often than lenses change: a shift must not win by having one
        # parameter less.
        freedom = len(TURN) if kind == Kind.PRINCIPAL_POINT else max(len(columns), 1)
        yield Change(finding, after, freedom, kind if kind in ONE else None)


def _in_mirror(setup: SetupHypothesis, view: int) -> list[Change]:
    """Mirrored pictures of one camera: before detection, which exchanges left and right, or
    afterwards.
    """
    width = np.broadcast_to(setup.views.image_sizes, (setup.view_count, 2))[view, 0]

    def mirrored(seen: Sightings, joints: Index) -> Sightings:
        xy = seen.xy[:, joints]
        xy[..., 0] = width - 1 - xy[..., 0]
        return replace(seen, xy=xy, confidence=seen.confidence[:, joints])

    side = setup.evidence.other_side
    changed = [
        setup.seeing(view, partial(mirrored, joints=each)) for each in (side, np.arange(len(side)))
    ]
    return [Change(Finding(Kind.MIRRORED, (view,)), each) for each in changed]


def _with_other_sides(setup: SetupHypothesis, view: int) -> Change:
    """The left and right joints of one camera's people exchanged, as a detector does that takes
    backs for fronts.
    """
    side = setup.evidence.other_side
    changed = setup.seeing(
        view, lambda seen: replace(seen, xy=seen.xy[:, side], confidence=seen.confidence[:, side])
    )
    return Change(Finding(Kind.SIDES, (view,)), changed)


def _of_all(setup: SetupHypothesis) -> Iterator[Change]:
    """Mistakes common to all cameras."""
    everybody = tuple(range(setup.view_count))
    for kind in _MISREAD:
        yield _misread(setup, kind, everybody)
    # Factors of picture sizes that are tested for all cameras.
    for factor in (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0):
        cameras = {
            view: resection.scaled(setup.camera(view), factor, resection.CORNER)
            for view in everybody
        }
        yield Change(Finding(Kind.RESIZED, everybody, factor), setup.with_cameras(cameras))


def _misread(setup: SetupHypothesis, kind: Kind, views: tuple[int, ...]) -> Change:
    """Misinterpreted poses of some cameras."""
    cameras = {view: misread(kind, setup.camera(view)) for view in views}
    return Change(Finding(kind, views), setup.with_cameras(cameras))


def misread(kind: Kind, camera: Pinhole) -> Pinhole:
    """The camera with its pose after a common misinterpretation."""
    R, t = _MISREAD[kind](camera.cTw[:, :3], camera.cTw[:, 3])
    return Pinhole(camera.K, np.column_stack([R, t]))
