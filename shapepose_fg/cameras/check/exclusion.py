"""Decides which cameras a reconstruction must exclude, and which contradict each other without a
clear culprit.
"""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.resection import match
from shapepose_fg.core.trust import Spell, Trust

_WORSE = 0.2
"""Drop of a camera's score, against the corrected camera, above which it is excluded: it sees
people 3 % of their size, 5 cm, from where it should, on average."""
_OF_PEOPLE = (Kind.UNIT, Kind.UP, Kind.PICTURE_SIZE, Kind.STOPPED, Kind.CROWDED, Kind.SIDES)
"""Kinds of findings that exclude no camera: they affect all alike, matter little, or are handled
elsewhere."""


def trust_of(
    findings: Sequence[Finding], given: SetupHypothesis, right: SetupHypothesis, frames: range
) -> Trust:
    """Decide from `findings` which cameras are left out or doubted, in which of the `frames`.

    `given` is the recording with the cameras as given, `right` with the found mistakes corrected.
    """
    wrong: list[Spell] = []
    whole = frames.start, frames.stop
    doubted = False
    for each in findings:
        if each.kind in _OF_PEOPLE or (each.kind == Kind.PRINCIPAL_POINT and len(each.cameras) > 1):
            continue
        if each.kind == Kind.NOBODY:
            doubted |= len(each.cameras) == 0 and each.amount > 0
            continue
        views = each.cameras
        if len(views) == given.view_count > 2 and each.kind != Kind.UNFIT:
            continue
        if each.kind == Kind.DUPLICATE:
            views = (min(each.cameras[::-1], key=lambda view: given.scores[view] - 1e-6 * view),)
        first, last = (
            end if bound is None else bound for bound, end in zip(each.frames, whole, strict=True)
        )
        if given.cameras_used == 2 or len(views) >= given.cameras_used:  # the culprit is unknown
            return Trust(doubted=tuple((view, first, last) for view in range(given.view_count)))
        always = each.kind in (Kind.UNFIT, Kind.DUPLICATE)
        wrong += [
            (v, first, last) for v in views if always or _worse(given, right, v, range(first, last))
        ]
    seeing = set(np.unique(given.sightings.view).tolist())
    if doubted or (len(wrong) > 0 and len(seeing - {view for view, _, _ in wrong}) < 2):
        everybody = tuple((view, frames.start, frames.stop) for view in range(given.view_count))
        return Trust(doubted=everybody)
    return Trust(tuple(wrong))


def _worse(given: SetupHypothesis, right: SetupHypothesis, view: int, frames: range) -> bool:
    """Whether the camera's score for the others' people is much lower than with the mistakes
    corrected.
    """
    others = right.others(view)
    others = others.rows((others.frame >= frames.start) & (others.frame < frames.stop))
    was, now = (
        match(others, setup.seen_by(view, every_frame=True), setup.camera(view)).score
        for setup in (given, right)
    )
    return now - was > _WORSE
