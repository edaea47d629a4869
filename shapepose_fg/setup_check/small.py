"""Small errors of cameras: principal points, a turn, a focal length; as few of them as explain the residuals."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.adjustment import CENTRE, FOCAL, POSE, Normal, Q, changed, normal_equations
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.fit import difference
from shapepose_fg.setup_check.matching import Groups
from shapepose_fg.setup_check.structure import KERNEL, Structure, observed, triangulate

Array = NDArray[np.float64]

_ROLL = [2]
Parts = tuple[tuple[tuple[int, ...], float], ...]
SHIFT: Parts = ((tuple(CENTRE), 10.0),)
ALL: Parts = (*SHIFT, (tuple(_ROLL), np.deg2rad(0.4)), (tuple(FOCAL), 0.02))
"""What a camera may have wrong, each with its unit of size: 10 px, 0.4 degrees, 2 percent. Turns sideways and up
are not among them: to people in the middle of the picture they are a shift of the principal point."""
_PRIOR = 0.05
"""The weight of not changing a camera, against all that it saw. Joints of one person, and of frames that follow
each other, err alike: of twenty one is independent."""
_ROUNDS, _SPARSE_STEPS = 3, 12
_MOST_PEOPLE = 160


@dataclass(frozen=True)
class SmallErrors:
    """The least changes that explain the residuals."""

    centre_px: Array
    """(V, 2) how much further right and down each principal point seems to be than the calibration says."""
    roll_deg: Array
    """(V,) by how much each camera seems to be turned about its axis."""
    focal: Array
    """(V,) each focal length over that of the calibration."""
    views: Views
    """The cameras after the changes."""
    shift_deg: Array
    """(V,) the shift of the principal point as a turn of the camera."""
    shift_sigma_deg: Array
    """(V,) how far the shift is known, all other small errors being free."""
    roll_sigma_deg: Array
    """(V,) the same of the roll."""
    focal_sigma: Array
    """(V,) the same of the focal length, as a part of it."""
    median_px: tuple[Array, Array]
    """(V,) median residual before and after, pixels."""
    cost: float
    """What remains of the robust cost of all residuals, as a part of what it was."""
    pose_gain: float
    """At least so much of the cost another pose of one camera alone would take away."""


@dataclass(frozen=True)
class OtherPose:
    """The pose of one camera that explains most."""

    view: int
    """Which camera."""
    turned_deg: float
    """By how much it is turned."""
    moved: float
    """How far it is moved, the calibration's unit."""
    views: Views
    """The cameras after the change."""
    cost: float
    """What remains of the robust cost of all residuals, as a part of what it was."""


def small_errors(look: Look, parts: Parts = ALL) -> SmallErrors:
    """What small errors of the cameras the residuals look like, with a sparse prior."""
    views, seen = look.setup.views, _seen(look)
    total = np.zeros(len(views) * Q)
    structure = first = triangulate(*seen, views, 5)
    normal = normal_equations(structure, views)
    roll_sigma, shift_sigma, focal_sigma = _sigmas(normal, len(views))
    pose_gain = float(_pose_gains(normal, len(views)).max() / max(_cost(first), 1e-12))
    for number in range(_ROUNDS):
        normal = normal if number == 0 else normal_equations(structure, views)
        step_taken = _sparse_step(normal, structure, total, parts)
        total = total + step_taken
        views = changed(views, step_taken.reshape(-1, Q))
        structure = triangulate(*seen, views, 4)
    change = total.reshape(-1, Q)
    cost = _cost(structure) / max(_cost(first), 1e-12)
    medians = (_median_px(first), _median_px(structure))
    shift, roll = np.rad2deg(np.hypot(*change[:, CENTRE].T) / views.focal_px), np.rad2deg(change[:, 2])
    return SmallErrors(
        change[:, CENTRE],
        roll,
        np.exp(change[:, 8]),
        views,
        shift,
        np.rad2deg(shift_sigma / views.focal_px),
        np.rad2deg(roll_sigma),
        focal_sigma,
        medians,
        cost,
        pose_gain,
    )


def _pose_gains(normal: Normal, views: int) -> Array:
    """(V,) by how much another pose of each camera lowers the weighted squares: the robust cost falls by more."""
    blocks = [np.array(POSE) + Q * view for view in range(views)]
    return np.array([-normal.g[block] @ normal.solve(block) for block in blocks])


def _sigmas(normal: Normal, views: int) -> tuple[Array, Array, Array]:
    """(V,) sigma of each camera's roll, radians, of its shift, pixels, and of its focal length (logarithm)."""
    columns = np.array([view * Q + c for view in range(views) for c in (2, *CENTRE, 8)])
    prior = np.tile([np.deg2rad(1.0), 20.0, 20.0, 0.03], views) ** -2.0
    H = _PRIOR * normal.H[np.ix_(columns, columns)] + np.diag(prior)
    sigma = np.sqrt(np.diag(np.linalg.inv(H))).reshape(views, 4)
    return sigma[:, 0], np.hypot(sigma[:, 1], sigma[:, 2]), sigma[:, 3]


def other_pose(look: Look) -> OtherPose:
    """The one camera whose pose, changed, explains most of the residuals."""
    views, seen = look.setup.views, _seen(look)
    structure = first = triangulate(*seen, views, 5)
    normal = normal_equations(structure, views)
    view = int(np.argmax(_pose_gains(normal, len(views))))
    columns = np.array(POSE) + Q * view
    for number in range(_ROUNDS):
        normal = normal if number == 0 else normal_equations(structure, views)
        step = np.zeros(len(views) * Q)
        step[columns] = normal.solve(columns)
        views = changed(views, step.reshape(-1, Q))
        structure = triangulate(*seen, views, 4)
    given = look.setup.views
    turned, moved = difference(given.cTw[view], views.cTw[view])
    return OtherPose(view, turned, moved, views, _cost(structure) / max(_cost(first), 1e-12))


def _seen(look: Look) -> tuple[Array, Array, Array]:
    """What is observed of people, spread over the frames."""
    groups = look.groups()
    step = max(1, -(-len(groups) // _MOST_PEOPLE))
    return observed(Groups(groups.frame[::step], groups.member[::step]), look.sightings)


def _sparse_step(normal: Normal, structure: Structure, total: Array, parts: Parts) -> Array:
    """The step (V Q,) of all cameras whose sum with `total` is small in most groups (iterated reweighting)."""
    V = structure.xy.shape[2]
    count = (structure.weight > 0).sum(axis=(0, 1))
    columns = np.array([view * Q + c for view in range(V) for names, _ in parts for c in names])
    H, g = normal.H[np.ix_(columns, columns)], normal.g[columns]
    unit = np.concatenate([[size] * len(names) for _ in range(V) for names, size in parts])
    group = np.concatenate([[i] * len(names) for i, (names, _) in enumerate(parts * V)])
    own = np.diag(H)
    moved = total[columns]
    size = np.ones(V * len(parts))
    step = np.zeros(len(columns))
    for _ in range(_SPARSE_STEPS):
        information = _PRIOR * own / (size[group] + 0.05) + 1e-6 * own + 1e-12
        step = np.linalg.solve(H + np.diag(information), -(g + information * moved))
        size = np.sqrt(np.bincount(group, ((moved + step) / unit) ** 2))
    step = np.where(np.repeat(count > 0, len(columns) // V), step, 0.0)
    full = np.zeros(V * Q)
    full[columns] = step
    return full


def _cost(structure: Structure) -> float:
    """Sum of the residuals' robust costs (Cauchy), in parts of people's sizes."""
    scale = (KERNEL * np.where(np.isnan(structure.size_px), 1.0, structure.size_px)[:, None]) ** 2
    square = (structure.residual**2).sum(axis=-1) / scale
    seen = (structure.weight > 0) & np.isfinite(square)
    return float(np.log1p(square[seen]).sum())


def _median_px(structure: Structure) -> Array:
    """(V,) median distance of projections to detections; NaN for a camera without people."""
    distance = np.linalg.norm(structure.residual, axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.nan)
    return np.array([np.nan if np.isnan(d).all() else np.nanmedian(d) for d in np.moveaxis(distance, 2, 0)])


def with_small_errors(look: Look, found: SmallErrors) -> Look:
    """The same recording, the cameras without their small errors."""
    return Look(look.evidence, replace(look.setup, views=found.views))
