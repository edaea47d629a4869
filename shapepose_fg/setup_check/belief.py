"""Whom to believe: cameras that a reconstruction is better without, and cameras that contradict each other."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.trust import Spell, Trust
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.findings import Finding, Kind
from shapepose_fg.setup_check.fit import match

_WORSE = 0.2
"""A camera is left out whose score is so much lower than it would be if it was right: it sees people 3 % of their
size, 5 cm, beside where it should, on average."""
_OF_PEOPLE = (Kind.UNIT, Kind.UP, Kind.PICTURE_SIZE, Kind.STOPPED, Kind.CROWDED)
"""What is wrong with all cameras alike, or hardly matters, or is seen to elsewhere."""


def trust_of(findings: Sequence[Finding], given: Look, right: Look, frames: range) -> Trust:
    """What is believed of cameras as they were `given`, after `findings`; `right` is without these mistakes."""
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
        first, last = (end if said is None else said for said, end in zip(each.frames, whole, strict=True))
        if given.cameras_used == 2 or len(views) >= given.cameras_used:  # nothing says which of them is wrong
            return Trust(doubted=tuple((view, first, last) for view in range(given.view_count)))
        sure = each.kind in (Kind.UNFIT, Kind.DUPLICATE)
        wrong += [(v, first, last) for v in views if sure or _worse(given, right, v, range(first, last))]
    seeing = set(np.unique(given.sightings.view).tolist())
    if doubted or (len(wrong) > 0 and len(seeing - {view for view, _, _ in wrong}) < 2):
        everybody = tuple((view, frames.start, frames.stop) for view in range(given.view_count))
        return Trust(doubted=everybody)
    return Trust(tuple(wrong))


def _worse(given: Look, right: Look, view: int, frames: range) -> bool:
    """Whether a camera sees people of the others far from where it would if it was right."""
    others = right.others(view)
    others = others.rows((others.frame >= frames.start) & (others.frame < frames.stop))
    was, now = (
        match(others, look.seen_by(view, every_frame=True), look.camera(view)).score for look in (given, right)
    )
    return now - was > _WORSE
