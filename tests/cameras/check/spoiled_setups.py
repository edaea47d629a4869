"""Recordings with one mistake in their set-up, made on purpose: does the check name it, and nothing
else?
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis, Camera, Rig
from shapepose_fg.core.detections import Detections, DetectionSequence, Recording


@dataclass(frozen=True)
class Spoiled:
    """A recording with a mistake."""

    what: str
    """The mistake, in words."""
    detections: DetectionSequence
    rig: Rig
    kind: Kind
    """What the check should name."""
    cameras: tuple[int, ...]
    """The cameras that it should name; empty where the mistake is of none, or of all."""
    amount: float | None = None
    """Frames that should be named, within one."""

    def named_by(self, findings: Sequence[Finding]) -> bool:
        """Whether a finding names the kind, the cameras, and the frames within one."""
        return any(
            finding.kind == self.kind
            and (len(self.cameras) == 0 or finding.cameras == self.cameras)
            and (self.amount is None or abs(finding.amount - self.amount) <= 1)
            for finding in findings
        )


def spoiled(detections: DetectionSequence, rig: Rig, seed: int = 0) -> Iterator[Spoiled]:
    """One recording with every mistake, of every camera: turned about axes that `seed` draws."""
    rng = np.random.default_rng(seed)
    everybody = tuple(range(len(rig)))
    for view in everybody:
        for degrees in (1, 5, 30, 180):
            axis = rng.normal(size=3)
            yield Spoiled(
                f"turned {degrees}",
                detections,
                turned(rig, view, degrees, axis),
                Kind.TURNED,
                (view,),
            )
        for frames in (6, 10, -8):
            late = delayed(detections, view, frames)
            yield Spoiled("late 6 to 10 frames", late, rig, Kind.LATE, (view,), frames)
        other = (view + 1) % len(rig)
        pair = (min(view, other), max(view, other))
        yield Spoiled("exchanged", detections, exchanged(rig, view, other), Kind.EXCHANGED, pair)
        yield Spoiled("focal length x 2", detections, zoomed(rig, view, 2.0), Kind.FOCAL, (view,))
        yield Spoiled(
            "detections x 0.5", resized(detections, (view,), 0.5), rig, Kind.RESIZED, (view,)
        )
        yield Spoiled("inverse pose", detections, inverted(rig, (view,)), Kind.INVERTED, (view,))
        mirror = mirrored(detections, rig, view)
        yield Spoiled("mirrored", mirror, rig, Kind.MIRRORED, (view,))
        half = len(detections) // 2
        for degrees in (3, 10):
            later = turning(detections, rig, view, lambda t, d=degrees, h=half: d if t >= h else 0)
            yield Spoiled("bumped half-way", later, rig, Kind.BUMPED, (view,))
        slowly = turning(detections, rig, view, lambda t, n=len(detections): 8 * t / n)
        yield Spoiled("drifting by 8", slowly, rig, Kind.DRIFTING, (view,))
        twice, copy = listed_twice(detections, rig, view)
        yield Spoiled("listed twice", twice, copy, Kind.DUPLICATE, (view, len(rig)))
        yield Spoiled(
            "another's file", detections, same_pose(rig, view, other), Kind.DUPLICATE, pair
        )
    yield Spoiled(
        "detections x 0.5, all", resized(detections, everybody, 0.5), rig, Kind.RESIZED, everybody
    )
    yield Spoiled(
        "inverse poses, all", detections, inverted(rig, everybody), Kind.INVERTED, everybody
    )
    yield Spoiled("metres read as mm", detections, scaled(rig, 0.001), Kind.UNIT, ())
    yield Spoiled("mm read as metres", detections, scaled(rig, 1000.0), Kind.UNIT, ())
    for name in get_args(Axis):
        if name != rig.up:
            yield Spoiled("wrong up axis", detections, Rig(rig.cameras, name), Kind.UP, ())


def mirrored(detections: DetectionSequence, rig: Rig, view: int) -> Recording:
    """One camera's detections as in pictures the other way round."""
    width = rig.cameras[view].image_size[0]

    def change(frame: int, xy: Array) -> Array:
        return np.column_stack([width - 1 - xy[:, 0], xy[:, 1]])

    return seen_as(detections, view, change)


def turning(
    detections: DetectionSequence, rig: Rig, view: int, degrees: Callable[[int], float]
) -> Recording:
    """What a camera sees that is turned sideways by `degrees` of each frame."""
    K = rig.K[view]

    def change(frame: int, xy: Array) -> Array:
        turn = Rotation.from_rotvec(
            np.deg2rad(degrees(frame)) * np.array([0.3, 0.95, 0.1])
        ).as_matrix()
        h = np.column_stack([xy, np.ones(len(xy))]) @ (K @ turn @ np.linalg.inv(K)).T
        return h[:, :2] / h[:, 2:]

    return seen_as(detections, view, change)


def shifted(rig: Rig, view: int, right_px: float, down_px: float) -> Rig:
    """One camera whose principal point is calibrated so many pixels right and down of where it
    is.
    """
    by = np.zeros((3, 3))
    by[:2, 2] = right_px, down_px
    return _changed(rig, (view,), lambda camera: replace(camera, K=camera.K + by))


def biased(
    detections: DetectionSequence, rig: Rig, people: Array, bias: Array, larger: Array | float = 0.0
) -> Recording:
    """People (T, P, J, 3) seen beside where they are by `bias` (P, J, V, 2), and `larger` (P, 1, V,
    1).

    Both are parts of their height in the picture, and last.
    """
    frames = []
    for number in range(len(detections)):
        found, at = detections[number], np.moveaxis(rig.project(people[number])[0], 0, 2)
        height = np.ptp(at[..., 1], axis=1)[:, None, :, None]
        moves = bias * height + larger * (at - at.mean(axis=1, keepdims=True))
        who = np.linalg.norm(at[:, found.joint, found.view] - found.xy, axis=-1).argmin(axis=0)
        frames.append(replace(found, xy=found.xy + moves[who, found.joint, found.view]))
    return Recording(detections.skeleton, frames)


def lasting(rng: np.random.Generator, low: float, high: float, *shape: int) -> Array:
    """(*shape, 2) biases in any direction, of such sizes."""
    angle, size = rng.uniform(0, 2 * np.pi, shape), rng.uniform(low, high, shape)
    return size[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def seen_as(
    detections: DetectionSequence, view: int, change: Callable[[int, Array], Array]
) -> Recording:
    """One camera's pixels after a `change` of frame and pixels (N, 2)."""
    frames = []
    for number in range(len(detections)):
        found = detections[number]
        xy, mine = found.xy.copy(), found.view == view
        xy[mine] = change(number, xy[mine])
        frames.append(replace(found, xy=xy))
    return Recording(detections.skeleton, frames)


def turned(rig: Rig, view: int, degrees: float, axis: Array) -> Rig:
    """One camera turned about an axis (3,) of its own, where it stands."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(
        np.deg2rad(degrees) * axis / np.linalg.norm(axis)
    ).as_matrix()
    return _changed(rig, (view,), lambda camera: replace(camera, wTc=camera.wTc @ turn))


def moved(rig: Rig, view: int, metres: float, way: Array) -> Rig:
    """One camera moved along `way` (3,) of its own, looking as it did."""
    by = np.zeros((4, 4))

    def change(camera: Camera) -> Camera:
        by[:3, 3] = camera.wTc[:3, :3] @ way * metres / np.linalg.norm(way)
        return replace(camera, wTc=camera.wTc + by)

    return _changed(rig, (view,), change)


def exchanged(rig: Rig, first: int, second: int) -> Rig:
    """Two cameras under each other's names."""
    a, b = rig.cameras[first], rig.cameras[second]
    rig = _changed(rig, (first,), lambda _: replace(b, name=a.name))
    return _changed(rig, (second,), lambda _: replace(a, name=b.name))


def same_pose(rig: Rig, view: int, other: int) -> Rig:
    """The calibration of `view` also under the name of `other`."""
    return _changed(rig, (other,), lambda camera: replace(rig.cameras[view], name=camera.name))


def zoomed(rig: Rig, view: int, factor: float) -> Rig:
    """One camera with another focal length."""
    focal = np.ones((3, 3))
    focal[:2, :2] = factor
    return _changed(rig, (view,), lambda camera: replace(camera, K=camera.K * focal))


def inverted(rig: Rig, views: tuple[int, ...]) -> Rig:
    """Cameras whose pose is read as its inverse."""
    return _changed(rig, views, lambda camera: replace(camera, wTc=np.linalg.inv(camera.wTc)))


def scaled(rig: Rig, factor: float) -> Rig:
    """The rig in another unit."""
    unit = np.ones((4, 4))
    unit[:3, 3] = factor
    return _changed(
        rig, tuple(range(len(rig))), lambda camera: replace(camera, wTc=camera.wTc * unit)
    )


def resized(detections: DetectionSequence, views: tuple[int, ...], factor: float) -> Recording:
    """Detections of some cameras as on pictures of another size."""

    def smaller(found: Detections) -> Detections:
        xy = found.xy.copy()
        mine = np.isin(found.view, views)
        xy[mine] = factor * (xy[mine] + 0.5) - 0.5
        return replace(found, xy=xy)

    return _each(detections, smaller)


def delayed(detections: DetectionSequence, view: int, frames: int) -> Recording:
    """What one camera saw, so many frames later; at one end it sees nothing."""
    every = [detections[frame] for frame in range(len(detections))]
    every, shifted = [*every, Detections.empty()], np.arange(len(every)) - frames
    shifted[(shifted < 0) | (shifted >= len(detections))] = len(detections)
    return Recording(
        detections.skeleton,
        [
            _together(now.only(now.view != view), every[then].only(every[then].view == view))
            for now, then in zip(every[:-1], shifted.tolist(), strict=True)
        ],
    )


def listed_twice(detections: DetectionSequence, rig: Rig, view: int) -> tuple[Recording, Rig]:
    """One camera a second time, at the end of the rig and under a name of its own."""
    copy = replace(rig.cameras[view], name=f"{rig.cameras[view].name}_again")

    def more(found: Detections) -> Detections:
        mine = found.only(found.view == view)
        return _together(found, replace(mine, view=np.full(len(mine), len(rig))))

    return _each(detections, more), Rig((*rig.cameras, copy), rig.up)


def _together(first: Detections, second: Detections) -> Detections:
    """The candidates of both, sorted by view."""
    view, joint, xy, confidence = (
        np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ("view", "joint", "xy", "confidence")
    )
    order = np.argsort(view, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    pairs = place[np.concatenate([first.pairs, second.pairs + len(first)])]
    affinity = np.concatenate([first.affinity, second.affinity])
    return Detections(view[order], joint[order], xy[order], confidence[order], pairs, affinity)


def _each(detections: DetectionSequence, change: Callable[[Detections], Detections]) -> Recording:
    return Recording(
        detections.skeleton, [change(detections[frame]) for frame in range(len(detections))]
    )


def _changed(rig: Rig, views: tuple[int, ...], change: Callable[[Camera], Camera]) -> Rig:
    return Rig(
        tuple(change(each) if v in views else each for v, each in enumerate(rig.cameras)), rig.up
    )
