"""Small errors of cameras: principal points, a turn, a focal length; as few of them as explain the residuals.

The points are not known, so that what a change moves *along with the points* explains nothing: GTSAM eliminates
them (bundle adjustment).
"""

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, replace
from functools import cached_property, partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, K, P

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.assignment import least_cost_pairs
from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.evidence import KERNEL, Look, Structure, observed, triangulate
from shapepose_fg.setup_check.findings import SURE, Finding, Kind, one_of
from shapepose_fg.setup_check.fit import CENTRE, FOCAL, POSE, TURN, Pinhole, Q, changed, difference
from shapepose_fg.setup_check.matching import Groups, least_of_each
from shapepose_fg.setup_check.over_time import unturned

_ROLL = [2]
Parts = tuple[tuple[list[int], float], ...]
SHIFT: Parts = ((CENTRE, 10.0),)
ONE = {Kind.TURNED: TURN, Kind.MOVED: POSE, Kind.FOCAL: FOCAL, Kind.PRINCIPAL_POINT: CENTRE}
"""What one camera alone may have wrong."""
ALL: Parts = (*SHIFT, (_ROLL, np.deg2rad(0.4)), (FOCAL, 0.02))
"""What a camera may have wrong, each with its unit of size: 10 px, 0.4 degrees, 2 percent. Turns sideways and up
are not among them: to people in the middle of the picture they are a shift of the principal point."""
_PRIOR = 0.05
"""The weight of not changing a camera, against all that it saw. Joints of one person, and of frames that follow
each other, err alike: of twenty one is independent."""
_ROUNDS, _SPARSE_STEPS = 3, 12
_REACH, _FORGOTTEN, _BESIDE = 1.4, 40, 0.3
"""A person is followed from frame to frame over so many times the spread of the joints (two thirds of a metre),
and sought for so many frames; in a picture it is within this part of its size of where it was."""
_LEAST_OF_ONE = 6
"""Fewer frames of one person say nothing of a bias."""
_BIAS, _LIKELY_BIAS = 0.1, 2.0
"""A detector's bias on one person, part of the size (one sigma), and how much likelier than
none it must be to be taken away."""
_TURN, _MOVE, _FOCAL = np.deg2rad(3.0), 0.05, 0.1
"""How large a small mistake of a camera usually is (one sigma): a turn, or a shift as large; a move, part
of the people's distance; the logarithm of the focal length."""
_LEAST_PART = 8
"""A camera is bumped neither in the first of so many parts of the recording nor in the last."""
_MOST_PEOPLE, _MOST_BIASES = 160, 4
_TURN_DEG = 1.0
"""A camera that is moved and turned by more is called turned."""
_WEAK = 1e-6
"""The information that a point has without any view, as a part of what it has: two rays may be parallel."""


@dataclass(frozen=True)
class Normal:
    """Normal equations of all cameras' small changes, the points taken out."""

    H: Array
    """(V Q, V Q)."""
    g: Array
    """(V Q,)."""

    def solve(self, columns: Index) -> Array:
        """The change (n,) of some parameters that lowers the squares most."""
        H = self.H[np.ix_(columns, columns)]
        return np.asarray(-np.linalg.lstsq(H, self.g[columns], rcond=1e-10)[0], dtype=np.float64)


def normal_equations(structure: Structure, views: Views) -> Normal:
    """The normal equations at a structure that is triangulated (see `triangulate`), with its robust weights."""
    V = len(views)
    ok = (structure.weight > 0) & np.isfinite(structure.miss_px) & (structure.depth > 0)
    used, graph, values = np.flatnonzero(ok.any(axis=-1)), gtsam.NonlinearFactorGraph(), gtsam.Values()
    precision = gtsam.noiseModel.Isotropic.Precision
    poses, lenses, points = ([name(index) for index in range(n)] for name, n in ((C, V), (K, V), (P, len(used))))
    for pose, lens, M, cTw in zip(poses, lenses, views.K, views.cTw, strict=True):
        R = cTw[:, :3]
        values.insert(pose, gtsam.Pose3(gtsam.Rot3(R.T), -R.T @ cTw[:, 3]))
        values.insert(lens, gtsam.Cal3_S2(M[0, 0], M[1, 1], M[0, 1], M[0, 2], M[1, 2]))
        # Next to no information: cameras without people stay in the equations.
        graph.add(gtsam.PriorFactorPose3(pose, values.atPose3(pose), precision(6, 1e-12)))
        graph.add(gtsam.PriorFactorCal3_S2(lens, values.atCal3_S2(lens), precision(5, 1e-12)))
    ok, weight = ok.reshape(-1, V)[used], structure.weight.reshape(-1, V)[used]
    slope = structure.slope.reshape(-1, V)[used]
    weak = _WEAK * np.where(ok, weight * slope, 0.0).sum(axis=-1)
    for point, xyz, least in zip(points, structure.points.reshape(-1, 3)[used], weak, strict=True):
        values.insert(point, xyz)
        graph.add(gtsam.PriorFactorPoint3(point, xyz, precision(3, least)))
    row, view = np.nonzero(ok)
    seen = zip(row.tolist(), view.tolist(), structure.xy.reshape(-1, V, 2)[used][ok], weight[ok], strict=True)
    for n, v, xy, each in seen:
        factor = gtsam.GeneralSFMFactor2Cal3_S2(xy, precision(2, each), poses[v], points[n], lenses[v])
        graph.add(factor)
    order, rest = gtsam.Ordering(), gtsam.Ordering()
    for key in points:
        order.push_back(key)
    for pose, lens in zip(poses, lenses, strict=True):
        rest.push_back(pose)
        rest.push_back(lens)
    _, cameras = graph.linearize(values).eliminatePartialMultifrontal(order)
    H, eta = cameras.hessian(rest)
    T, every = np.zeros((len(views.K), 11, len(views.K), Q)), np.arange(len(views.K))
    T[every, :, every] = [_tangent(K) for K in views.K]
    T = T.reshape(len(H), -1)
    return Normal(T.T @ H @ T, -T.T @ eta)


def _tangent(M: Array) -> Array:
    """(11, Q) GTSAM's tangents of a camera's pose (world from camera) and calibration by `PARAMETERS`."""
    tangent = np.zeros((11, Q))
    tangent[:6, POSE] = -np.eye(6)
    tangent[6:9, 8] = M[0, 0], M[1, 1], M[0, 1]
    tangent[9:, CENTRE] = np.eye(2)
    return tangent


@dataclass(frozen=True)
class SmallErrors:
    """The least changes that explain the residuals."""

    centre_px: Array
    """(V, 2) how much further right and down each principal point seems to be than the calibration says."""
    shift_deg: Array
    """(V,) the same as a turn of the camera."""
    roll_deg: Array
    """(V,) by how much each camera seems to be turned about its axis."""
    focal: Array
    """(V,) each focal length over that of the calibration."""
    views: Views
    """The cameras after the changes."""
    cost: float
    """What remains of the robust cost of all residuals, as a part of what it was."""


def followed(frame: Index, points: Array) -> Index:
    """(P,) who people (P, J, 3) at some frames are: each is the nearest of the frame before, if that is near."""
    middle = _middle(points)
    spread = _middle((points - middle[:, None]) ** 2).sum(axis=-1) ** 0.5
    reach = _REACH * float(np.median(spread)) if len(frame) > 0 else 0.0
    who, last, count = np.full(len(frame), -1, dtype=np.intp), np.zeros(0, dtype=np.intp), 0
    for now in np.unique(frame).tolist():
        here = np.flatnonzero(frame == now)
        away = np.linalg.norm(middle[here, None] - middle[last], axis=-1)
        before, after = least_cost_pairs(np.minimum(np.nan_to_num(away, nan=np.inf), reach).T)
        near = away[after, before] < reach
        who[here[after[near]]] = who[last[before[near]]]
        new, lost = here[who[here] < 0], last[~np.isin(who[last], who[here])]
        if len(new) == len(lost) == 1:  # the only one who can have come back, after a cut for example
            who[new], lost = who[lost], lost[:0]
        else:
            who[new] = count + np.arange(len(new))
            count += len(new)
        gone = lost[frame[lost] > now - _FORGOTTEN]
        last = np.concatenate([here, gone])
    return who


def _middle(points: Array) -> Array:
    """(N, n) mean of those `points` (N, J, n) that there are; 0 where there are none."""
    there = ~np.isnan(points[..., :1])
    return np.asarray(np.where(there, points, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


@dataclass(frozen=True)
class Bias:
    """One person whom one camera sees beside where the others do."""

    person: int
    view: int
    shift: Array
    """(2,) right and down, parts of the person's size in the picture."""


@dataclass(frozen=True)
class Problem:
    """The residuals of a recording, to be explained by changes of its V cameras, or by biases of single people."""

    seen: tuple[Array, Array, Array]
    """See `observed`."""
    views: Views
    """The cameras before."""
    structure: Structure
    """The people before."""
    parts: tuple[Normal, ...]
    """The normal equations there, of each person and frame: points of different ones share no factor."""
    members: Index
    """(N, V) the sightings of all people, -1 for none."""
    who: Index
    """(N,) who each is."""
    frame: Index
    """(N,) when."""
    step: int
    """Of these N every so many is in `structure`."""

    @classmethod
    def of(cls, look: Look) -> "Problem":
        """Of people spread over the frames."""
        (groups, all_people), views = look.structure(steps=2), look.views
        step = max(1, -(-len(groups) // _MOST_PEOPLE))
        seen = observed(Groups(groups.frame[::step], groups.member[::step]), look.sightings)
        structure = triangulate(*seen, views, 5)
        one = [Structure(*(each[n : n + 1] for each in astuple(structure))) for n in range(len(structure.points))]
        parts = tuple(normal_equations(each, views) for each in one)
        who = followed(groups.frame, all_people.points)
        return cls(seen, views, structure, parts, groups.member, who, groups.frame, step)

    @cached_property
    def normal(self) -> Normal:
        """The normal equations of all."""
        n = Q * len(self.views)
        H, g = (each.H for each in self.parts), (each.g for each in self.parts)
        return Normal(sum(H, np.zeros((n, n))), sum(g, np.zeros(n)))

    @cached_property
    def biases(self) -> list[tuple[float, Bias]]:
        """Each person's bias in each view, best first: as `singles`, with what such a bias costs."""
        if len(self.parts) == 0:
            return []
        H, g = np.stack([each.H for each in self.parts]), np.stack([each.g for each in self.parts])
        who, found = self.who[:: self.step], list[tuple[float, float, Bias]]()
        for person in np.flatnonzero(np.bincount(who) >= _LEAST_OF_ONE).tolist():
            for view in range(len(self.views)):
                columns, size = np.array(CENTRE) + Q * view, np.nan_to_num(self.structure.size_px[:, view])
                size = np.where(who == person, size, 0.0)
                matrix = np.einsum("n,nij->ij", size**2, H[:, columns[:, None], columns])
                slope = size @ g[:, columns]
                shift = -np.linalg.solve(matrix + np.eye(2) / (_PRIOR * _BIAS**2), slope)
                gain = -0.5 * _PRIOR * float(slope @ shift)
                price = 0.5 * float(np.linalg.slogdet(np.eye(2) + _PRIOR * _BIAS**2 * matrix)[1])
                found.append((gain - price, price, Bias(person, view, shift)))
        found = sorted(found, key=lambda each: -each[0])[:_MOST_BIASES]
        return sorted([(self._gain(self.views, self._beside(b)) - p, b) for _, p, b in found], key=lambda e: -e[0])

    def _beside(self, bias: Bias) -> Array:
        """The detections `seen` without a bias."""
        xy, mine = self.seen[0].copy(), self.who[:: self.step] == bias.person
        xy[mine, :, bias.view] -= bias.shift * self.structure.size_px[mine, bias.view, None, None]
        return xy

    @property
    def bias(self) -> Bias | None:
        """One person's bias, if it explains the residuals and no camera's mistake surely does so better."""
        if len(self.biases) == 0:
            return None
        gain, bias = self.biases[0]
        return bias if gain > max(_LIKELY_BIAS, self.singles[0][0] - np.log(SURE / (1 - SURE))) else None

    @property
    def biased(self) -> Finding:
        """The largest of the `biases`, and what its camera may have wrong instead."""
        gain, bias = self.biases[0]
        sure = 1 / (1 + float(np.exp(self.likely(bias.view) - gain)))
        finding = Finding(Kind.BIASED, (bias.view,), float(np.hypot(*bias.shift)), sure=sure)
        if sure >= SURE:
            return finding
        camera = one_of([each for each, _ in self.kinds(bias.view, 1 - sure)])
        return replace(finding, instead=(replace(camera, instead=()), *camera.instead))

    def unbiased(self, look: Look, bias: Bias) -> Look:
        """The recording as if the person had been seen where the others see that person."""
        mine = self.members[self.who == bias.person, bias.view]
        mine = look.sightings.only(mine[mine >= 0])
        order = np.argsort(mine.frame, kind="stable")
        way = [np.interp(look.shifted.frame, mine.frame[order], x[order]) for x in _middle(mine.xy).T]
        away = np.linalg.norm(_middle(look.shifted.xy).T - way, axis=0) / look.shifted.size_px
        away[look.shifted.view != bias.view] = np.inf
        key = look.shifted.frame - look.shifted.frame.min()
        his = least_of_each(key, away)
        his = his[away[his] < _BESIDE]
        xy, every = look.evidence.sightings.xy.copy(), look.evidence.sightings
        xy[his] -= (bias.shift * every.size_px[his, None])[:, None]
        return replace(look, evidence=replace(look.evidence, sightings=replace(every, xy=xy)))

    def small_errors(self, parts: Parts = ALL) -> SmallErrors:
        """What small errors of the cameras the residuals look like, with a sparse prior."""
        views, change, cost = self._solved(partial(_sparse_step, parts))
        cost /= max(_cost(self.structure), 1e-12)
        shift_deg = np.rad2deg(np.hypot(*change[:, CENTRE].T) / views.focal_px)
        return SmallErrors(
            change[:, CENTRE], shift_deg, np.rad2deg(change[:, 2]), np.exp(change[:, 8]), views, cost
        )

    def sigmas(self, views: Views) -> tuple[Array, Array, Array]:
        """(V,) how far shift and roll (degrees) and the focal length (its logarithm) are known, all being free."""
        V = len(views)
        columns = np.array([view * Q + c for view in range(V) for c in (*_ROLL, *CENTRE, *FOCAL)])
        prior = np.tile([np.deg2rad(1.0), 20.0, 20.0, 0.03], V) ** -2.0
        H = _PRIOR * self.normal.H[np.ix_(columns, columns)] + np.diag(prior)
        sigma = np.sqrt(np.diag(np.linalg.inv(H))).reshape(V, 4)
        shift_px = np.hypot(sigma[:, 1], sigma[:, 2])
        return np.rad2deg(shift_px / views.focal_px), np.rad2deg(sigma[:, 0]), sigma[:, 3]

    @cached_property
    def singles(self) -> "list[tuple[float, int, Kind]]":
        """Each change of one camera alone, best first: the likelihood's logarithm less its price; view; kind."""
        found = []
        for view in range(len(self.views)):
            for kind, parts in ONE.items():
                columns = np.array(parts) + Q * view
                change = np.zeros(Q * len(self.views))
                change[columns] = self.normal.solve(columns)
                gain = self._gain(changed(self.views, change.reshape(-1, Q)), self.seen[0])
                found.append((gain - self._price(columns), view, kind))
        found += [(gain, *each.cameras, each.kind) for gain, each in self.over_time]
        return sorted(found, key=lambda each: -each[0])

    def _gain(self, views: Views, xy: Array) -> float:
        """By how much the likelihood's logarithm is higher with other cameras, or other detections."""
        structure = triangulate(xy, *self.seen[1:], views, 4)
        return _PRIOR * (_cost(self.structure) - _cost(structure))

    @cached_property
    def over_time(self) -> list[tuple[float, Finding]]:
        """Each camera's turn in the frames before or after one, and its turn that grows or ends: as `singles`."""
        if len(self.parts) == 0:
            return []
        frame, found = self.frame[:: self.step], list[tuple[float, Finding]]()
        H, g = np.stack([each.H for each in self.parts]), np.stack([each.g for each in self.parts])
        steps, t = np.unique(frame), (frame - frame.min()) / max(np.ptp(frame), 1)
        steps = steps[1 + len(steps) // _LEAST_PART : len(steps) - len(steps) // _LEAST_PART]
        after = frame >= steps[:, None]
        ends = [(None, at) for at in steps.tolist()] + [(at, None) for at in steps.tolist()] + [(None, None)] * 2
        part = np.concatenate([~after, after, [1 - t, t]])
        for view in range(len(self.views)):
            columns = np.array(TURN) + Q * view
            matrix = np.einsum("wn,nij->wij", part**2, H[:, columns[:, None], columns])
            slope = part @ g[:, columns]
            turn = -np.linalg.solve(matrix + np.eye(3) / (_PRIOR * _TURN**2), slope[..., None])[..., 0]
            worth = -0.5 * _PRIOR * (slope * turn).sum(axis=1)
            price = 0.5 * np.linalg.slogdet(np.eye(3) + _PRIOR * _TURN**2 * matrix)[1]
            for kind, which in ((Kind.BUMPED, slice(0, -2)), (Kind.DRIFTING, slice(-2, None))):
                if len(worth[which]) == 0:
                    continue
                best = int(np.arange(len(worth))[which][np.argmax((worth - price)[which])])
                xy, camera = self.seen[0].copy(), Pinhole(self.views.K[view], self.views.cTw[view])
                xy[:, :, view] = unturned(xy[:, :, view], camera, part[best][:, None] * turn[best])
                gain = self._gain(self.views, xy) - price[best] - np.log(len(worth[which]))
                degrees = float(np.rad2deg(np.linalg.norm(turn[best])))
                found.append((float(gain), Finding(kind, (view,), degrees, frames=ends[best])))
        return found

    def likely(self, view: int) -> float:
        """How much likelier some mistake of one camera is than none: see `singles`."""
        return max(gain for gain, of, _ in self.singles if of == view)

    def _price(self, columns: Index) -> float:
        """What parameters of a camera cost: by how much (logarithm) the detections narrow down what is usual."""
        depth = float(np.nanmedian(self.structure.depth))
        usual = np.tile([_TURN, _TURN, _TURN, *[_MOVE * depth] * 3, 0.0, 0.0, _FOCAL], (len(self.views), 1))
        usual[:, CENTRE] = _TURN * self.views.focal_px[:, None]
        usual = usual.ravel()[columns]
        narrowed = np.eye(len(columns)) + _PRIOR * usual[:, None] * self.normal.H[np.ix_(columns, columns)] * usual
        return 0.5 * float(np.linalg.slogdet(narrowed)[1])

    @cached_property
    def guilt(self) -> dict[int, float]:
        """The probability of each camera to be the one with a mistake, likeliest first; the rest is of none."""
        gains = np.array([each[0] for each in self.singles])
        weights = np.exp(gains - max(gains.max(), 0.0))
        weights /= weights.sum() + np.exp(-max(gains.max(), 0.0))
        of = np.bincount([view for _, view, _ in self.singles], weights, len(self.views))
        return {view: float(of[view]) for view in np.argsort(-of, kind="stable").tolist()}

    def causes(self) -> list[tuple[Finding, Views]]:
        """What one camera may have wrong, likeliest first, as `kinds`, of all cameras that are not unlikely."""
        found = [each for view, sure in self.guilt.items() if sure > 1 - SURE for each in self.kinds(view, sure)]
        return sorted(found, key=lambda each: -each[0].sure)

    def kinds(self, view: int, sure: float) -> list[tuple[Finding, Views]]:
        """What one camera has wrong if it has something, which is so with probability `sure`: see `explained`."""
        gains = [(gain, kind) for gain, of, kind in self.singles if of == view]
        weight = np.exp([gain - gains[0][0] for gain, _ in gains])
        share = {kind: sure * each / weight.sum() for (_, kind), each in zip(gains, weight, strict=True)}
        told = self.explained(view, self.views, dict.fromkeys(ONE, self.views))
        lasting = sum(share[kind] for kind in ONE)
        found = [(replace(each, sure=float(lasting * each.sure)), views) for each, views in told]
        moving = [each for _, each in self.over_time if each.cameras == (view,)]
        found += [(replace(each, sure=float(share[each.kind])), self.views) for each in moving]
        return sorted(found, key=lambda each: -each[0].sure)

    def explained(self, view: int, given: Views, starts: Mapping[Kind, Views]) -> list[tuple[Finding, Views]]:
        """What one camera alone may have wrong, likeliest first, against the cameras as `given`.

        Each of the `starts` has the camera already as it is after that mistake, or nearly.
        """
        found = []
        for kind, start in starts.items():
            columns = np.array(ONE[kind]) + Q * view

            def step(normal: Normal, structure: Structure, total: Array, columns: Index = columns) -> Array:
                change = np.zeros_like(total)
                change[columns] = normal.solve(columns)
                return change

            views, _, cost = self._solved(step, start)
            found.append((-_PRIOR * cost - self._price(columns), named(kind, view, given, views), views))
        best = max((likely for likely, _, _ in found), default=0.0)
        total = sum(np.exp(likely - best) for likely, _, _ in found)
        told = [(replace(each, sure=float(np.exp(x - best) / total)), views) for x, each, views in found]
        return sorted(told, key=lambda each: -each[0].sure)

    def _solved(
        self, step: Callable[[Normal, Structure, Array], Array], start: Views | None = None
    ) -> tuple[Views, Array, float]:
        """Cameras after steps (V Q,), which are told their sum so far; the sum (V, Q); the cost that remains."""
        views, structure, normal, total = self.views, self.structure, None, np.zeros(len(self.views) * Q)
        if start is None:
            normal = self.normal
        else:
            views, structure = start, triangulate(*self.seen, start, 4)
        for _ in range(_ROUNDS):
            normal = normal_equations(structure, views) if normal is None else normal
            change = step(normal, structure, total)
            normal, total = None, total + change
            views = changed(views, change.reshape(-1, Q))
            structure = triangulate(*self.seen, views, 4)
        return views, total.reshape(-1, Q), _cost(structure)


def named(kind: Kind, view: int, given: Views, views: Views) -> Finding:
    """A change of one camera alone, in what the calibration has over what fits."""
    if kind == Kind.FOCAL:
        return Finding(kind, (view,), float(given.K[view, 0, 0] / views.K[view, 0, 0]))
    if kind == Kind.PRINCIPAL_POINT:
        x, y = (views.K - given.K)[view, :2, 2].tolist()
        degrees = float(np.rad2deg(np.hypot(x, y) / views.focal_px[view]))
        return Finding(kind, (view,), degrees, ((x, y),))
    turn, moved = difference(given.cTw[view], views.cTw[view])
    return Finding(Kind.TURNED if turn > _TURN_DEG else kind, (view,), turn, moved=moved)


def _sparse_step(parts: Parts, normal: Normal, structure: Structure, total: Array) -> Array:
    """The step (V Q,) of all cameras whose sum with `total` is small in most groups (iterated reweighting)."""
    V = structure.xy.shape[2]
    columns = np.array([view * Q + c for view in range(V) for names, _ in parts for c in names])
    H, g = normal.H[np.ix_(columns, columns)], normal.g[columns]
    unit = np.tile(np.concatenate([[size] * len(names) for names, size in parts]), V)
    group = np.concatenate([[i] * len(names) for i, (names, _) in enumerate(parts * V)])
    own, moved = np.diag(H), total[columns]
    size = np.ones(V * len(parts))
    step = np.zeros(len(columns))
    for _ in range(_SPARSE_STEPS):
        information = _PRIOR * own / (size[group] + 0.05) + 1e-6 * own + 1e-12
        step = np.linalg.solve(H + np.diag(information), -(g + information * moved))
        size = np.sqrt(np.bincount(group, ((moved + step) / unit) ** 2))
    seen = (structure.weight > 0).any(axis=(0, 1))
    full = np.zeros(V * Q)
    full[columns] = np.where(np.repeat(seen, len(columns) // V), step, 0.0)
    return full


def _cost(structure: Structure) -> float:
    """Sum of the residuals' robust costs (Cauchy), in parts of people's sizes."""
    scale = (KERNEL * np.where(np.isnan(structure.size_px), 1.0, structure.size_px)[:, None]) ** 2
    square = structure.miss_px**2 / scale
    seen = (structure.weight > 0) & np.isfinite(square)
    return float(np.log1p(square[seen]).sum())
