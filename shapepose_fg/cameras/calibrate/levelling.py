"""Aligns a rig with the world: scale from people's stature, up from standing people, the floor at
0.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.cameras.bundle import Adjusted
from shapepose_fg.cameras.parameters import MOVE
from shapepose_fg.cameras.people import People
from shapepose_fg.cameras.stature import ADULT_M, build_of
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.floor import Floor, find_floor

_PERSON, _KNOWN_PERSON, _COMMON = 0.07, 0.02, 0.025
"""Standard deviations of the scale from `build_of`, as shares of the scale: from the bones of one
adult, from those of one person of known stature, and the error that the detector makes for all
people."""
_TAPE_M = 0.02
"""Standard deviation of a distance between lenses that was measured with a tape, m."""
_CLEARLY = 1.3
"""Ratio of standard deviations from which another measurement is recommended."""
CONTRADICTS = 3.0
"""Number of standard deviations above which measurements contradict each other."""
_LEAN_RAD = np.radians(3.0)
"""Maximum lean of people's mean trunk for the search of the floor, rad."""
_ANKLE_M = 0.10
"""Height of a standing person's ankles above the floor, m."""


@dataclass(frozen=True)
class Measured:
    """Prior on the size of the rig: distances between cameras, or people's stature, by default that
    of adults.
    """

    stature_m: float | None = None
    """Median stature of the people, m; None for adults'."""
    distances: tuple[tuple[int, int, float], ...] = ()
    """Pairs of cameras, and metres between their lenses; if given, they determine the scale."""

    def better(self, adjusted: Adjusted, sigma: float) -> tuple[str, ...]:
        """A note if the distance of the two cameras that are farthest apart would determine the
        scale clearly better than `sigma`.
        """
        distance_m = np.linalg.norm(adjusted.rig.centres[:, None] - adjusted.rig.centres, axis=-1)
        a, b = sorted(int(each) for each in np.unravel_index(distance_m.argmax(), distance_m.shape))
        other = Measured(None, ((a, b, float(distance_m[a, b])),)).size_of(adjusted)[1]
        if _CLEARLY * other > sigma:
            return ()
        one, two = (adjusted.rig.names[each] for each in (a, b))
        return (
            f"--distance {one},{two}=METRES, of the cameras that are farthest apart, would give "
            f"all lengths to {100 * other:.1f} %, one sigma, instead of {100 * sigma:.1f} %",
        )

    def size_of(self, adjusted: Adjusted) -> tuple[float, float]:
        """Scale factor of the cameras from the distances, and its standard deviation.

        Raises InputError if distances contradict each other.
        """
        rig, V = adjusted.rig, len(adjusted.rig)
        length, metres = (
            np.empty(len(self.distances)),
            np.array([each for *_, each in self.distances]),
        )
        sigma = np.empty(len(self.distances))
        for n, (a, b, _) in enumerate(self.distances):
            baseline = rig.centres[a] - rig.centres[b]
            length[n] = np.linalg.norm(baseline)
            change = np.zeros((V, adjusted.covariance.shape[1]))
            for view, sign in ((a, 1.0), (b, -1.0)):
                change[view, MOVE] = sign * rig.cameras[view].wTc[:3, :3].T @ baseline / length[n]
            variance = np.einsum("vq,vqwr,wr->", change, adjusted.covariance, change)
            sigma[n] = np.hypot(np.sqrt(max(variance, 0.0)) / length[n], _TAPE_M / metres[n])
        weight, logs = 1 / sigma**2, np.log(metres / length)
        log = float(np.average(logs, weights=weight))
        worst = int(np.abs((logs - log) / sigma).argmax())
        if abs(logs[worst] - log) > CONTRADICTS * sigma[worst]:
            a, b, given = self.distances[worst]
            raise InputError(
                f"distance of {rig.names[a]} and {rig.names[b]}: people and the other distances "
                f"give {np.exp(log) * length[worst]:.2f} m instead of {given:g} m; measure again"
            )
        return float(np.exp(log)), float(1 / np.sqrt(weight.sum()))


@dataclass(frozen=True)
class World:
    """Scale, up and floor of a levelled rig."""

    sigma_scale: float
    """Standard deviation of the scale, as a share of the scale."""
    stature_m: float
    """Median stature of the people, metres, at this scale."""
    persons: int
    """Number of people seen at once."""
    floor: Floor | None
    """Floor under the ankles, in the frame before levelling; None if they are not on a
    level plane."""
    upright: float
    """Agreement of people's upright directions: the length of their trunks' mean direction, 1 at
    most."""


def scale_of(points: Array, skeleton: Skeleton, stature_m: float | None) -> float:
    """Metres per unit of people's joints (P, J, 3), for a median stature `stature_m`, or an
    adult's; NaN without bones.
    """
    return (stature_m or ADULT_M) / build_of(points, skeleton).stature


def people_at_once(people: People) -> int:
    """Number of people seen at the same time: the 90 % quantile over the frames."""
    _, counts = np.unique(people.frame, return_counts=True)
    return int(np.percentile(counts, 90)) if len(counts) > 0 else 0


def sigma_of_scale(persons: int, known: bool) -> float:
    """Standard deviation of the scale, as a share, from the bones of `persons` people, of `known`
    stature or not.
    """
    return float(
        np.hypot((_KNOWN_PERSON if known else _PERSON) / np.sqrt(max(persons, 1)), _COMMON)
    )


def levelled(rig: Rig, people: People, skeleton: Skeleton, sigma_scale: float) -> tuple[Rig, World]:
    """The rig with z up, the floor at 0, people in the centre, and y away from the first camera."""
    build = build_of(people.points, skeleton)
    upright = float(np.linalg.norm(build.up))
    up = build.up / upright if upright > 0 else -rig.cameras[0].wTc[:3, 1]
    names = [skeleton.joints[joint] for joint in skeleton.core]
    feet = [n for n, name in enumerate(names) if name.endswith("Ankle")]
    # With two views only, one ankle in fifty is 10 cm below the floor.
    well_seen = (people.seen[:, feet].sum(axis=-1) >= min(3, len(rig))).all(axis=1)
    ankles = people.points[well_seen][:, feet]
    floor: Floor | None = None
    for _ in range(2):
        height = ankles @ up
        low = (
            ankles[np.arange(len(ankles)), height.argmin(axis=1)]
            if height.size > 0
            else np.zeros((0, 3))
        )
        found = find_floor(low, np.arange(len(low)), up, _LEAN_RAD)
        floor = found if isinstance(found, Floor) else None
        up = floor.normal if floor is not None else up
    at = np.nanmedian(people.points.reshape(-1, 3), axis=0)
    if floor is not None:
        bottom = floor.height_m - _ANKLE_M
    else:
        bottom = float(np.median(low @ up)) - _ANKLE_M if len(low) > 0 else float(at @ up) - 1.0
    right = rig.cameras[0].wTc[:3, 0]
    right = right - (right @ up) * up
    x = right / np.linalg.norm(right)
    R = np.stack([x, np.cross(up, x), up])
    move = -R @ at
    move[2] = -bottom
    wTc = rig.wTc
    wTc[:, :3] = R @ wTc[:, :3]
    wTc[:, :3, 3] += move
    world = World(sigma_scale, build.stature, people_at_once(people), floor, upright)
    return Rig(rig.at_poses(wTc).cameras, "z"), world
