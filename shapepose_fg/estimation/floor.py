"""The floor: the plane on which feet stand."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.decompositions import basis_across

MEASUREMENT_S = 1.5
"""Time for which a standing foot counts as one measurement of the floor, s: errors of joints are
correlated as long."""
LEAST_MEASUREMENTS = 6
"""Minimum number of measurements for a floor: two feet of one person over five seconds, or of three
people in the same second."""
AGREE = 0.6
"""Minimum share of measurements that agree on the floor. The others may be feet on chairs, or
crossed legs."""
NEAR_M = 0.06
"""Distance from the floor within which a foot stands on it, m: in simulated recordings of 3 to 6
cameras 99 % of the bodies' lowest points are within 4 cm."""
UNDER_M = 0.1
"""Depth below the floor, m, at which a foot contradicts it."""
UNDER_SHARE = 0.05
"""Maximum share of measurements below the floor, due to badly fitted bodies: with two cameras that
face each other up to 4 in 100, with three and more none (simulated). With more, there is another
floor, and none is reported."""
SCALE_M = 0.015
"""Standard deviation of the soles of bodies from the floor, metres; width of the kernel."""
TILT_RAD = np.deg2rad(0.5)
"""Standard deviation of the floor's tilt about either axis, rad, relative to the cameras' up."""
SOLE_M = 0.01
"""Common error of all soles, m: shoes, and the offsets of the detector's joints. In simulated
recordings the floor is found 2 to 6 mm too low."""


@dataclass(frozen=True)
class Floor:
    """A floor plane."""

    normal: Array
    """(3,) unit vector that points up."""
    height_m: float
    """Height of all points of the floor along the normal, metres."""
    sigma_m: float
    """Standard deviation of the height, below the centre of the feet used, metres."""
    looks: int
    """Number of independent measurements of the floor, one for each 1.5 s that a foot stands."""
    share: float
    """Share of the measurements of standing feet that agree with the floor."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values for run.json; `from_dict` reads them back."""
        return {"found": True, "normal": self.normal.tolist(), "height_m": self.height_m} | {
            name: getattr(self, name) for name in ("sigma_m", "looks", "share")
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any] | None) -> "Floor | None":
        """Inverse of `as_dict`; None for a run without a floor."""
        if values is None or not values["found"]:
            return None
        rest = {name: values[name] for name in ("height_m", "sigma_m", "looks", "share")}
        return cls(normal=np.array(values["normal"]), **rest)


def find_floor(
    points: Array, measurement: Index, up: Array, tilt_rad: float = TILT_RAD
) -> Floor | str:
    """The floor under `points` (N, 3), the lowest points of standing feet; else the reason why
    there is none.

    `measurement` (N,) is the number of the measurement to which each point belongs: errors within
    one are correlated. A robust fit of a plane, level up to `tilt_rad`, starts at the height at
    which most measurements agree.
    """
    numbers, group, count = np.unique(measurement, return_inverse=True, return_counts=True)
    if len(numbers) < LEAST_MEASUREMENTS:
        return (
            f"{len(numbers)} measurements of standing feet, but at least {LEAST_MEASUREMENTS} are "
            "needed"
        )
    weight, height = 1.0 / count[group], points @ up
    order = np.argsort(height, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(weight[order])])
    within = (
        total[np.searchsorted(height[order], height[order] + 2 * NEAR_M, side="right")] - total[:-1]
    )
    start = height[order][within.argmax()] + NEAR_M
    middle = np.average(points, axis=0, weights=weight * (np.abs(height - start) <= NEAR_M))
    across = basis_across(up)
    design = np.concatenate([np.ones((len(points), 1)), (points - middle) @ across.T], axis=1)
    prior = np.diag([0.0, *np.full(2, (SCALE_M / tilt_rad) ** 2)])
    found = np.array([start, 0.0, 0.0])
    for _ in range(20):
        kept = (
            weight * np.maximum(1 - ((height - design @ found) / (4.685 * SCALE_M)) ** 2, 0.0) ** 2
        )  # Tukey
        information = design.T @ (kept[:, None] * design) + prior
        found = np.linalg.solve(information, design.T @ (kept * height))
    left = height - design @ found
    share, under = (
        float(weight[chosen].sum() / len(numbers))
        for chosen in (np.abs(left) <= NEAR_M, left < -UNDER_M)
    )
    if share < AGREE:
        return (
            f"{share:.0%} of standing feet agree on a height, but at least {AGREE:.0%} are needed"
        )
    if under > UNDER_SHARE:
        return f"{under:.0%} of standing feet are below where most stand"
    normal = up - found[1:] @ across
    length = np.linalg.norm(normal)
    # The plane's height at the middle, converted to the distance along the normal.
    height_m = (found[0] - found[1:] @ (across @ middle)) / length
    sigma_m = np.hypot(SCALE_M * np.sqrt(np.linalg.inv(information)[0, 0]), SOLE_M)
    return Floor(normal / length, float(height_m), float(sigma_m), len(numbers), share)
