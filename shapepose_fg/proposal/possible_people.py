"""People who may be there: the detections that each would explain, and where the joints then are."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.pieces import solved
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import Sight, nearby

_NEAR_M = 0.06
"""How closeness to a joint falls off: sigma of a Gaussian, as a length at the joint's depth, as in `assign`."""
_FAR_M = 0.15
"""No detection whose ray passes a joint at more is the joint's."""
_SURE_AFFINITY = 0.5
"""Mean affinity that takes a detection for a joint whose place nobody knows."""
_KERNEL_M = 0.03
"""Scale of the Cauchy kernel with which joints are triangulated: what a detector is off, measured."""
_ROUNDS = 2
"""How often a joint is triangulated with weights made anew."""
_STRETCH = (1.0, 0.9, 0.8)
"""One bone, two and three: how much of their summed longest lengths they span at most."""


@dataclass(frozen=True)
class Frame:
    """What is given of one frame."""

    detections: Detections
    """What the detector saw."""
    rig: Rig
    """The cameras."""
    skeleton: Skeleton
    """The detector's joints."""
    longest_m: Array
    """(J,) the longest distance of a joint to its parent on the skeleton."""

    @cached_property
    def sight(self) -> Sight:
        """The frame's arrays as the kernels take them."""
        return Sight.of(self.detections, self.rig, self.skeleton)

    @cached_property
    def rays(self) -> Array:
        """(D, 3) directions of length one, in the world, in which the detections lie."""
        return self.rig.rays(self.detections.view, self.detections.xy)

    @property
    def spans(self) -> tuple[Index, Array]:
        """Pairs of joints (E, 2) at most three bones apart, and how far they are at most (E,), metres."""
        return _spans(self.skeleton, tuple(self.longest_m.tolist()))


@cache
def _spans(skeleton: Skeleton, longest_m: tuple[float, ...]) -> tuple[Index, Array]:
    joints = np.arange(len(skeleton))
    bones = np.where(joints[:, None] == joints, 0, len(joints))
    length = np.where(bones == 0, 0.0, np.inf)
    children = [joint for joint in joints if skeleton.parents[joint] >= 0]
    parents = [skeleton.parents[joint] for joint in children]
    bones[children, parents] = bones[parents, children] = 1
    length[children, parents] = length[parents, children] = np.array(longest_m)[children]
    for over in joints:  # the shortest ways, as Floyd and Warshall find them
        bones = np.minimum(bones, bones[:, [over]] + bones[over])
        length = np.minimum(length, length[:, [over]] + length[over])
    near = np.argwhere((bones > 0) & (bones <= len(_STRETCH)) & (joints[:, None] > joints))
    first, second = near.T
    return np.ascontiguousarray(near), np.array(_STRETCH)[bones[first, second] - 1] * length[first, second]


@dataclass(frozen=True)
class PossiblePeople(Rows):
    """H people who may be there."""

    places: Array
    """(H, J, 3) where two views or more put the joints, metres; NaN elsewhere."""
    chosen: Index
    """(H, J, V) the detections that each would explain, -1 for none."""
    gap_m: Array
    """(H, J, V) how far from the joint the detection's ray passes; NaN where there is none, or no place."""

    def completed(self, person: int, part: "PossiblePeople") -> "PossiblePeople":
        """Return the hypotheses with the joints that `person` lacks taken from `part`, a single one."""
        lacks = np.zeros((*self.places.shape[:2], 1), dtype=bool)
        lacks[person] = np.isnan(self.places[person, :, :1]) & np.isfinite(part.places[0, :, :1])
        both = zip(vars(self).values(), vars(part).values(), strict=True)
        return PossiblePeople(*(np.where(lacks, new, old) for old, new in both))

    @classmethod
    def none(cls, frame: Frame) -> "PossiblePeople":
        """Nobody."""
        shape = (0, len(frame.skeleton), len(frame.rig))
        return cls(np.zeros((*shape[:2], 3)), np.full(shape, -1, dtype=np.intp), np.zeros(shape))


def settled(places: Array, own: Index, frame: Frame, passes: int, *, exclusive: bool = False) -> PossiblePeople:
    """People at `places` (H, J, 3) who are thought to have detections `own` (H, J, V), -1 for none: detections
    chosen, joints triangulated, several times in turn.

    With `exclusive` each detection is one person's; without, each takes what it would explain. Joints that no
    bones connect to most of the others go: they are somebody else's.
    """
    for _ in range(passes):
        chosen = _claimed(places, own, frame, exclusive=exclusive)
        places, gap_m = triangulated(chosen, frame)
        chosen = np.where(np.nan_to_num(gap_m) < _FAR_M, chosen, -1)
        part = connected(places, frame)
        astray = (part >= 0) & (part != sizes(part).argmax(axis=1)[:, None])
        places = np.where(astray[..., None], np.nan, places)
        own = np.where(astray[..., None], -1, chosen)
    places, gap_m = triangulated(own, frame)
    return PossiblePeople(places, own, gap_m)


def _claimed(places: Array, own: Index, frame: Frame, *, exclusive: bool) -> Index:
    """(H, J, V) the detections nearest to the joints; where no place is known, those of affinity to the own."""
    H, J, _ = own.shape
    world = np.zeros(H, dtype=np.intp) if exclusive else np.arange(H)
    near = nearby(places, np.full((H, J), _FAR_M), world, frame.sight)
    unplaced = np.isnan(places[..., 0])
    if unplaced.any():
        near = near.with_tied(own, unplaced, frame.sight)
    nearness = np.exp(-0.5 * near.distance_m**2 / _NEAR_M**2)
    lost = np.isinf(near.distance_m)
    chosen, claims = near.claimed(nearness, lost, _SURE_AFFINITY, own, world, frame.sight)
    if exclusive:
        near.share(claims.tied, chosen)
    return chosen


def triangulated(chosen: Index, frame: Frame) -> tuple[Array, Array]:
    """Joints (H, J, 3) nearest to the rays of their detections `chosen` (H, J, V), and the gaps (H, J, V), metres.

    Weighted by confidence, under a Cauchy kernel. NaN for joints that fewer than two views see; a ray that meets
    its joint behind the camera is infinitely far.
    """
    places, gap_m = np.full((*chosen.shape[:2], 3), np.nan), np.full(chosen.shape, np.nan)
    confidence = frame.detections.confidence
    _triangulate(chosen, frame.rays, confidence, frame.rig.centres, np.empty(chosen.shape[2]), places, gap_m)
    return places, gap_m


@kernel("i3 f2 f1 f2 f1 f3 f3")
def _triangulate(chosen, rays, confidence, centres, weight, places, gap_m):
    """Fill in places and gaps of `triangulated`; `weight` (V,) is room to work in."""
    people, joints, views = chosen.shape
    for h in range(people):
        for j in range(joints):
            seen = 0
            for v in range(views):
                weight[v] = confidence[chosen[h, j, v]] if chosen[h, j, v] >= 0 else 0.0
                seen += chosen[h, j, v] >= 0
            for _ in range(_ROUNDS if seen >= 2 else 0):
                _nearest(chosen[h, j], rays, weight, centres, places[h, j])
                for v in range(views):
                    d = chosen[h, j, v]
                    if d >= 0:
                        gap_m[h, j, v] = _gap(rays[d], centres[v], places[h, j])
                        off = (gap_m[h, j, v] if gap_m[h, j, v] < np.inf else 1.0) / _KERNEL_M
                        weight[v] = confidence[d] / (1 + off * off)


@part
def _nearest(chosen, rays, weight, centres, place):
    """The point that is nearest to weighted rays of views: sum w (1 - r r^T) (x - c) = 0."""
    xx = yy = zz = 1e-9
    xy = xz = yz = px = py = pz = 0.0
    for v in range(len(chosen)):
        if chosen[v] >= 0:
            d, w = chosen[v], weight[v]
            x, y, z = rays[d, 0], rays[d, 1], rays[d, 2]
            a, b, c = centres[v, 0], centres[v, 1], centres[v, 2]
            along = x * a + y * b + z * c
            xx, yy, zz = xx + w * (1 - x * x), yy + w * (1 - y * y), zz + w * (1 - z * z)
            xy, xz, yz = xy - w * x * y, xz - w * x * z, yz - w * y * z
            px, py, pz = px + w * (a - along * x), py + w * (b - along * y), pz + w * (c - along * z)
    solved(xx, xy, xz, yy, yz, zz, px, py, pz, place)


@part
def _gap(ray, centre, place):
    """How far a ray passes a place, metres; infinite behind the camera."""
    x, y, z = place[0] - centre[0], place[1] - centre[1], place[2] - centre[2]
    depth = x * ray[0] + y * ray[1] + z * ray[2]
    squared = x * x + y * y + z * z - depth * depth
    return np.inf if depth <= 0 else np.sqrt(squared) if squared > 0 else 0.0


def gaps(places: Array, chosen: Index, frame: Frame) -> Array:
    """(H, J, V) how far the rays of detections `chosen` (H, J, V) pass `places` (H, J, 3), metres; NaN for none.

    A ray that meets its joint behind the camera is infinitely far.
    """
    if len(frame.rays) == 0:
        return np.full(chosen.shape, np.nan)
    from_camera = places[:, :, None] - frame.rig.centres
    depth = (frame.rays[chosen] * from_camera).sum(axis=-1)
    across_m = np.sqrt(np.maximum((from_camera**2).sum(axis=-1) - depth**2, 0.0))
    return np.where(chosen >= 0, np.where(depth <= 0, np.inf, across_m), np.nan)


def connected(places: Array, frame: Frame) -> Index:
    """(H, J) which joints of `places` (H, J, 3) hang together by bones no longer than people's.

    The number of the part's first joint; -1 where a joint has no place.
    """
    part = np.where(np.isfinite(places[..., 0]), np.arange(places.shape[1]), -1)
    _connect(np.ascontiguousarray(places), *frame.spans, part)
    return part


@kernel("f3 i2 f1 i2")
def _connect(places, pairs, most, part):
    """Give joints that hang together the least number `part` (H, J) of them."""
    for h in range(len(places)):
        changed = True
        while changed:
            changed = False
            for n in range(len(pairs)):
                i, j, squared = pairs[n, 0], pairs[n, 1], 0.0
                if part[h, i] == part[h, j]:
                    continue
                for x in range(3):
                    squared += (places[h, i, x] - places[h, j, x]) ** 2
                if np.sqrt(squared) < most[n]:
                    changed = True
                    if part[h, i] < part[h, j]:
                        part[h, j] = part[h, i]
                    else:
                        part[h, i] = part[h, j]


def sizes(part: Index) -> Index:
    """(H, J) how many joints each part of `connected` has, at the number of the part."""
    people, joints = part.shape
    row, column = np.nonzero(part >= 0)
    return np.bincount(row * joints + part[row, column], minlength=people * joints).reshape(people, joints)
