"""Tests the joint order of a recording's skeleton against the proportions of bodies.

Cameras agree on points whatever their names: a wrong order fits every calibration, but no body.
"""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.body.joint_order import LIKE_A_BODY, exchanges, fit_of_order
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.check.small_errors import MOST_PEOPLE
from shapepose_fg.cameras.resection import independent_poses
from shapepose_fg.cameras.sightings import MIN_SIGHTINGS, people_of
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.joint_names import keypoint_names
from shapepose_fg.core.skeleton import SKELETONS, Skeleton

_GAIN_OF_SIDES, _GAIN_OF_POSE = (0.02, 0.01), (0.15, 0.3)
"""Minimum gains in space and in pictures, nats per pair of joints: of an exchange of sides; and of
another exchange in a single pose, of which N independent poses must gain 1 / sqrt(N) on average. In
584 pieces of 1.5 s of motion capture, which are about one pose, the best exchange in space gains up
to 0.02 (sides), 0.04 (along a limb; 0.11 with a real detector) and 0.15 (others) over the right
order; undoing a true one gains 0.02 to 0.7. In pictures, one in 100 gains 0.3."""
_SHARE = 0.8
"""Minimum share of people who gain."""
_OTHER_LAYOUT = 0.1
"""Minimum gain of a known layout, nats per pair; correct ones gain 0.7 to 1.7, except between two
layouts that differ in two joints."""
_FACING = 0.25
"""Share of people facing forwards below which left and right are exchanged: 0.77 to 1 in motion
capture, 0.67 and more for real detections."""
_ARMS, _LEGS = ("Shoulder", "Elbow", "Wrist"), ("Hip", "Knee", "Ankle")


def order_of_joints(detections: DetectionSequence, setup: SetupHypothesis) -> list[Finding]:
    """Findings on the names of joints; `setup` has the set-up with other mistakes corrected."""
    skeleton = detections.skeleton
    pictures = _people(detections, setup, skeleton)
    layout = _other_layout(pictures, skeleton) if len(pictures) >= MIN_SIGHTINGS else None
    if layout is not None:
        return [Finding(Kind.JOINT_ORDER, (), joints=(layout, skeleton.name))]
    made = {joint for joint, _, _ in skeleton.middles}
    known = [joint not in made and skeleton.joints[joint] in BODY_POINTS for joint in skeleton.core]
    own = np.flatnonzero(known).tolist()
    names = [skeleton.joints[skeleton.core[place]] for place in own]
    flat = _some(setup.sightings.xy[:, own])
    space = _some(setup.structure()[1].points[:, own])
    # Minimum number of joints in trunk and limbs for any statement.
    if len(flat) < MIN_SIGHTINGS or len(own) < 7:
        return []
    in_space = np.isfinite(fit_of_order(space, names)).sum() >= MIN_SIGHTINGS
    order = exchanges(space if in_space else flat, names, _sides(names))
    poses = max(independent_poses(setup.seen_by(view).frame) for view in range(setup.view_count))
    if not _gains(flat, space if in_space else None, names, order, max(poses, 1.0)):
        order = list(range(len(names)))
    backwards = in_space and _backwards(space[:, order], names)
    if backwards:
        other = {"L": "R", "R": "L"}
        mirror = [other.get(name[0], "") + name[1:] for name in names]
        order = [
            order[names.index(name)] if name in names else order[n] for n, name in enumerate(mirror)
        ]
    if order == list(range(len(names))):
        return []
    return [Finding(Kind.JOINT_ORDER, (), joints=_words(names, order))]


def unlike_bodies(detections: DetectionSequence, setup: SetupHypothesis) -> list[Finding]:
    """The finding that people in pictures have no proportions of a body, in whatever order that was
    tested; none if they have.

    It explains an implausible stature or up axis better than the calibration does.
    """
    skeleton = detections.skeleton
    people = _people(detections, setup, skeleton)
    fits = fit_of_order(people, keypoint_names(skeleton)) if len(people) > 0 else np.zeros(0)
    fits = fits[np.isfinite(fits)]
    unlike = len(fits) >= MIN_SIGHTINGS and fits.mean() < LIKE_A_BODY
    return [Finding(Kind.JOINT_ORDER, (), joints=("",))] if unlike else []


def _words(names: Sequence[str], order: Sequence[int]) -> tuple[str, ...]:
    """The exchanged joints among the names (J) in words; entry k of `order` is the index of the
    true `names[k]`.
    """
    moved = {names[place]: names[k] for k, place in enumerate(order) if place != k}
    swapped = all(moved.get(to) == name for name, to in moved.items())
    pairs = [(name, to) for name, to in moved.items() if name < to]
    if swapped and all(name[1:] == to[1:] for name, to in pairs):
        sided = {name[1:] for name in names if f"R{name[1:]}" in names and f"L{name[1:]}" in names}
        parts = {name[1:] for name, _ in pairs}
        if parts == sided:
            return ("left and right",)
        return (
            "left and right "
            + _listed([part.lower() for part in (*_ARMS, *_LEGS) if part in parts]),
        )
    if swapped and len(pairs) <= 2:
        return (" as well as ".join(f"{name} and {to}" for name, to in pairs),)
    return ("",)


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _gains(
    flat: Array, space: Array | None, names: Sequence[str], order: Sequence[int], poses: float
) -> bool:
    """Whether people in so many independent `poses` fit a body significantly better with another
    order of their joints.

    Exchanges of sides or along a limb must be significant in pictures or in space. Joints with
    biased detections may fit any other order better in one of the two, so other exchanges must be
    significant in space, and gain in most pictures, too.
    """

    def gain(people: Array) -> tuple[float, float]:
        more = fit_of_order(people[:, order], names) - fit_of_order(people, names)
        more = more[np.isfinite(more)]
        return (
            (float(more.mean()), float((more > 0).mean()))
            if len(more) >= MIN_SIGHTINGS
            else (0.0, 0.0)
        )

    fits = fit_of_order(flat[:, order], names)
    fits = fits[np.isfinite(fits)]
    if len(fits) < MIN_SIGHTINGS or fits.mean() < LIKE_A_BODY:
        return False
    exchanged = [(names[place], names[k]) for k, place in enumerate(order) if place != k]
    least = np.array(_GAIN_OF_POSE) / poses**0.5
    if all(one[1:] == other[1:] for one, other in exchanged):
        least = np.array(_GAIN_OF_SIDES)
    in_picture, of_pictures = gain(flat)
    in_pictures = in_picture > least[1] and of_pictures > _SHARE
    if space is None:
        return in_pictures
    in_space, of_people = gain(space)
    in_spaces = in_space > least[0] and of_people > _SHARE
    if all(_alike(*pair) for pair in exchanged):
        return in_picture > 0 and in_space > 0 and (in_pictures or in_spaces)
    return in_spaces and in_picture > 0 and of_pictures > _SHARE


def _alike(one: str, other: str) -> bool:
    """Whether two joints are the two sides of one, or in one limb."""
    limb = one[0] == other[0] and any({one[1:], other[1:]} <= {*each} for each in (_ARMS, _LEGS))
    return limb or one[1:] == other[1:]


def _other_layout(people: Array, skeleton: Skeleton) -> str | None:
    """The known layout that fits people (N, K, 2) significantly better than the skeleton's; None
    for none.
    """
    own = keypoint_names(skeleton)
    found = fit_of_order(people, own)
    best, gain = None, _OTHER_LAYOUT
    for each in SKELETONS.values():
        if each.keypoint_count == len(own) and keypoint_names(each) != own:
            more = fit_of_order(people, keypoint_names(each)) - found
            more = more[np.isfinite(more)]
            significant = len(more) >= MIN_SIGHTINGS and (more > 0).mean() > _SHARE
            if significant and more.mean() > gain and np.nanmean(found) + more.mean() > LIKE_A_BODY:
                best, gain = each.name, float(more.mean())
    return best


def _backwards(points: Array, names: Sequence[str]) -> bool:
    """Whether knees, elbows and noses of people (P, J, 3) point backwards."""
    nowhere = np.full((len(points), 3), np.nan)

    def joint(name: str) -> Array:
        return points[:, names.index(name)] if name in names else nowhere

    shoulders, hips = (joint("R" + part) + joint("L" + part) for part in ("Shoulder", "Hip"))
    left = joint("LShoulder") - joint("RShoulder") + joint("LHip") - joint("RHip")
    ahead = np.cross(left, shoulders - hips)
    bends = [joint("Nose") - shoulders / 2]
    for side in "RL":
        bends.append(joint(side + "Knee") - (joint(side + "Hip") + joint(side + "Ankle")) / 2)
        bends.append((joint(side + "Shoulder") + joint(side + "Wrist")) / 2 - joint(side + "Elbow"))
    along = np.sum(np.array(bends) * ahead, axis=-1)
    seen = np.isfinite(along).sum(axis=0) >= 2
    forwards = np.nansum(along[:, seen], axis=0) > 0
    return len(forwards) >= MIN_SIGHTINGS and bool(forwards.mean() < _FACING)


def _sides(names: Sequence[str]) -> list[list[tuple[int, int]]]:
    """Groups of pairs of joints that may be exchanged jointly: of arms, of legs, and of
    their ends.
    """
    groups = [
        [
            (names.index("R" + part), names.index("L" + part))
            for part in parts
            if {"R" + part, "L" + part} <= {*names}
        ]
        for parts in (_ARMS, _LEGS, _ARMS[1:], _LEGS[1:])
    ]
    return [each for each in groups if len(each) > 1]


def _people(detections: DetectionSequence, setup: SetupHypothesis, skeleton: Skeleton) -> Array:
    """(N, K, 2) people in pictures in some of the frames used, by keypoint, NaN where not seen."""
    names = keypoint_names(skeleton)
    place = np.array([names.index(joint) if joint in names else -1 for joint in skeleton.joints])
    frames = setup.evidence.anchors[:: max(1, len(setup.evidence.anchors) // 30)].tolist()
    found = [
        people_of(detections[frame], place, len(names), max(1, len(names) // 3))[1]
        for frame in frames
    ]
    return _some(np.concatenate(found))


def _some(people: Array) -> Array:
    """At most `MOST_PEOPLE` of the `people`, evenly spread."""
    return people[:: -(-len(people) // MOST_PEOPLE) if len(people) > 0 else 1]
