"""Probabilistic queries on uncertain joints: joint distributions, regions, and distances.

For any `Reconstruction`: saved, from `OnlineReconstructor.people`, or solved with user factors.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, fdtri, ndtr, roots_genlaguerre

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.decompositions import principal_axes, symmetric_root
from shapepose_fg.core.errors import NotDetermined
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.core.shipped_numbers import shipped_numbers
from shapepose_fg.estimation.camera_pose_uncertainty import POSES_LAST_S, reported_with_poses
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.estimation.in_time import moments
from shapepose_fg.estimation.window_solution import PersonGraph

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

_LASTS, _LASTS_S, _FADES_S = 0.62, 2.2, 0.115
"""Temporal correlation of a joint's errors, in standard deviations: a slow part, exp(-t / 2.2 s),
and a part smoothed by motion, (1 + t / 0.115 s) exp(-t / 0.115 s). Measured: 0.97, 0.84, 0.68,
0.52, 0.39, 0.25, 0.16 after 1, 4, 8, 16, 30, 60, 90 frames at 30 Hz, for two to six cameras and any
number of views (simulated: the recordings of `scripts/fit_covariances.py`)."""
_LIMBS = {
    ("Neck", "MidHip"): 0.50, ("Nose", "Neck"): 0.30, ("Eye", "Nose"): 0.52, ("Ear", "Eye"): 0.44,
    ("Shoulder", "Neck"): 0.71, ("Elbow", "Shoulder"): 0.23, ("Wrist", "Elbow"): 0.39,
    ("Hip", "MidHip"): 0.85, ("Knee", "Hip"): 0.53, ("Ankle", "Knee"): 0.47,
    ("Heel", "Ankle"): 0.78, ("BigToe", "Ankle"): 0.43, ("SmallToe", "BigToe"): 0.77,
}  # fmt: skip
"""Correlation of the errors of two joints of a person in one frame, in standard deviations, along a
limb; for other pairs the product along the path between them. Measured as above. Between two people
it is -0.02, approximated by 0."""
SURFACE_M = 0.015
"""Additional standard deviation of a point on a body's surface relative to the surrounding joints,
metres."""
_REACH_M = 0.15
"""Scale of the distance of joints that determine a surface point, m."""
_NODES, _WIDE = 24, 6.0
"""Number of nodes of the quadrature per axis, and its range in standard deviations on
either side."""
_SCALES = 4
"""Number of Gaussians in the mixture that represents Student's t."""
_STEPS = 64
"""Number of limits at which a distance's distribution is tabulated for quantiles."""


@dataclass(frozen=True)
class JointAt:
    """A joint of a person in a frame."""

    person: int
    joint: str
    frame: int


@dataclass(frozen=True)
class Marginal:
    """Joint Gaussian of K joints; its diagonal blocks are the reported covariances."""

    mean: Array
    """(K, 3) positions, metres, world."""
    covariance: Array
    """(3 K, 3 K) covariance, m², ordered by joint."""

    def block(self, one: int, other: int) -> Array:
        """(3, 3) covariance of the errors of two joints, by index, m²."""
        return self.covariance[3 * one : 3 * one + 3, 3 * other : 3 * other + 3]


def error_tails() -> float:
    """Degrees of freedom of Student's t, by which joints' errors are distributed: most are smaller
    than their covariance says and a few far larger. Measured by `scripts/fit_covariances.py`.
    """
    return float(shipped_numbers("estimation", "covariances")["tails"])


def squared_radius(share: float) -> float:
    """Squared Mahalanobis distance e^T C^-1 e up to which a `share` of all true joints lies. It is
    7.8 for 0.95, as for a Gaussian, since covariances are those of 95 % regions.
    """
    return 3 * _shape(error_tails()) * float(fdtri(3, error_tails(), share))


@cache
def _mixture(tails: float) -> tuple[Array, Array]:
    """(K,) shares and (K,) scales of the covariances of the Gaussians whose mixture is Student's t
    with the given degrees of freedom, and the same 95 % region as a Gaussian.
    """
    if np.isinf(tails):
        return np.ones(1), np.ones(1)
    nodes, shares = roots_genlaguerre(_SCALES, tails / 2 - 1)
    return shares / shares.sum(), _shape(tails) * tails / 2 / nodes


def _shape(tails: float) -> float:
    """Ratio of the covariance of a Gaussian's 95 % region to the shape matrix of the Student's t
    with the same region.
    """
    return float(chdtri(3, 0.05) / (3 * fdtri(3, tails, 0.95)))


@dataclass(frozen=True)
class Distance:
    """Distances (...,) between pairs of points, whose displacement is Gaussian or has Student's t.

    Near zero a distance is not Gaussian: its probabilities are integrals of three-dimensional
    Gaussians over balls, by quadrature, which is also accurate in the tails, unlike noncentral
    chi-square or moment fits.
    """

    displacement: Array
    """(..., 3) mean displacement from the first to the second point, metres."""
    covariance: Array
    """(..., 3, 3) covariance of the Gaussian with the same 95 % region as `displacement`, m²."""
    tails: float = np.inf
    """Degrees of freedom of Student's t (`error_tails` for joints); infinite for a Gaussian."""

    def below(self, limit_m: ArrayLike) -> Array:
        """Probability (...,) that the distance is below a limit (...,), metres."""
        parts = zip(*_mixture(self.tails), strict=True)
        return np.asarray(sum(share * self._in_ball(limit_m, scale) for share, scale in parts))

    def _in_ball(self, limit_m: ArrayLike, scale: float) -> Array:
        """`below` of a Gaussian with `scale` times the covariance.

        Along the axis of smallest spread the integral is that of a normal distribution, over the
        two others by Gauss-Legendre quadrature.
        """
        limit = np.asarray(limit_m, dtype=np.float64)
        values, axes = principal_axes(self.covariance)
        sigma = np.sqrt(np.maximum(scale * values, 1e-12))
        mean = np.einsum("...ij,...i->...j", axes, self.displacement)
        shape = np.broadcast_shapes(limit.shape, mean.shape[:-1])
        r = np.broadcast_to(np.maximum(limit, 0.0), shape)
        (m0, m1, m2), (s0, s1, s2) = (
            np.broadcast_to(np.moveaxis(each, -1, 0), (3, *shape)) for each in (mean, sigma)
        )
        z, at_z = _nodes(-r, r, m2, s2)
        left = np.sqrt(np.maximum(r[..., None] ** 2 - z**2, 0.0))
        y, at_y = _nodes(-left, left, m1[..., None], s1[..., None])
        x = np.sqrt(np.maximum(left[..., None] ** 2 - y**2, 0.0))
        m, s = m0[..., None, None], s0[..., None, None]
        inside = _normal((x - m) / s) - _normal((-x - m) / s)
        return np.clip(np.einsum("...i,...ij,...ij->...", at_z, at_y, inside), 0.0, 1.0)

    def quantile(self, probability: ArrayLike) -> Array:
        """Quantile of the distance (...,), metres, for a single probability."""
        limits, under = self._table()
        return _reached(float(np.asarray(probability)), under, limits)

    def interval(self, probability: float = 0.95) -> tuple[Array, Array]:
        """Confidence interval of the distance, metres, by Neyman's construction.

        It has the stated coverage at any true distance; quantiles do not near zero, where errors in
        three dimensions can only increase a distance. If the measured distance is shorter than
        errors allow, the interval would be nearly empty: the upper end is at least the quantile.
        """
        distance_m = np.linalg.norm(self.displacement, axis=-1)
        way = np.where(
            distance_m[..., None] > 0,
            self.displacement / np.maximum(distance_m, 1e-12)[..., None],
            [1.0, 0.0, 0.0],
        )
        limits = self._span()
        shorter = np.stack(
            [
                Distance(each[..., None] * way, self.covariance, self.tails).below(distance_m)
                for each in limits
            ]
        )
        ends = ((1 + probability) / 2, (1 - probability) / 2)
        low, high = (_reached(end, shorter[::-1], limits[::-1]) for end in ends)
        return low, np.maximum(high, self.quantile(ends[0]))

    @property
    def mean_m(self) -> Array:
        """(...,) expected distance, metres; larger than the distance of the means."""
        limits, under = self._table()
        return limits[0] + np.trapezoid(1.0 - under, limits, axis=0)

    @property
    def sigma_m(self) -> Array:
        """(...,) standard deviation, metres."""
        ratio, tails = 1.0, self.tails
        if np.isfinite(tails):
            ratio = _shape(tails) * tails / (tails - 2)
        variance = ratio * np.trace(self.covariance, axis1=-2, axis2=-1)
        square = (self.displacement**2).sum(axis=-1) + variance
        return np.sqrt(np.maximum(square - self.mean_m**2, 0.0))

    def _span(self) -> Array:
        """Limits (S, ...) that cover the range of the distances."""
        distance_m = np.linalg.norm(self.displacement, axis=-1)
        wide = 5.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance)[..., -1], 1e-12))
        first, last = np.maximum(distance_m - wide, 0.0), distance_m + wide
        return first + (last - first) * np.linspace(0, 1, _STEPS).reshape(
            -1, *(1,) * distance_m.ndim
        )

    def _table(self) -> tuple[Array, Array]:
        """Limits (S, ...) and the probabilities of distances below them."""
        limits = self._span()
        return limits, np.maximum.accumulate(
            np.stack([self.below(each) for each in limits]), axis=0
        )


@dataclass(frozen=True)
class SurfaceDistance:
    """Distance of a point from a body's surface, which is assumed planar within the errors."""

    signed_m: float
    """Signed distance, metres; negative inside the body."""
    sigma_m: float
    """Standard deviation, metres."""
    nearest: Array
    """(3,) nearest point on the surface, metres."""

    def below(self, limit_m: float) -> float:
        """Probability that the point is closer than a limit, metres, or inside."""
        return float(_normal(np.asarray((limit_m - self.signed_m) / self.sigma_m)))

    def interval(self) -> tuple[float, float]:
        """95 % interval of the distance, metres; 0 inside the body."""
        half_width_m = 1.959964 * self.sigma_m
        return max(self.signed_m - half_width_m, 0.0), max(self.signed_m + half_width_m, 0.0)


def marginal(
    people: Reconstruction,
    *joints: JointAt,
    rig: Rig | None = None,
    graphs: Iterable[PersonGraph] = (),
) -> Marginal:
    """Joint distribution of joints of any people and frames.

    The covariance of each is as reported; errors of two joints of a person, in standard deviations,
    have the measured correlation (`correlation`), which fades faster over time where the covariance
    of the velocity says so. With the `rig` of the reconstruction
    (`cameras.json`), errors from poses of moving cameras are common to all that they see. With the
    `graphs` of a result (`window_solutions(people, rig)`, with `extra_factors=` for user factors),
    joints of one frame, and those that factors couple, also of two people, have the graph's
    correlation. Raises NotDetermined for a joint without a position, ValueError for one that does
    not exist.
    """
    rows, numbers = (
        np.array([_place(people, each) for each in joints], dtype=np.intp).reshape(-1, 2).T
    )
    K = len(joints)
    reported = people.covariance[rows, numbers]
    shared = np.zeros((K, 3, K, 3))
    if rig is not None and rig.trajectories and K > 0:
        shared = _of_poses(people, rig, rows, numbers, reported)
    roots = symmetric_root(reported - np.einsum("aiaj->aij", shared))
    names, time_s = [each.joint for each in joints], np.nan_to_num(people.time_s[rows])
    pace = _paces(people, rows, numbers)
    apart_s = np.abs(time_s[:, None] - time_s) * (pace[:, None] + pace) / 2
    rho = correlation(names, names) * _over_time(apart_s)
    rho = _definite(rho * (people.person[rows][:, None] == people.person[rows]))
    errors = np.einsum("ab,ij->aibj", rho, np.eye(3))
    found = _of_graphs(list(graphs), joints, numbers, errors)
    covariance = np.einsum("aik,akbl,bjl->aibj", roots, found, roots) + shared
    return Marginal(people.joints[rows, numbers], covariance.reshape(3 * K, 3 * K))


def _of_graphs(
    graphs: Sequence[PersonGraph], joints: Sequence[JointAt], numbers: Index, errors: Array
) -> Array:
    """Correlations `errors` (K, 3, K, 3) of K joints, in standard deviations; replaced by the
    graph's for pairs that it correlates.
    """
    K, found, tied = len(joints), errors.copy(), False
    for graph in {id(each.window.ties): each for each in graphs}.values():
        members = {each.person: each for each in graph.together or [graph]}
        keys = dict[int, int]()
        for n, wanted in enumerate(joints):
            person = members.get(wanted.person)
            if person is not None and wanted.frame in person.frames:
                key = int(person.keys[np.flatnonzero(person.frames == wanted.frame)[0], numbers[n]])
                keys |= {n: key} if graph.values.exists(key) else {}
        nodes = {n: (joints[n].person, int(numbers[n]), joints[n].frame) for n in keys}
        pairs = [(a, b) for a in keys for b in keys if a < b and keys[a] != keys[b]]
        pairs = [(a, b) for a, b in pairs if graph.coupled(nodes[a], nodes[b])]
        wanted = sorted({keys[n] for pair in pairs for n in pair})
        if len(wanted) == 0:
            continue
        joint = gtsam.Marginals(graph.graph, graph.values).jointMarginalCovariance(
            gtsam.KeyVector(wanted)
        )
        white = {key: np.linalg.inv(symmetric_root(joint.at(key, key)[None])[0]) for key in wanted}
        tied = True
        for a, b in pairs:
            across = white[keys[a]] @ joint.at(keys[a], keys[b]) @ white[keys[b]].T
            found[a, :, b], found[b, :, a] = across, across.T
    if not tied:
        return errors
    return _definite(found.reshape(3 * K, 3 * K)).reshape(K, 3, K, 3)


def _definite(correlations: Array) -> Array:
    """Correlations (N, N) from several sources, scaled so that the whole is positive
    semi-definite.
    """
    off_diagonal = correlations - np.eye(len(correlations))
    least = np.linalg.eigvalsh(off_diagonal).min(initial=0.0)
    return np.eye(len(correlations)) + off_diagonal / max(1.0, -least)


def _of_poses(
    people: Reconstruction, rig: Rig, rows: Index, numbers: Index, reported: Array
) -> Array:
    """(K, 3, K, 3) error covariance of K joints from poses of moving cameras: common to all on one
    carrier, and correlated over time. In no direction it exceeds `reported` (K, 3, 3).
    """
    own = people.rows(rows)
    if own.observations is None:
        raise ValueError(
            "the measurements of moving cameras are missing: keep observations.npz, or give no rig"
        )
    seen, config = own.observations.observations(own.joints, own.time_s), ObservationConfig()
    views = Views.of(rig, seen.time_s)
    assert views.carried is not None
    goes = reported_with_poses(seen, own.joints, views, config, own.joint_names.tolist())
    goes = goes[np.arange(len(rows)), numbers] @ symmetric_root(views.carried.covariance)
    ends = symmetric_root(np.asarray(np.linalg.inv(reported), dtype=np.float64)) @ np.moveaxis(
        goes, 1, 2
    ).reshape(len(rows), 3, -1)
    most = np.linalg.eigvalsh(ends @ ends.mT)[:, -1]
    goes /= np.sqrt(np.maximum(most, 1.0))[:, None, None, None]
    lasting = np.exp(-np.abs(own.time_s[:, None] - own.time_s) / POSES_LAST_S)
    return np.einsum("abik,ac,cbjk->aicj", goes, lasting, goes)


def distance(
    people: Reconstruction,
    one: JointAt,
    other: JointAt | ArrayLike,
    *,
    rig: Rig | None = None,
    graphs: Iterable[PersonGraph] = (),
) -> Distance:
    """Distance from a joint to another, or to a point (3,) in the world, metres, or to many (...,
    3); `rig` and `graphs` as in `marginal`.
    """
    if isinstance(other, JointAt):
        both = marginal(people, one, other, rig=rig, graphs=graphs)
        across = both.block(0, 1)
        covariance = both.block(0, 0) + both.block(1, 1) - across - across.T
        return Distance(both.mean[1] - both.mean[0], covariance, error_tails())
    joint_marginal, points = marginal(people, one), np.asarray(other, dtype=np.float64)
    displacement = points - joint_marginal.mean[0]
    covariance = np.broadcast_to(joint_marginal.covariance, (*displacement.shape, 3))
    return Distance(displacement, covariance, error_tails())


def distances(people: Reconstruction, point: ArrayLike) -> Distance:
    """Distances from all joints (N, J) to a point (3,) in the world, or one per row (N, 3), metres;
    NaN if unknown.
    """
    points = np.broadcast_to(np.asarray(point, dtype=np.float64), (len(people), 3))
    return Distance(points[:, None] - people.joints, people.covariance, error_tails())


def surface_distance(
    people: Reconstruction, body: "BodyModel", person: int, frame: int, point: ArrayLike
) -> SurfaceDistance:
    """Distance from a person's body surface to a point (3,) in the world, metres.

    The surface's error is that of the joints around its nearest point, plus `SURFACE_M`. Raises
    NotDetermined if the person has no body in the frame.
    """
    from shapepose_fg.body.model.body_model import BodyParameters

    row, where = _row(people, person, frame), np.asarray(point, dtype=np.float64)
    columns = [getattr(people, name)[[row]] for name in BODY]
    if not all(np.isfinite(each).all() for each in columns):
        raise NotDetermined(
            person, "body", frame, float(people.time_s[row]), f"its status is {people.status[row]}"
        )
    vertices = body.vertices(BodyParameters(*columns))[0]
    near = int(((vertices - where) ** 2).sum(axis=1).argmin())
    around = vertices[body.faces[(body.faces == near).any(axis=1)]]
    normals = np.cross(around[:, 1] - around[:, 0], around[:, 2] - around[:, 0])
    normal = normals.sum(axis=0) / max(np.linalg.norm(normals.sum(axis=0)), 1e-12)
    nearest, displacement = vertices[near], where - vertices[near]
    signed, length = float(displacement @ normal), float(np.linalg.norm(displacement))
    # Within the triangles around the vertex the distance is to the plane, else to the vertex.
    beside = np.sqrt(max(length**2 - signed**2, 0.0)) > np.sqrt(
        ((around - nearest) ** 2).sum(axis=-1).max()
    )
    if beside and length > 0:
        normal, signed = (
            displacement / length * (1.0 if signed >= 0 else -1.0),
            length * (1.0 if signed >= 0 else -1.0),
        )
    names = people.joint_names.tolist()
    known = np.isfinite(people.covariance[row]).all(axis=(1, 2)) & np.isfinite(
        people.joints[row]
    ).all(axis=1)
    weight = np.exp(-0.5 * ((people.joints[row] - nearest) ** 2).sum(axis=1) / _REACH_M**2)
    weight = np.where(known, weight, 0.0)
    chosen = np.argsort(-weight, kind="stable")[:4]
    chosen = chosen[known[chosen]]
    if len(chosen) == 0:
        raise NotDetermined(
            person, "body", frame, float(people.time_s[row]), "none of its joints has a position"
        )
    share = weight[chosen] / max(weight[chosen].sum(), 1e-300)
    both = marginal(people, *(JointAt(person, names[j], frame) for j in chosen.tolist()))
    along = (share[:, None] * normal).ravel()
    variance = float(along @ both.covariance @ along) + SURFACE_M**2
    return SurfaceDistance(signed, float(np.sqrt(variance)), nearest)


def correlation(one: Sequence[str], other: Sequence[str]) -> Array:
    """(A, B) correlation of the errors of joints of one person in one frame, by names; unknown
    joints are correlated only with themselves.
    """
    return np.array([[_together(a, b) for b in other] for a in one]).reshape(len(one), len(other))


def _over_time(apart_s: Array) -> Array:
    """Correlation (...) of a joint's errors at time differences `apart_s` (...), seconds."""
    fading = apart_s / _FADES_S
    return (1 - _LASTS) * (1 + fading) * np.exp(-fading) + _LASTS * np.exp(-apart_s / _LASTS_S)


def _paces(people: Reconstruction, rows: Index, joints: Index) -> Array:
    """(K,) how many times faster than usual the errors of joints change, by row and joint.

    The covariance of a velocity is that of the difference of two positions, and so says how
    correlated their errors are: less than usual where a joint is fast and little is averaged. At
    least 1, and 1 where there is no velocity.
    """
    lasts = np.full(len(people.person), np.nan)
    for person in np.unique(people.person[rows]).tolist():
        of_person = np.flatnonzero(people.person == person)
        of_person = of_person[np.argsort(people.time_s[of_person], kind="stable")]
        if len(of_person) > 1 and (np.diff(people.time_s[of_person]) > 0).all():
            lasts[of_person] = moments(people.time_s[of_person])[2]
    own = np.trace(people.covariance[rows, joints], axis1=-2, axis2=-1)
    speed = np.trace(people.velocity_covariance[rows, joints], axis1=-2, axis2=-1)
    correlated = 1 - speed * lasts[rows] ** 2 / (2 * own)
    usual_s = np.geomspace(1e-4, 10.0, 200)
    at_s = np.interp(-correlated, -_over_time(usual_s), usual_s)
    return np.where(np.isfinite(correlated), np.maximum(at_s / lasts[rows], 1.0), 1.0)


def _together(one: str, other: str) -> float:
    """Correlation of two joints: the product along the limbs between them, 0 if not connected."""
    ways = _way_up(one), _way_up(other)
    common = next((name for name in ways[0] if name in ways[1]), None)
    return 0.0 if common is None else ways[0][common] * ways[1][common]


def _way_up(joint: str) -> dict[str, float]:
    """Joints on the path from one to the middle of the hips, with the correlation to each."""
    way, side, correlation = {joint: 1.0}, joint[0] if joint[:1] in ("R", "L") else "", 1.0
    table = {f"{s}{a}": (b if b in ("Neck", "MidHip", "Nose") else f"{s}{b}", r)
             for (a, b),
             r in _LIMBS.items() for s in (("",) if a in ("Neck", "Nose") else (side,
                                                                                ))}  # fmt: skip
    while joint in table:
        joint, along = table[joint]
        way[joint] = correlation = correlation * along
    return way


def _row(people: Reconstruction, person: int, frame: int) -> int:
    row = np.flatnonzero((people.person == person) & (people.frame == frame))
    if len(row) == 0:
        raise ValueError(f"person {person} is not in frame {frame} of these people")
    return int(row[0])


def _place(people: Reconstruction, joint_at: JointAt) -> tuple[int, int]:
    """Row and index of a joint with a position."""
    row, names = _row(people, joint_at.person, joint_at.frame), people.joint_names.tolist()
    if joint_at.joint not in names:
        raise ValueError(
            f"joint {joint_at.joint}: there is no joint of this name; there are {' '.join(names)}"
        )
    joint = names.index(joint_at.joint)
    if not (
        np.isfinite(people.joints[row, joint]).all()
        and np.isfinite(people.covariance[row, joint]).all()
    ):
        raise NotDetermined(
            joint_at.person,
            joint_at.joint,
            joint_at.frame,
            float(people.time_s[row]),
            _missing(people, row, joint),
        )
    return row, joint


def _missing(people: Reconstruction, row: int, joint: int) -> str:
    """The missing evidence for a joint without a position."""
    table, body = (
        people.observations,
        "" if np.isfinite(people.transl[row]).all() else ", and no body was fitted",
    )
    if table is None:
        return f"the row's status is {people.status[row]}{body}"
    used = table.view_names[table.used[row, joint]].tolist()
    views = {0: "no camera's detection was used", 1: f"only camera {' '.join(used)} saw it"}
    return views.get(len(used), f"cameras {', '.join(used)} do not determine it") + body


def _reached(probability: float, rising: Array, limits: Array) -> Array:
    """Limits (...,) at which probabilities (S, ...) of `limits` (S, ...) reach one value,
    interpolated.
    """
    columns = zip(rising.reshape(len(rising), -1).T, limits.reshape(len(limits), -1).T, strict=True)
    return np.array([np.interp(probability, *each) for each in columns]).reshape(limits.shape[1:])


_AT, _WEIGHT = np.polynomial.legendre.leggauss(_NODES)


def _nodes(low: Array, high: Array, mean: Array, sigma: Array) -> tuple[Array, Array]:
    """Quadrature nodes (..., n) and weights for a normal distribution between two limits."""
    first = np.clip(mean - _WIDE * sigma, low, high)[..., None]
    last = np.clip(mean + _WIDE * sigma, low, high)[..., None]
    x = (first + last) / 2 + (last - first) / 2 * _AT
    z = (x - mean[..., None]) / sigma[..., None]
    density = np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * sigma[..., None])
    return x, (last - first) / 2 * _WEIGHT * density


def _normal(z: Array) -> Array:
    """The standard normal distribution function."""
    return np.asarray(ndtr(z))
