"""Sightings of people by single cameras, and their association under assumed cameras.

All errors are relative to the person's size in the picture, so that matches do not depend on the
calibration's unit.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.people_2d import group_people

MIN_JOINTS = 5
"""Minimum number of core joints in view for a person to be used."""
MOST_FRAMES = 100
"""Maximum number of frames used, spread over the recording."""
MIN_SIGHTINGS = 20
"""Minimum number of people seen for any statement on a camera or on the order of joints."""


@dataclass(frozen=True)
class Sightings(Rows):
    """S sightings of people by single cameras, J core joints each."""

    frame: Index
    """(S,) frame of the recording."""
    view: Index
    """(S,) index of the camera in the rig."""
    xy: Array
    """(S, J, 2) joints, undistorted pixels; NaN where not seen."""
    confidence: Array
    """(S, J) confidence of the detector; 0 where not seen."""

    @cached_property
    def size_px(self) -> Array:
        """(S,) size of each person in the picture, about the height if standing, pixels."""
        return size_of(self.xy)

    @classmethod
    def of(cls, detections: DetectionSequence, frames: Iterable[int]) -> "Sightings":
        """The 2D people of some `frames`, grouped by affinities within each view; core
        joints only.
        """
        joints = len(detections.skeleton.core)
        none = Sightings(
            np.zeros(0, np.intp),
            np.zeros(0, np.intp),
            np.zeros((0, joints, 2)),
            np.zeros((0, joints)),
        )
        found = [_of_frame(detections[frame], frame, detections.skeleton) for frame in frames]
        return Sightings.concatenate([none, *found])


@dataclass(frozen=True)
class Pinhole:
    """A camera without lens distortion."""

    K: Array
    """(3, 3) intrinsics."""
    cTw: Array
    """(3, 4) camera from world."""

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths (...) of `points` (..., 3) in the world."""
        at = np.tensordot(points, self.K @ self.cTw[:, :3], (-1, 1)) + self.K @ self.cTw[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return at[..., :2] / at[..., 2:], at[..., 2]


def size_of(xy: Array) -> Array:
    """(...) size of people with joints xy (..., J, 2), pixels; 1 if nothing is seen."""
    seen = ~np.isnan(xy[..., :1])
    count = np.maximum(seen.sum(axis=-2), 1)
    xy0 = np.where(seen, xy, 0.0)
    mean = xy0.sum(axis=-2) / count
    variance = (np.where(seen, (xy0 - mean[..., None, :]) ** 2, 0.0).sum(axis=-2) / count).sum(
        axis=-1
    )
    # Stature of a standing person over the root of the joints' summed variances: 1 / 0.29 for a
    # uniform spread.
    return np.asarray(np.maximum(3.4 * np.sqrt(variance), 1.0))


def people_of(
    found: Detections, place: Index, count: int, least: int
) -> tuple[Index, Array, Array]:
    """The 2D people of one frame with at least `least` joints: views (N,), pixels (N, K, 2) and
    confidences (N, K).

    K is the `count` of joints; pixels are NaN and confidences 0 where not seen. `place` (J,) is the
    index among the K of each of the detector's joints, -1 for none.
    """
    groups = [rows[place[found.joint[rows]] >= 0] for rows in group_people(found)]
    groups = [rows for rows in groups if len(rows) >= least]
    xy, confidence = np.full((len(groups), count, 2), np.nan), np.zeros((len(groups), count))
    for person, rows in enumerate(groups):
        xy[person, place[found.joint[rows]]] = found.xy[rows]
        confidence[person, place[found.joint[rows]]] = found.confidence[rows]
    return np.array([found.view[rows[0]] for rows in groups], dtype=np.intp), xy, confidence


def _of_frame(found: Detections, frame: int, skeleton: Skeleton) -> Sightings:
    """The 2D people of one frame."""
    place = np.full(len(skeleton), -1)
    place[list(skeleton.core)] = np.arange(len(skeleton.core))
    view, xy, confidence = people_of(found, place, len(skeleton.core), MIN_JOINTS)
    if len(view) > _MOST_IN_A_PICTURE:
        surest = np.lexsort((-confidence.sum(axis=1), view))
        place_in_view = np.arange(len(view)) - np.searchsorted(view[surest], view[surest])
        keep = np.sort(surest[place_in_view < _MOST_IN_A_PICTURE])
        view, xy, confidence = view[keep], xy[keep], confidence[keep]
    return Sightings(np.full(len(view), frame, dtype=np.intp), view, xy, confidence)


_MOST_IN_A_PICTURE = 24
"""Maximum number of people per picture that are compared, the most confident ones: chance matches,
and the time, grow with the square of the number."""
GATE = 0.15
"""Maximum distance between the joints of two sightings of a person, as a share of the person's
size. A detector errs by 3 cm of 170; the smallest reported error of a calibration is three times
that (docs/setup_checks.md)."""


@dataclass(frozen=True)
class Groups(Rows):
    """P people: the sighting of each camera."""

    frame: Index
    """(P,) frame of each person."""
    member: Index
    """(P, V) row of the sighting by each camera, -1 for none."""
    error: Array
    """(P,) median distance of the rays of the two cameras by which each person was found, as a
    share of the size."""


@dataclass(frozen=True)
class Pairs:
    """M pairs of sightings in one frame by two cameras that may be one person, with supporting
    sightings.
    """

    members: Index
    """(M, 2) the two sightings."""
    views: Index
    """(M, 2) cameras of the two sightings."""
    error: Array
    """(M,) median distance between the rays of the two sightings, as a share of the person's size
    in the picture."""
    frame: Index
    """(M,) frame of each pair."""
    third: Index
    """(M, V) for each other camera, the sighting nearest to the person's projection; -1 for
    none."""
    third_error: Array
    """(M, V) median distance of the sighting in `third`, as a share of its size; inf for none."""

    @classmethod
    def of(cls, sightings: Sightings, views: Views) -> "Pairs":
        """All pairs of sightings that may be one person under the cameras `views`, in order of
        cameras.
        """
        first, second = same_frame(sightings.frame, sightings.frame)
        ordered = sightings.view[first] < sightings.view[second]
        first, second = first[ordered], second[ordered]
        error, points = _meeting(sightings, views, first, second)
        keep = error < GATE
        members = np.stack([first[keep], second[keep]], axis=1)
        third, third_error = _others(sightings, views, members, points[keep])
        return cls(
            members,
            sightings.view[members],
            error[keep],
            sightings.frame[members[:, 0]],
            third,
            third_error,
        )

    def groups(self, count: int, views: tuple[int, ...]) -> Groups:
        """Associate people by the cameras `views` only: greedily by support, each sighting used
        once.

        `count` is the number S of sightings. In every round each frame takes its best pair with the
        supporting sightings.
        """
        allowed = np.zeros(self.third.shape[1], dtype=bool)
        allowed[list(views)] = True
        free = np.ones(count + 1, dtype=bool)  # the last is for no sighting
        free[count] = False
        V = len(allowed)
        live = np.flatnonzero(allowed[self.views].all(axis=1))
        members, thirds = self.members, self.third
        found = [Groups(np.zeros(0, np.intp), np.zeros((0, V), np.intp), np.zeros(0))]
        while len(live := live[free[members[live]].all(axis=1)]) > 0:
            supported = (
                free[thirds[live]] & (thirds[live] >= 0) & allowed & (self.third_error[live] < GATE)
            )
            support = 1 - self.error[live] / GATE
            support = support + np.where(supported, 1 - self.third_error[live] / GATE, 0).sum(
                axis=1
            )
            best = least_of_each(self.frame[live], -support)
            member = np.where(supported[best], thirds[live[best]], -1)
            chosen = live[best]
            member[np.arange(len(best))[:, None], self.views[chosen]] = members[chosen]
            free[member[member >= 0]] = False
            found.append(Groups(self.frame[chosen], member, self.error[chosen]))
        return Groups.concatenate(found)


def rays_of(sightings: Sightings, views: Views) -> Array:
    """(S, J, 3) unit directions in the world from the camera to each joint; NaN where not seen."""
    inverse = np.linalg.inv(views.K)[sightings.view]
    camera = sightings.xy @ inverse[:, :, :2].mT + inverse[:, None, :, 2]
    world = camera @ views.cTw[sightings.view, :, :3]
    return np.asarray(world / np.linalg.norm(world, axis=-1, keepdims=True))


def centres_of(views: Views) -> Array:
    """(V, 3) optical centres in the world."""
    return -np.einsum("vji,vj->vi", views.cTw[:, :, :3], views.cTw[:, :, 3])


def depths_of_meeting(a: Array, b: Array, between: Array) -> tuple[Array, Array, Array]:
    """Depths (...) along unit rays `a` and `b` (..., 3) where they are nearest to each other, and
    the sines (...) of their angles; `between` (..., 3) is the second camera from the first.
    """
    cosine = (a * b).sum(axis=-1)
    along_a, along_b = ((each * between).sum(axis=-1) for each in (a, b))
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    return s, t, np.sqrt(sine2)


def _meeting(
    sightings: Sightings, views: Views, first: Index, second: Index
) -> tuple[Array, Array]:
    """Median distances of the rays of pairs (M,), relative to people's sizes, and triangulated
    midpoints (M, J, 3).

    Infinite if rays intersect behind a camera, are almost parallel, or have fewer than MIN_JOINTS
    joints in common.
    """
    rays, centres = rays_of(sightings, views), centres_of(views)
    a, b = rays[first], rays[second]
    between = (centres[sightings.view[second]] - centres[sightings.view[first]])[:, None]
    s, t, sine = depths_of_meeting(a, b, between)
    on_a, on_b = s[..., None] * a, between + t[..., None] * b
    half_gap = np.linalg.norm(on_a - on_b, axis=-1) / 2
    focal, size = views.focal_px[sightings.view], sightings.size_px
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.maximum(
            half_gap / s * (focal / size)[first, None], half_gap / t * (focal / size)[second, None]
        )
    error = np.where(np.isfinite(half_gap) & ((s <= 0) | (t <= 0)), np.inf, error)
    angle = median_of(np.arcsin(np.minimum(sine, 1.0)))
    # Minimum angle between the two rays of a pair, rad; below it the depth is poorly observed.
    median = np.where(angle > np.deg2rad(4.0), median_of(error, MIN_JOINTS), np.inf)
    points = centres[sightings.view[first]][:, None] + (on_a + on_b) / 2
    return median, points


def _others(
    sightings: Sightings, views: Views, members: Index, points: Array
) -> tuple[Index, Array]:
    """Supporting sightings by other cameras for pairs with joints at `points` (M, J, 3): see
    `Pairs`.
    """
    frame = sightings.frame[members[:, 0]] if len(members) > 0 else np.zeros(0, np.intp)
    third = np.full((len(members), len(views)), -1, dtype=np.intp)
    third_error = np.full(third.shape, np.inf)
    for view in range(len(views)):
        of_view = np.flatnonzero(sightings.view == view)
        beside = np.flatnonzero((sightings.view[members] != view).all(axis=1))
        person, sighting, error = distances(
            frame[beside],
            points[beside],
            sightings.rows(of_view),
            Pinhole(views.K[view], views.cTw[view]),
        )
        best = least_of_each(person, error)
        third[beside[person[best]], view] = of_view[sighting[best]]
        third_error[beside[person[best]], view] = error[best]
    return third, third_error


def distances(
    frame: Index, points: Array, seen: Sightings, camera: Pinhole
) -> tuple[Index, Index, Array]:
    """Median distance of each person's projection to each sighting of one camera in the same frame.

    `points` (P, J, 3) are people at `frame` (P,), `seen` the sightings of the `camera`. Returns
    person (E,), sighting (E,) and error (E,), as a share of the sighting's size.
    """
    person, sighting = same_frame(frame, seen.frame)
    at, depth = camera.project(points)
    error = miss_px(at[person], depth[person], seen.xy[sighting])
    return person, sighting, median_of(error, MIN_JOINTS) / seen.size_px[sighting]


def same_frame(first: Index, second: Index) -> tuple[Index, Index]:
    """All pairs (i, j) with first[i] == second[j]."""
    order = np.argsort(second, kind="stable")
    start, stop = (
        np.searchsorted(second[order], first),
        np.searchsorted(second[order], first, side="right"),
    )
    i = np.repeat(np.arange(len(first)), stop - start)
    step = np.arange(len(i)) - np.repeat(np.cumsum(stop - start) - (stop - start), stop - start)
    return i, order[start[i] + step]


def least_of_each(key: Index, value: Array) -> Index:
    """Row with the smallest `value` (N,) for each `key` (N,), by ascending keys; ties keep their
    order.
    """
    order = np.lexsort((value, key))
    return order[np.unique(key[order], return_index=True)[1]]


def miss_px(at: Array, depth: Array, xy: Array) -> Array:
    """(N, J) distance of joints projected to `at` (N, J, 2), at `depth` (N, J), from the joints
    `xy` (N, J, 2), pixels; infinite behind the camera, NaN for joints not seen.
    """
    miss = np.sqrt(np.square(at - xy).sum(axis=-1))
    return np.where((depth <= 0) & ~np.isnan(xy[..., 0]), np.inf, miss)


def median_of(values: Array, least: int = 1) -> Array:
    """(...) median over the last axis ignoring NaN, the lower of two middle values; infinite with
    fewer than `least`.
    """
    ordered = np.sort(values, axis=-1)  # NaN last
    count = (~np.isnan(values)).sum(axis=-1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(count >= least, middle, np.inf)


def median_over(values: Array) -> Array:
    """(...) median over the first axis ignoring NaN; 0 if all are NaN."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    middle = [
        np.take_along_axis(ordered, np.maximum(count - k, 0)[None] // 2, axis=0)[0] for k in (0, 1)
    ]
    return np.where(count > 0, (middle[0] + middle[1]) / 2, 0.0)


def follow(
    frame: Index, distance_of: Callable[[Index, Index], Array], reach: float, gap: int
) -> Index:
    """(N,) identities of rows over frames (N,): rows of a frame and of the `gap` frames before
    are the same if they are nearest to each other, and within `reach`.

    `distance_of` are the distances (A, B) of rows (A,) of earlier frames from rows (B,).
    """
    identity, last, count = np.full(len(frame), -1, dtype=np.intp), np.zeros(0, dtype=np.intp), 0
    for now in np.unique(frame).tolist():
        current, last = np.flatnonzero(frame == now), last[frame[last] >= now - gap]
        if len(last) > 0:
            far = distance_of(last, current)
            nearest = far.argmin(axis=1)
            mutual = far.argmin(axis=0)[nearest] == np.arange(len(last))
            mutual &= far.min(axis=1) < reach
            identity[current[nearest[mutual]]] = identity[last[mutual]]
        new = current[identity[current] < 0]
        identity[new] = count + np.arange(len(new))
        count += len(new)
        last = np.concatenate([current, last[~np.isin(identity[last], identity[current])]])
    return identity


def followed(frame: Index, points: Array) -> Index:
    """(P,) identities of people (P, J, 3) over frames (P,), by the mean of their joints."""
    middle = _middle(points)
    spread = _middle((points - middle[:, None]) ** 2).sum(axis=-1) ** 0.5

    def distance_of(one: Index, other: Index) -> Array:
        far = np.linalg.norm(middle[one, None] - middle[other], axis=-1)
        return far if far.size > 1 else 0 * far  # one person is the same one after a cut

    # Maximum distance that a person moves between frames, relative to the spread of the joints (two
    # thirds of a metre), and the number of frames after which a lost person is forgotten.
    reach = 1.4 * float(np.median(spread)) if len(frame) > 0 else 0.0
    return follow(frame, distance_of, reach, 40)


def _middle(points: Array) -> Array:
    """(N, n) mean over the points (N, J, n) that are not NaN; 0 if there are none."""
    known = ~np.isnan(points[..., :1])
    return np.asarray(np.where(known, points, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1))
