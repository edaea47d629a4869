"""Determines the joint of each keypoint: from the user, from names in the files, or from the number
of keypoints.
"""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import (
    body_points,
    keypoint_names,
    layouts_called,
    skeleton_of_names,
)
from shapepose_fg.core.skeleton import BODY_25, SKELETONS, Skeleton
from shapepose_fg.io.camera_names import listing
from shapepose_fg.io.detections.people import CameraPeople, DeclaredJoints, KeptPeople

_CURE = "name the detector's layout with --skeleton"
_SPREAD, _SIGMAS = 0.5, 2.5
"""`_SPREAD`: assumed standard deviation of a person's fit, in addition to the observed one, nats
per pair of joints; it is needed because a few similar people are weak evidence. `_SIGMAS`: standard
deviations that a decision requires. Layouts differ by 0.7 to 1.7 nats; some that differ in only two
joints, by 0.07."""


def skeleton_of_people(
    people: Sequence[KeptPeople],
    wanted: Skeleton | None = None,
    declared: DeclaredJoints | None = None,
) -> tuple[Skeleton, list[str]]:
    """The skeleton of the people of all cameras, and notes on how it was found.

    In order of precedence: the user's `wanted`, names in the files, the project's settings
    `declared`, the number of keypoints. InputError if cameras or names contradict each other.
    """
    counted = _one_count(people)
    if counted is None:
        return wanted or BODY_25, []
    count, camera = counted
    place = f"{camera.source}: recognised as {camera.program} with {count} keypoints per person"
    named, notes = _named_in_files(people, count)
    if wanted is not None:
        if wanted.keypoint_count != count:
            raise InputError(
                f"{place}, but {wanted.name} has {wanted.keypoint_count}; name the right layout"
            )
        if named is not None and keypoint_names(named[0]) != keypoint_names(wanted):
            return wanted, [f"{named[1]}, but they are read as {wanted.name}, as requested"]
        return wanted, []
    if named is not None:
        skeleton, source, passed = named
        over = (
            [
                (
                    "joints that the body does not have are ignored: "
                    f"{listing([_shown(each) for each in passed])}"
                )
            ]
            if passed
            else []
        )
        return skeleton, [f"joints are those of {skeleton.name}: {source}", *over]
    if declared is not None:
        found, what = _declared(declared, count)
        if found is not None:
            return found[0], [*notes, f"joints are those of {found[0].name}: {what}"]
        notes.append(what)
    layouts = [each for each in SKELETONS.values() if each.keypoint_count == count]
    if len(layouts) == 0:
        known = ", ".join(f"{each.keypoint_count} ({each.name})" for each in SKELETONS.values())
        problem = "which is not a known layout"
        raise InputError(
            f"{place}, {problem}; describe the layout in a --skeleton file; known layouts are "
            f"{known}"
        )
    found, why = (layouts[0], "") if len(layouts) == 1 else _best_fit(people, layouts)
    note = f"{count} keypoints per person without joint names: read as {found.name}{why}"
    return found, [*notes, note]


def _best_fit(people: Sequence[KeptPeople], layouts: Sequence[Skeleton]) -> tuple[Skeleton, str]:
    """The layout that people fit best among those with this number of keypoints, and the reason.

    The most common layout, the first, is used unless another fits significantly better. InputError
    if cameras significantly fit different layouts.
    """
    from shapepose_fg.body.joint_order import LIKE_A_BODY

    chosen: dict[str, CameraPeople] = {}
    usual, fits = layouts[0], list[Array]()
    for each in people:
        if each.keypoint_count is not None:
            # Maximum number of a camera's people that are compared with the
            # proportions of a body.
            fits.append(_fits(each.some(200), layouts))
            if (best := _significant_best(fits[-1])) is not None:
                chosen.setdefault(layouts[best].name, each.camera)
    if len(chosen) > 1:
        (one, first), (other, second) = list(chosen.items())[:2]
        raise InputError(
            f"{first.source}: the keypoints are arranged as {one}, those of {second.source} as "
            f"{other}; "
            f"give the detections of one model for all cameras, or {_CURE}"
        )
    fits_of_all = np.concatenate(fits, axis=1)
    best = _significant_best(fits_of_all)
    if best is None:
        if fits_of_all.shape[1] > 0 and fits_of_all.mean(axis=1).max() < LIKE_A_BODY:
            return usual, ", the most common layout, although people look like none of them"
        rivals = [
            each.name
            for each, fit in zip(layouts, fits_of_all, strict=True)
            if not _fits_better(fits_of_all[0] - fit)
        ]
        return (
            usual,
            f", the most common layout; people do not distinguish it from {', '.join(rivals[1:])}",
        )
    return layouts[best], ", because people look like it" + (
        f", not as {usual.name}" if best > 0 else ""
    )


def _fits(people: Array, layouts: Sequence[Skeleton]) -> Array:
    """(L, N) fit of people (N, K, 2) to each layout; people with too few joints are left out."""
    from shapepose_fg.body.joint_order import fit_of_order

    fits = np.array([fit_of_order(people, keypoint_names(each)) for each in layouts])
    return fits[:, np.isfinite(fits).all(axis=0)]


def _significant_best(fits: Array) -> int | None:
    """Index of the layout that people fit significantly best; None if this is not clear.

    `fits` (L, N) are the fits of N people to L layouts, of which the first is the most common one.
    The best other layout is returned if it is significantly better than the first, and 0 if the
    first is significantly better than all others.
    """
    from shapepose_fg.body.joint_order import LIKE_A_BODY

    if fits.shape[1] == 0 or fits.mean(axis=1).max() < LIKE_A_BODY:
        return None
    best = int(np.argmax(fits.mean(axis=1)))
    rivals = range(1, len(fits)) if best == 0 else range(1)
    return best if all(_fits_better(fits[best] - fits[rival]) for rival in rivals) else None


def _fits_better(more: Array) -> bool:
    """Whether people fit one layout significantly better than another; `more` (N,) are the
    differences of their fits.
    """
    return len(more) > 0 and bool(
        more.mean() > _SIGMAS * np.sqrt((more.var() + _SPREAD**2) / len(more))
    )


def _one_count(people: Sequence[KeptPeople]) -> tuple[int, CameraPeople] | None:
    """Number of keypoints per person, and the first camera with people; None without people."""
    counts: dict[int, CameraPeople] = {}
    for each in people:
        if each.keypoint_count is not None:
            counts.setdefault(each.keypoint_count, each.camera)
    if len(counts) > 1:
        (one, first), (other, second) = list(counts.items())[:2]
        raise InputError(
            f"{first.source} has people of {one} keypoints, {second.source} of {other}; give the "
            "detections of one model for all cameras"
        )
    return next(iter(counts.items()), None)


def _named_in_files(
    people: Sequence[KeptPeople], count: int
) -> tuple[tuple[Skeleton, str, list[str]] | None, list[str]]:
    """The skeleton that the files name, its source, and ignored names (None if no file has names);
    and notes on unknown names. InputError if files of two cameras name different joints, or if the
    names do not match the keypoints.
    """
    found: tuple[Skeleton, str, list[str], CameraPeople] | None = None
    notes = dict[str, None]()
    for camera in (each.camera for each in people if each.keypoint_count is not None):
        if camera.joints is None:
            continue
        named, what = _called(camera.joints, count, str(camera.source))
        if named is None:
            notes[what.removeprefix(str(camera.source))] = None
            continue
        if found is not None and keypoint_names(found[0]) != keypoint_names(named[0]):
            raise InputError(
                f"{camera.source} names other joints than {found[3].source} ({named[0].name}, "
                f"{found[0].name}); give the detections of one model for all cameras"
            )
        found = found or (named[0], what, named[1], camera)
    return (None if found is None else found[:3]), [f"the file{each}" for each in notes]


def _declared(
    declared: DeclaredJoints, count: int
) -> tuple[tuple[Skeleton, list[str]] | None, str]:
    """`_called` for a project's settings, which may name only some of the keypoints, or belong to
    other detections.
    """
    joints = declared.joints
    if not isinstance(joints, str):
        if len(joints) > count:
            return (
                None,
                (
                    f"{declared.source} names keypoint {len(joints) - 1}, but people have {count} "
                    "keypoints"
                ),
            )
        joints += ("",) * (count - len(joints))
    return _called(joints, count, declared.source)


def _called(
    joints: str | tuple[str, ...], count: int, source: str
) -> tuple[tuple[Skeleton, list[str]] | None, str]:
    """The skeleton that a source names for `count` keypoints, with ignored names, and a sentence
    about it; None if the layout is unknown or has another number of keypoints.

    InputError if each joint is named, but not `count` of them, or if required joints are missing.
    """
    if isinstance(joints, str):
        layouts = layouts_called(joints)
        fit = [each for each in layouts if each.keypoint_count == count]
        if fit:
            return (fit[0], []), f"{source} names {_shown(joints)}"
        has = (
            f"has {layouts[0].keypoint_count} keypoints instead of {count}"
            if layouts
            else "is no known layout"
        )
        return None, f"{source} names {_shown(joints)}, which {has}"
    if not any(body_points(joints)):
        return None, f"{source} names unknown joints, such as {_shown(joints[0])}"
    if len(joints) != count:
        raise InputError(
            f"{source} names {len(joints)} joints, but its people have {count} keypoints; "
            f"correct the names, or {_CURE}"
        )
    try:
        return skeleton_of_names(joints), f"{source} names its joints"
    except ValueError as error:
        raise InputError(
            f"{source} names joints, but {str(error).partition(': ')[2]}; {_CURE}"
        ) from None


def _shown(name: str) -> str:
    """A name from another file, made safe for a line of text."""
    return name[:40] if name.isprintable() and name else repr(name[:40])
