"""Hypotheses of people: the detections that each hypothesis would explain, and the triangulated
joints.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.kernel_geometry import solved
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import NEAR_M, FrameArrays, nearby

_FAR_M = 0.15
"""Maximum distance of a joint from the ray of its detection, m."""
_SURE_AFFINITY = 0.5
"""Minimum mean affinity of a detection for a joint without a position."""
DETECTOR_M = 0.03
"""Measured error of a detector, m: the scale of the Cauchy kernel for triangulation, of the
distances of rays from joints, and of the errors of bone lengths."""
_ROUNDS = 2
"""Number of reweighted triangulations of a joint."""
_STRETCH = (1.0, 0.9, 0.8)
"""Maximum distance over one, two and three bones, as a share of their summed maximum lengths."""


@dataclass(frozen=True)
class Frame:
    """Input of one frame."""

    detections: Detections
    """Detections of the frame."""
    rig: Rig
    """The cameras."""
    skeleton: Skeleton
    """The detector's joints."""
    longest_m: Array
    """(J,) maximum distance of each joint from its parent on the skeleton, metres."""

    @cached_property
    def arrays(self) -> FrameArrays:
        """Detections and cameras of the frame as the arrays that compiled kernels take."""
        return FrameArrays.of(self.detections, self.rig, self.skeleton)

    @cached_property
    def rays(self) -> Array:
        """(D, 3) unit directions of the detections' rays, in the world."""
        return self.rig.rays(self.detections.view, self.detections.xy)

    @property
    def spans(self) -> tuple[Index, Array]:
        """Pairs of joints (E, 2) at most three bones apart, and their maximum distances (E,),
        metres.
        """
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
    for over in joints:  # shortest paths (Floyd-Warshall)
        bones = np.minimum(bones, bones[:, [over]] + bones[over])
        length = np.minimum(length, length[:, [over]] + length[over])
    near = np.argwhere((bones > 0) & (bones <= len(_STRETCH)) & (joints[:, None] > joints))
    first, second = near.T
    return np.ascontiguousarray(near), np.array(_STRETCH)[bones[first, second] - 1] * length[
        first, second
    ]


@dataclass(frozen=True)
class PossiblePeople(Rows):
    """H hypotheses of people."""

    places: Array
    """(H, J, 3) joints triangulated from two or more views, metres; NaN elsewhere."""
    chosen: Index
    """(H, J, V) detections that each hypothesis would explain, -1 for none."""
    gap_m: Array
    """(H, J, V) distance of the joint from the detection's ray, metres; NaN without a detection or
    joint."""

    def completed(self, person: int, part: "PossiblePeople") -> "PossiblePeople":
        """Return the hypotheses with the missing joints of `person` taken from the single
        hypothesis `part`.
        """
        lacks = np.zeros((*self.places.shape[:2], 1), dtype=bool)
        lacks[person] = np.isnan(self.places[person, :, :1]) & np.isfinite(part.places[0, :, :1])
        both = zip(vars(self).values(), vars(part).values(), strict=True)
        return PossiblePeople(*(np.where(lacks, new, old) for old, new in both))

    @classmethod
    def none(cls, frame: Frame) -> "PossiblePeople":
        """No hypotheses."""
        shape = (0, len(frame.skeleton), len(frame.rig))
        return cls(np.zeros((*shape[:2], 3)), np.full(shape, -1, dtype=np.intp), np.zeros(shape))


def settled(
    places: Array, own: Index, frame: Frame, passes: int, *, exclusive: bool = False
) -> PossiblePeople:
    """Alternate assignment of detections and triangulation, `passes` times, starting at `places`
    (H, J, 3) with detections `own` (H, J, V), -1 for none.

    With `exclusive`, each detection is assigned to one person; else each hypothesis takes all it
    would explain. Joints not connected to most others by plausible bones are removed: they belong
    to another person.
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
    """(H, J, V) detections nearest to the joints; for joints without a position, by affinity to the
    own ones.
    """
    H, J, _ = own.shape
    hypothesis = np.zeros(H, dtype=np.intp) if exclusive else np.arange(H)
    near = nearby(places, np.full((H, J), _FAR_M), hypothesis, frame.arrays)
    unplaced = np.isnan(places[..., 0])
    if unplaced.any():
        near = near.with_tied(own, unplaced, frame.arrays)
    nearness = np.exp(-0.5 * near.distance_m**2 / NEAR_M**2)
    lost = np.isinf(near.distance_m)
    chosen, claims = near.claimed(nearness, lost, _SURE_AFFINITY, own, hypothesis, frame.arrays)
    if exclusive:
        near.share(claims.tied, chosen)
    return chosen


def triangulated(chosen: Index, frame: Frame) -> tuple[Array, Array]:
    """Triangulate joints (H, J, 3) from detections `chosen` (H, J, V); also returns distances to
    the rays (H, J, V), metres.

    Weighted by confidence and a Cauchy kernel. NaN for joints seen by fewer than two views; the
    distance is infinite behind the camera.
    """
    places, gap_m = np.full((*chosen.shape[:2], 3), np.nan), np.full(chosen.shape, np.nan)
    confidence = frame.detections.confidence
    _triangulate(
        chosen, frame.rays, confidence, frame.rig.centres, np.empty(chosen.shape[2]), places, gap_m
    )
    return places, gap_m


@kernel("i3 f2 f1 f2 f1 f3 f3")
def _triangulate(chosen, rays, confidence, centres, weight, places, gap_m):
    """Fill in the results of `triangulated`; `weight` (V,) is workspace."""
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
                        off = (gap_m[h, j, v] if gap_m[h, j, v] < np.inf else 1.0) / DETECTOR_M
                        weight[v] = confidence[d] / (1 + off * off)


@part
def _nearest(chosen, rays, weight, centres, place):
    """Least-squares point nearest to weighted rays: sum w (1 - r r^T) (x - c) = 0."""
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
            px, py, pz = (
                px + w * (a - along * x),
                py + w * (b - along * y),
                pz + w * (c - along * z),
            )
    solved(xx, xy, xz, yy, yz, zz, px, py, pz, place)


@part
def _gap(ray, centre, place):
    """Distance of a ray from a point, metres; infinite behind the camera."""
    x, y, z = place[0] - centre[0], place[1] - centre[1], place[2] - centre[2]
    depth = x * ray[0] + y * ray[1] + z * ray[2]
    squared = x * x + y * y + z * z - depth * depth
    return np.inf if depth <= 0 else np.sqrt(squared) if squared > 0 else 0.0


def gaps(places: Array, chosen: Index, frame: Frame) -> Array:
    """(H, J, V) distances of the rays of detections `chosen` (H, J, V) from `places` (H, J, 3),
    metres; NaN for none.

    Infinite if the joint is behind the camera.
    """
    if len(frame.rays) == 0:
        return np.full(chosen.shape, np.nan)
    from_camera = places[:, :, None] - frame.rig.centres
    depth = (frame.rays[chosen] * from_camera).sum(axis=-1)
    across_m = np.sqrt(np.maximum((from_camera**2).sum(axis=-1) - depth**2, 0.0))
    return np.where(chosen >= 0, np.where(depth <= 0, np.inf, across_m), np.nan)


def connected(places: Array, frame: Frame) -> Index:
    """(H, J) connected components of the joints at `places` (H, J, 3), under bones of plausible
    length.

    A component has the number of its first joint; -1 for joints without a position.
    """
    part = np.where(np.isfinite(places[..., 0]), np.arange(places.shape[1]), -1)
    _connect(np.ascontiguousarray(places), *frame.spans, part)
    return part


@kernel("f3 i2 f1 i2")
def _connect(places, pairs, most, part):
    """Give all joints of a component the smallest number `part` (H, J) among them."""
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
    """(H, J) number of joints of each component of `connected`, at the component's number."""
    people, joints = part.shape
    row, column = np.nonzero(part >= 0)
    return np.bincount(row * joints + part[row, column], minlength=people * joints).reshape(
        people, joints
    )
