"""A detector that errs: from where people truly are to 2D joint candidates and part affinities.

The numbers are reasoned from how OpenPose behaves: a visible joint is placed to about 1.5 cm on the body, a
hidden one that is still reported to three times that; confidence falls with both; close candidates of one
joint merge, as non-maximum suppression does; and a hidden joint may be found on whoever hides it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig
from shapepose_fg.detections import Detections, Recording
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see
from shapepose_fg.skeleton import BODY_25

_LIMBS = np.array(BODY_25.limbs)


@dataclass(frozen=True)
class DetectorConfig:
    """How the detector errs. `seen` below is the share of a joint that is visible, 0 to 1."""

    sigma_seen_m: float = 0.015
    """Standard deviation of each image coordinate of a visible joint, as a length on the person."""
    sigma_hidden_m: float = 0.045
    """The same for a joint that is hidden and still reported; geometric in between."""
    sigma_floor_px: float = 0.7
    """What the grid of the heat maps adds, however small a person is."""
    quality_spread: float = 0.35
    """How much a joint's own sigma varies about these (of its logarithm); confidence follows it."""
    miss_seen: float = 0.03
    """Share of the visible joints that are not reported."""
    miss_hidden: float = 0.5
    """The same for hidden ones; linear in between."""
    capture: float = 0.3
    """Share of the reported joints hidden by another person that are found on that person's same joint."""
    merge_px: float = 8.0
    """Candidates of one joint and view this near to each other are one: the more confident stays."""
    false_per_view: float = 2.0
    """Mean count of false candidates in a view, Poisson: half of them on people, half anywhere."""
    spurious_far: float = 0.01
    """Share of the wrong pairs that get an affinity."""
    spurious_near: float = 0.15
    """The same for wrong pairs that are as near as a limb is long."""
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    """How the depth buffer is read."""

    def __post_init__(self) -> None:
        for name in ("miss_seen", "miss_hidden", "capture", "spurious_far", "spurious_near"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share from 0 to 1, got {getattr(self, name)}")
        for name in ("sigma_seen_m", "sigma_hidden_m", "sigma_floor_px", "quality_spread", "merge_px"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @classmethod
    def perfect(cls) -> "DetectorConfig":
        """Reports every joint in the image exactly where it is, and nothing else."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Found:
    """Candidates while they are made: D of them."""

    view: NDArray[np.intp]
    joint: NDArray[np.intp]
    xy: NDArray[np.float64]
    confidence: NDArray[np.float64]
    owner: NDArray[np.bool_]
    """(D, P) whose joint a candidate is; nobody's where it is false, two people's where two have merged."""
    seen: NDArray[np.float64]
    """(D,) share that was visible."""

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "_Found":
        return _Found(**{name: value[index] for name, value in vars(self).items()})

    def join(self, other: "_Found") -> "_Found":
        return _Found(**{name: np.concatenate([value, vars(other)[name]]) for name, value in vars(self).items()})


def simulate(
    scene: Scene,
    config: DetectorConfig | None = None,
    seed: int = 0,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Recording:
    """Detect everybody in every frame of `scene`; the same seed gives the same candidates.

    Each frame has its own generator, so that a frame does not depend on those before it. `progress` is told
    the frames that are done, and all.
    """
    config = DetectorConfig() if config is None else config
    skin = Skin.of(scene.body, config.visibility.cell_m)
    frames = []
    for frame in range(len(scene)):
        joints = scene.truth_at(frame)
        seen = see(scene.rig, joints, scene.vertices_at(frame, skin.vertices), skin, config.visibility)
        frames.append(detect(scene.rig, joints, seen, config, np.random.default_rng([seed, frame])))
        if progress is not None:
            progress(len(frames), len(scene))
    return Recording(BODY_25, frames)


def detect(
    rig: Rig,
    joints: NDArray[np.float64],
    visibility: Visibility,
    config: DetectorConfig,
    rng: np.random.Generator,
) -> Detections:
    """What the detector says of one frame with BODY_25 `joints` (P, 25, 3), of which `visibility` is known."""
    found = _report(rig, joints, visibility, config, rng)
    found = _merge(found.join(_invent(rig, found, config, rng)), config.merge_px)
    found = found.take(rng.permutation(len(found.view)))
    pairs, affinity = _affinities(found, config, rng)
    return Detections(found.view, found.joint, found.xy, found.confidence, pairs, affinity)


def _report(
    rig: Rig,
    joints: NDArray[np.float64],
    visibility: Visibility,
    config: DetectorConfig,
    rng: np.random.Generator,
) -> _Found:
    """The joints of people that are reported, each with its error."""
    missed = rng.random(visibility.seen.shape) < _between(config.miss_hidden, config.miss_seen, visibility.seen)
    view, person, joint = np.nonzero(visibility.in_image & ~missed)
    seen = visibility.seen[view, person, joint]
    front = visibility.hidden_by[view, person, joint]
    captured = (front >= 0) & (seen < 0.5) & (rng.random(len(view)) < config.capture)
    at = np.where(captured, front, person)
    seen = np.where(captured, 0.5, seen)
    true_xy, depth = rig.project(joints)
    captured &= np.isfinite(true_xy[view, at, joint, 0])  # the other's joint is before the camera
    at = np.where(captured, at, person)
    # The length on the person, as pixels; quality multiplies it and has a mean square of 1.
    hidden, visible = np.log(np.maximum([config.sigma_hidden_m, config.sigma_seen_m], 1e-12))
    log_sigma_m = _between(hidden, visible, seen)
    spread = rng.normal(0.0, 1.0, len(view)) * config.quality_spread
    quality = np.exp(spread - config.quality_spread**2)
    sigma_px = np.hypot(np.exp(log_sigma_m) * rig.focal_px[view] / depth[view, at, joint], config.sigma_floor_px)
    error = rng.normal(0.0, 1.0, (len(view), 2)) * (sigma_px * quality)[:, None]
    xy = true_xy[view, at, joint] + error
    confidence = _confidence(seen, spread, error, sigma_px, rng)
    owner = np.zeros((len(view), len(joints)), dtype=bool)
    owner[np.arange(len(view)), person] = True
    owner[np.arange(len(view)), at] = True
    inside = np.all((xy >= 0) & (xy <= rig.image_sizes[view] - 1), axis=1)
    return _Found(view, joint, xy, confidence, owner, seen).take(inside)


def _confidence(
    seen: NDArray[np.float64],
    spread: NDArray[np.float64],
    error: NDArray[np.float64],
    sigma_px: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """About 0.8 where visible and 0.3 where hidden, lower for a joint of poor quality and a large error."""
    size = np.linalg.norm(error, axis=1) / np.maximum(sigma_px, 1e-9)
    value = _between(0.33, 0.8, seen) - 0.12 * spread - 0.05 * (size - 1.25) + rng.normal(0.0, 0.05, len(seen))
    return np.clip(value, _between(0.08, 0.35, seen), _between(0.55, 0.97, seen))


def _invent(rig: Rig, found: _Found, config: DetectorConfig, rng: np.random.Generator) -> _Found:
    """False candidates: anywhere in the image, or of another joint than the one that is there."""
    view = np.repeat(np.arange(len(rig)), rng.poisson(config.false_per_view, len(rig)))
    count = len(view)
    xy = rng.random((count, 2)) * (rig.image_sizes[view] - 1)
    if len(found.view):
        # A reported candidate of the same view, if that view has any: candidates come sorted by view.
        first, last = np.searchsorted(found.view, view), np.searchsorted(found.view, view, side="right")
        chosen = np.minimum(first + (rng.random(count) * (last - first)).astype(np.intp), len(found.view) - 1)
        near = (rng.random(count) < 0.5) & (last > first)
        xy = np.where(near[:, None], found.xy[chosen] + rng.normal(0.0, 12.0, (count, 2)), xy)
        xy = np.clip(xy, 0.0, rig.image_sizes[view] - 1)
    return _Found(
        view=view,
        joint=rng.integers(0, len(BODY_25), count),
        xy=xy,
        confidence=np.clip(rng.gamma(2.0, 0.1, count) + 0.05, 0.05, 0.6),
        owner=np.zeros((count, found.owner.shape[1]), dtype=bool),
        seen=np.zeros(count),
    )


def _merge(found: _Found, merge_px: float) -> _Found:
    """Keep of near candidates of one joint and view the most confident, which then belongs to all of them."""
    if merge_px <= 0 or len(found.view) == 0:
        return found
    found = found.take(np.argsort(-found.confidence, kind="stable"))
    label = found.view * len(BODY_25) + found.joint
    x, y = found.xy.T
    better = (label[:, None] == label) & np.tri(len(label), k=-1, dtype=bool)
    better &= np.square(x[:, None] - x) + np.square(y[:, None] - y) < merge_px**2
    lost = better.any(axis=1)
    owner = found.owner.copy()
    np.logical_or.at(owner, better[lost].argmax(axis=1), found.owner[lost])
    return _Found(**{**vars(found), "owner": owner}).take(~lost)


def _affinities(
    found: _Found, config: DetectorConfig, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Pairs (E, 2) that a limb may join, and their affinity (E,): high inside a person, else mostly none."""
    first, second = np.nonzero(
        (found.view[:, None] == found.view[None]) & _JOINED[found.joint[:, None], found.joint[None]]
    )
    right = (found.owner[first] & found.owner[second]).any(axis=1)
    evidence = 0.5 * (found.seen[first] + found.seen[second])
    strong = rng.uniform(0.6, 0.95, len(first)) * _between(0.5, 1.0, evidence)
    # Wrong pairs as near as the right pairs of the same limb and view lie on a common image region.
    length = np.linalg.norm(found.xy[first] - found.xy[second], axis=1)
    limb = (found.view[first] * len(BODY_25) + found.joint[first]) * len(BODY_25) + found.joint[second]
    group = np.unique(limb, return_inverse=True)[1]
    longest = np.zeros(group.max(initial=-1) + 1)
    np.maximum.at(longest, group[right], length[right])
    share = np.where(length < longest[group], config.spurious_near, config.spurious_far)
    spurious = (rng.random(len(first)) < share) * rng.uniform(0.05, 0.5, len(first))
    affinity = np.where(right, strong, spurious)
    listed = affinity > 0
    return np.stack([first, second], axis=1)[listed], affinity[listed]


def _between(
    hidden: float | np.floating, visible: float | np.floating, seen: NDArray[np.float64]
) -> NDArray[np.float64]:
    """From the value of a hidden joint to that of a visible one."""
    return hidden + (visible - hidden) * seen


_JOINED = np.zeros((len(BODY_25), len(BODY_25)), dtype=bool)
_JOINED[_LIMBS[:, 0], _LIMBS[:, 1]] = True
