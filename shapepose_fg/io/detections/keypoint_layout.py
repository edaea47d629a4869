"""Which joints the keypoints of people are: as the user says, as the files say, or as their number allows."""

from collections.abc import Sequence

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import body_points, keypoint_names, layouts_called, skeleton_of_names
from shapepose_fg.core.skeleton import BODY_25, SKELETONS, Skeleton
from shapepose_fg.io.camera_names import listing
from shapepose_fg.io.detections.people import CameraPeople, DeclaredJoints, KeptPeople

_CURE = "name the detector's own with --skeleton"


def skeleton_of_people(
    people: Sequence[KeptPeople], wanted: Skeleton | None = None, declared: DeclaredJoints | None = None
) -> tuple[Skeleton, list[str]]:
    """The skeleton that the people of all cameras have, and what is to be said of how it was found.

    What the user `wanted` goes before the names in the files, these before what a project's settings `declared`,
    and this before the number of keypoints. InputError where cameras or names contradict each other.
    """
    counted = _one_count(people)
    if counted is None:
        return wanted or BODY_25, []
    count, camera = counted
    place = f"{camera.source}: recognised as {camera.program} with {count} keypoints a person"
    named, notes = _named_in_files(people, count)
    if wanted is not None:
        if wanted.keypoint_count != count:
            raise InputError(f"{place}, but {wanted.name} has {wanted.keypoint_count}; name its own")
        if named is not None and keypoint_names(named[0]) != keypoint_names(wanted):
            return wanted, [f"{named[1]}, but they are read as {wanted.name}, as you said"]
        return wanted, []
    if named is not None:
        skeleton, who, passed = named
        over = [f"joints that the body does not have are passed over: {listing(passed)}"] if passed else []
        return skeleton, [f"joints are those of {skeleton.name}: {who}", *over]
    if declared is not None:
        found, what = _declared(declared, count)
        if found is not None:
            return found[0], [*notes, f"joints are those of {found[0].name}: {what}"]
        notes.append(what)
    alike = [each for each in SKELETONS.values() if each.keypoint_count == count]
    if len(alike) == 0:
        known = ", ".join(f"{each.keypoint_count} ({each.name})" for each in SKELETONS.values())
        problem = "which is not known here"
        raise InputError(f"{place}, {problem}; describe them in a --skeleton file; known are {known}")
    others = f" ({' '.join(each.name for each in alike[1:])} would have as many)" if len(alike) > 1 else ""
    notes.append(f"{count} keypoints a person and no names of joints: taken as those of {alike[0].name}{others}")
    return alike[0], notes


def _one_count(people: Sequence[KeptPeople]) -> tuple[int, CameraPeople] | None:
    """How many keypoints a person has, and the first camera with people; None without people."""
    counts: dict[int, CameraPeople] = {}
    for each in people:
        if each.keypoint_count is not None:
            counts.setdefault(each.keypoint_count, each.camera)
    if len(counts) > 1:
        (one, first), (other, second) = list(counts.items())[:2]
        raise InputError(
            f"{first.source} has people of {one} keypoints, {second.source} of {other}; give the detections of one"
            " model for all cameras"
        )
    return next(iter(counts.items()), None)


def _named_in_files(
    people: Sequence[KeptPeople], count: int
) -> tuple[tuple[Skeleton, str, list[str]] | None, list[str]]:
    """The skeleton that the files name, how, and which names are passed over; None where none names any, and what
    is to be said of names that tell nothing.

    InputError where files of two cameras name different joints, or names that cannot be those of the keypoints.
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
                f"{camera.source} names other joints than {found[3].source} ({named[0].name}, {found[0].name});"
                " give the detections of one model for all cameras"
            )
        found = found or (named[0], what, named[1], camera)
    return (None if found is None else found[:3]), [f"the file{each}" for each in notes]


def _declared(declared: DeclaredJoints, count: int) -> tuple[tuple[Skeleton, list[str]] | None, str]:
    """`_called` of what a project's settings say: they need not name all keypoints, and may be of others."""
    joints = declared.joints
    if not isinstance(joints, str):
        if len(joints) > count:
            return None, f"{declared.source} names keypoint {len(joints) - 1}, and people have {count}"
        joints += ("",) * (count - len(joints))
    return _called(joints, count, declared.source)


def _called(
    joints: str | tuple[str, ...], count: int, source: str
) -> tuple[tuple[Skeleton, list[str]] | None, str]:
    """The skeleton that a source names for `count` keypoints, with the names that are passed over, and a sentence
    about it; None where it names none that is known, or none of so many keypoints.

    InputError where it names each joint, and not so many, or not those that a person needs.
    """
    if isinstance(joints, str):
        layouts = layouts_called(joints)
        fit = [each for each in layouts if each.keypoint_count == count]
        if fit:
            return (fit[0], []), f"{source} says {joints[:40]}"
        has = f"have {layouts[0].keypoint_count} keypoints, not {count}" if layouts else "are not known here"
        return None, f"{source} says {joints[:40]}, which {has}"
    if not any(body_points(joints)):
        return None, f"{source} names joints that are not known here, such as {joints[0][:40]!r}"
    if len(joints) != count:
        raise InputError(
            f"{source} names {len(joints)} joints, and its people have {count} keypoints; correct the names, or"
            f" {_CURE}"
        )
    try:
        return skeleton_of_names(joints), f"{source} names its joints"
    except ValueError as error:
        raise InputError(f"{source} names joints, but {str(error).partition(': ')[2]}; {_CURE}") from None
