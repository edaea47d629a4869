"""Small errors of cameras: principal points, a turn, a focal length; as few of them as explain the residuals."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

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
    cost: float
    """What remains of the robust cost of all residuals, as a part of what it was."""


@dataclass(frozen=True)
class _Problem:
    """The residuals of a recording, to be explained by changes of its cameras."""

    seen: tuple[Array, Array, Array]
    """See `observed`."""
    views: Views
    """The cameras before."""
    structure: Structure
    """The people before."""
    normal: Normal
    """The normal equations there."""

    @classmethod
    def of(cls, look: Look) -> "_Problem":
        """Of people spread over the frames."""
        groups, views = look.groups(), look.setup.views
        step = max(1, -(-len(groups) // _MOST_PEOPLE))
        seen = observed(Groups(groups.frame[::step], groups.member[::step]), look.sightings)
        structure = triangulate(*seen, views, 5)
        return cls(seen, views, structure, normal_equations(structure, views))

    def solved(self, step: Callable[[Normal, Structure, Array], Array]) -> tuple[Views, Array, float]:
        """Cameras after some steps (V Q,), the steps' sum (V, Q), and the part of the robust cost that remains.

        `step` is told the normal equations, the people, and the sum so far.
        """
        views, structure, total = self.views, self.structure, np.zeros(len(self.views) * Q)
        for number in range(_ROUNDS):
            normal = self.normal if number == 0 else normal_equations(structure, views)
            change = step(normal, structure, total)
            total = total + change
            views = changed(views, change.reshape(-1, Q))
            structure = triangulate(*self.seen, views, 4)
        return views, total.reshape(-1, Q), _cost(structure) / max(_cost(self.structure), 1e-12)

    @property
    def pose_gains(self) -> Array:
        """(V,) by how much another pose of each camera lowers the weighted squares, at least the robust cost."""
        blocks = [np.array(POSE) + Q * view for view in range(len(self.views))]
        return np.array([-self.normal.g[block] @ self.normal.solve(block) for block in blocks])


def small_errors(look: Look, parts: Parts = ALL) -> SmallErrors:
    """What small errors of the cameras the residuals look like, with a sparse prior."""
    problem = _Problem.of(look)
    roll_sigma, shift_sigma, focal_sigma = _sigmas(problem.normal, len(problem.views))
    pose_gain = float(problem.pose_gains.max() / max(_cost(problem.structure), 1e-12))
    views, change, cost = problem.solved(partial(_sparse_step, parts=parts))
    return SmallErrors(
        centre_px=change[:, CENTRE],
        roll_deg=np.rad2deg(change[:, 2]),
        focal=np.exp(change[:, 8]),
        views=views,
        shift_deg=np.rad2deg(np.hypot(*change[:, CENTRE].T) / views.focal_px),
        shift_sigma_deg=np.rad2deg(shift_sigma / views.focal_px),
        roll_sigma_deg=np.rad2deg(roll_sigma),
        focal_sigma=focal_sigma,
        cost=cost,
        pose_gain=pose_gain,
    )


def _sigmas(normal: Normal, views: int) -> tuple[Array, Array, Array]:
    """(V,) sigma of each camera's roll, radians, of its shift, pixels, and of its focal length (logarithm)."""
    columns = np.array([view * Q + c for view in range(views) for c in (2, *CENTRE, 8)])
    prior = np.tile([np.deg2rad(1.0), 20.0, 20.0, 0.03], views) ** -2.0
    H = _PRIOR * normal.H[np.ix_(columns, columns)] + np.diag(prior)
    sigma = np.sqrt(np.diag(np.linalg.inv(H))).reshape(views, 4)
    return sigma[:, 0], np.hypot(sigma[:, 1], sigma[:, 2]), sigma[:, 3]


def other_pose(look: Look) -> OtherPose:
    """The one camera whose pose, changed, explains most of the residuals."""
    problem = _Problem.of(look)
    view = int(np.argmax(problem.pose_gains))
    columns = np.array(POSE) + Q * view

    def step(normal: Normal, structure: Structure, total: Array) -> Array:
        change = np.zeros_like(total)
        change[columns] = normal.solve(columns)
        return change

    views, _, cost = problem.solved(step)
    return OtherPose(view, *difference(problem.views.cTw[view], views.cTw[view]), cost)


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


def with_small_errors(look: Look, found: SmallErrors) -> Look:
    """The same recording, the cameras without their small errors."""
    return Look(look.evidence, replace(look.setup, views=found.views))
