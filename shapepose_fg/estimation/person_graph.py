"""The GTSAM graph of a solved `BodyWindow`: native projections on joints, which hang on bodies."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from factors import (
    DEFAULT_WIDTH_SIGMA,
    body_keys,
    linear_factor,
    projection_factors,
    robust_kernel,
    shape_factors,
    shape_key,
    state_keys,
)
from factors.body_shape import pose_factors
from factors.keys import MAX_FRAME
from shapepose_fg.body.model.rotation import exp_so3, log_so3, right_jacobian_inverse
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.decompositions import symmetric_root
from shapepose_fg.estimation.body_window import BodyState, BodyWindow, Marginals
from shapepose_fg.estimation.condensed_graph import frame_systems
from shapepose_fg.estimation.frame_graph import gtsam_cameras
from shapepose_fg.estimation.in_time import moments
from shapepose_fg.estimation.user_factors import PersonWindow

_DEFINED_M_S = 1e-3
"""Standard deviation with which a velocity is that of its joint's positions, m/s: it is a
definition, but GTSAM's solver wants a finite one."""


class BodyGraph(PersonWindow):
    """A person's window as a GTSAM graph around a solution; built on first use.

    Variables are the joints (`keys`), the body of each frame (`body_keys`): a vector of the root's
    turn since the first solution (axis times angle, rad, axes of the world), the visible angles,
    rad, and the place, metres in the world; and the body's shape (`shape_key`): the 10 betas.
    Velocities (`velocity_keys`) are variables where a factor is on them.
    """

    def __init__(
        self,
        window: BodyWindow,
        state: BodyState,
        widen: float = 1.0,
        rows: Index | None = None,
    ) -> None:
        """Take a person's solved window, the `rows` (T,) of the problem; all covariances of the
        graph are `widen` times those of the model: neither solution nor kernels change.
        """
        joints = np.arange(window.sigmas_px.shape[1])
        person = int(window.observations.track[0])
        frames = window.observations.frame.astype(np.int64)
        keys = state_keys(person, joints, frames[:, None], 2)
        super().__init__(person, frames, window.times_s, keys, rows, window.joints(state))
        self.body_keys, self.shape_key = body_keys(person, frames), shape_key(person)
        self.window, self.state, self.widen = window, state, widen
        self._upright = state.root

    @property
    def seen(self) -> Mask:
        """(T, J, V) whether there is a detection of the joint."""
        return self.window.observations.seen

    def build(self) -> "BodyGraph":
        """Make all factors of the person, linear ones around the state, and the values.

        With active user factors, the graph is that of all people whom they couple. User factors are
        left out if the solution with them failed.
        """
        coupled = len(self.ties.active) > 0 and not self.failure
        everyone = [each for each in self.ties.people if isinstance(each, BodyGraph)]
        everyone = everyone if coupled else [self]
        for each in everyone:
            each.part(np.ones(len(each.touched), dtype=bool))
        if coupled:
            graph, values = self.ties.joined()
            for each in everyone:
                each.set_graph(graph, values)
        return self

    def part(self, joints: Mask) -> None:
        """Make the graph of this person only, with some `joints` (J,) as variables. The others are
        eliminated: in each frame, their information about body and shape is one factor.
        """
        window, state = self.window, self.state
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.set_graph(graph, values)
        scale, chosen = np.sqrt(self.widen), np.flatnonzero(joints)
        (T, J), turns = self.keys[:, chosen].shape, self.turns()
        slopes, betas = Marginals(window, state, *(np.empty(0),) * 4).slopes, state.betas.ravel()
        slopes[..., 10:13] = slopes[..., 10:13] @ turns[:, None]
        slopes = slopes[:, chosen]
        bodies, X = self._bodies(), window.joints(state)[:, chosen]
        for key, x in zip(self.keys[:, chosen].ravel().tolist(), X.reshape(-1, 3), strict=True):
            values.insert(key, x)
        for key, body in zip(self.body_keys.tolist(), bodies, strict=True):
            values.insert(key, body)
        values.insert(self.shape_key, betas)
        factors: list[gtsam.NonlinearFactor] = [*self._seen(scale, joints)]
        at_zero = X - state.deviation[:, chosen] - slopes[..., :10] @ betas
        at_zero -= (slopes[..., 10:] @ bodies[:, None, :, None])[..., 0]
        flat = slopes.reshape(T * J, 3, slopes.shape[-1])
        sigma = scale * np.sqrt(window.variance[:, chosen])
        factors += shape_factors(
            self.keys[:, chosen].ravel(), self.body_keys.repeat(J), self.shape_key,
            at_zero.reshape(-1, 3), flat[..., 10:], flat[..., :10], sigma.ravel(),
        )  # fmt: skip
        factors += pose_factors([self.shape_key], [np.eye(10)[None] / scale], np.zeros((1, 10)), 10)
        factors += self._poses(scale, bodies, turns)
        factors += [*self._velocities(), *self._standing(scale, joints)]
        if not joints.all():
            factors += self._others(joints, turns)
        deque(map(graph.push_back, factors), maxlen=0)

    def _others(self, joints: Mask, turns: Array) -> list[gtsam.NonlinearFactor]:
        """Factors with the information of all joints but `joints` about each body and the shape."""
        H, pull = frame_systems(self.window, self.state, ~joints)
        H[:, 10:13] = turns.mT @ H[:, 10:13]
        H[..., 10:13] = H[..., 10:13] @ turns
        pull[:, 10:13] = (turns.mT @ pull[:, 10:13, None])[..., 0]
        H, pull = H / self.widen, pull / self.widen
        keys, found = self.body_keys.tolist(), list[gtsam.NonlinearFactor]()
        for t, key in enumerate(keys):
            factor = gtsam.HessianFactor(
                key, self.shape_key, H[t, 10:, 10:], H[t, 10:, :10], pull[t, 10:],
                H[t, :10, :10], pull[t, :10], 0.0,
            )  # fmt: skip
            around = gtsam.Values()
            around.insert(key, self._values.atVector(key))
            around.insert(self.shape_key, self._values.atVector(self.shape_key))
            found.append(gtsam.LinearContainerFactor(factor, around))
        return found

    def of_body(self, t: int, joint: int) -> Array:
        """(3, 3) information on a joint in row `t` from its body in the same frame: from the other
        joints' views and the priors of pose and shape, without user factors, 1/m².
        """
        key, graph, part = int(self.keys[t, joint]), self.graph, gtsam.NonlinearFactorGraph()
        order = [*self.keys[t].tolist(), int(self.body_keys[t]), self.shape_key]
        users = 0 if self.failure else len(self.ties.active)
        for n in range(graph.size() - users):
            keys = graph.at(n).keys()
            if keys != [key] and all(each in order for each in keys):
                part.push_back(graph.at(n))
        found = graph_covariances(part, self.values, gtsam.Ordering(order))[key, key]
        return np.asarray(np.linalg.inv(found), dtype=np.float64)

    def refresh(self) -> None:
        """Gate the detections and linearise again around the current state, after the variances of
        the joints' deviations from the body have changed.
        """
        of_body = self.window.joints(self.state) - self.state.deviation - self.window.origin
        self.window.last = self.window.around(self.state, of_body)

    def take(self, values: gtsam.Values) -> float:
        """Take the person's variables from a solution of a graph around the state before, and gate
        the detections there. Returns the mean motion of the joints, metres.
        """
        bodies = np.array([values.atVector(key) for key in self.body_keys.tolist()])
        others = bodies[:, 3:].copy()
        others[:, -3:] -= self.window.origin.reshape(-1, 3)
        zero = np.zeros((*self.keys.shape, 3))
        root = exp_so3(bodies[:, :3]) @ self._upright
        betas = values.atVector(self.shape_key).reshape(self.state.betas.shape)
        state, before = BodyState(betas, root, others, zero), self.window.joints(self.state)
        of_body = self.window.joints(state) - self.window.origin
        joints = of_body + self.window.deviation(of_body) + self.window.origin
        for joint, keys in enumerate(self.keys.T.tolist()):
            if values.exists(keys[0]):
                joints[:, joint] = [values.atPoint3(key) for key in keys]
        self.state = replace(state, deviation=joints - of_body - self.window.origin)
        self.window.last = self.window.around(self.state, of_body)
        return float(np.linalg.norm(joints - before, axis=-1).mean())

    def marginals(self, every: dict[tuple[int, int], Array]) -> Marginals:
        """Marginals of the model from the covariances of every variable (`graph_covariances`) of a
        graph around the state, such as one with user factors.
        """
        keys, turns = self.body_keys.tolist(), self.turns()
        poses = np.array([every[key, key] for key in keys]) / self.widen
        across = np.array([every[key, self.shape_key] for key in keys]) / self.widen
        steps = np.zeros_like(poses)
        for t, (key, after) in enumerate(pairwise(keys)):
            steps[t] = every[after, key] / self.widen
        for part, rows in ((poses, turns), (across, turns), (steps[:-1], turns[1:])):
            part[:, :3] = rows @ part[:, :3]
        for part in (poses, steps):
            part[..., :3] = part[..., :3] @ turns.mT
        shape = every[self.shape_key, self.shape_key] / self.widen
        return Marginals(self.window, self.state, poses, steps, shape, across)

    def _bodies(self) -> Array:
        """(T, N) values of the bodies."""
        turn, others = log_so3(self.state.root @ self._upright.mT), self.state.others.copy()
        others[:, -3:] += self.window.origin.reshape(-1, 3)
        return np.concatenate([turn, others], axis=1)

    def turns(self) -> Array:
        """(T, 3, 3) derivative of the root's rotation, as a tangent vector in world axes, by the
        first three numbers of each body.
        """
        found = np.linalg.inv(right_jacobian_inverse(-self._bodies()[:, :3]))
        return np.asarray(found, dtype=np.float64)

    def order(self) -> Iterator[tuple[int, int, int]]:
        """Frame, rank within the frame, and key of each variable, for elimination with little
        fill-in.
        """
        for kind, keys in enumerate((self.velocity_keys, self.keys, self.body_keys[:, None])):
            for frame, row in zip(self.frames.tolist(), keys.tolist(), strict=True):
                yield from ((frame, kind, key) for key in row if self.values.exists(key))

    def _velocities(self) -> list[gtsam.NonlinearFactor]:
        """Factors that define the velocities on which user factors are: v = (x' - x) / dt, with x
        as in `in_time.velocities`.
        """
        if not self.temporal or len(self.ties.factors) == 0:
            return []
        tied = {key for each in self.ties.factors for key in each.keys}
        found, x = list[gtsam.NonlinearFactor](), self.keys
        for t, (first, last, lasts) in enumerate(zip(*moments(self.times_s), strict=True)):
            for joint, key in enumerate(self.velocity_keys[t].tolist()):
                if key in tied:
                    ends = (
                        self.values.atPoint3(x[last, joint]),
                        self.values.atPoint3(x[first, joint]),
                    )
                    self.values.insert(key, (ends[0] - ends[1]) / lasts)
                    names = [key, x[last, joint], x[first, joint]]
                    parts = [1.0, -1.0 / lasts, 1.0 / lasts]
                    found.append(linear_factor(names, parts, sigma=_DEFINED_M_S))
        return found

    def _standing(self, scale: float, joints: Mask) -> list[gtsam.NonlinearFactor]:
        """Factors on the joints of standing feet among `joints` (J,), from the other frames of a
        stance.
        """
        held = self.window.standing
        frame, joint = np.nonzero(held.information.any(axis=(-1, -2)) & joints)
        roots = symmetric_root(held.information[frame, joint]) / scale
        right = (roots @ held.xyz[frame, joint][..., None])[..., 0]
        names = self.keys[frame, joint].tolist()
        return [linear_factor([key], [A], b) for key, A, b in zip(names, roots, right, strict=True)]

    def _seen(self, scale: float, joints: Mask) -> list[gtsam.NoiseModelFactor]:
        """The projections of `joints` (J,)."""
        window, evidence = self.window, self.window.last.evidence
        xy = window.carried(window.joints(self.state)).xy
        used = evidence.inlier & (window.sigmas_px > 0) & joints[:, None]
        frame, joint, view = chosen = np.nonzero(used)
        kernel, views = window.config.robust_kernel, window.views
        width = None if kernel is None else DEFAULT_WIDTH_SIGMA[kernel] / scale
        return projection_factors(
            gtsam_cameras(views), view if views.rows_known is None else frame * len(views) + view,
            self.keys[frame, joint], xy[chosen], scale * window.sigmas_px[chosen],
            robust_kernel(kernel, width),
        )  # fmt: skip

    def _poses(self, scale: float, bodies: Array, turns: Array) -> list[gtsam.NonlinearFactor]:
        """The pose prior, and motion."""
        window, state, priors = self.window, self.state, self.window.energy.priors
        T, N = bodies.shape
        root = np.linalg.cholesky(priors.precision).T
        A = np.zeros((N, N))
        A[3:-3, 3:-3] = root
        free = [0, 1, 2, -3, -2, -1]
        A[free, free] = 1e-3
        right = bodies @ A.T
        right[:, 3:-3] = priors.mean @ root.T
        found = pose_factors(
            self.body_keys, [np.broadcast_to(A / scale, (T, N, N))], right / scale, N
        )
        if window.links is None:
            return found
        for matrices, residual in window.links.linear(state.root, state.others):
            count, right = len(residual), -residual
            for k, each in enumerate(matrices):
                each[..., :3] = each[..., :3] @ turns[k : k + count]
                right += (each @ bodies[k : k + count, :, None])[..., 0]
            found += pose_factors(self.body_keys, [A / scale for A in matrices], right / scale, N)
        return found


def ordering(people: Sequence[BodyGraph], values: gtsam.Values) -> gtsam.Ordering:
    """Order in which the variables of coupled people are eliminated: frame by frame, joints before
    bodies, shapes last. User variables come after the last frame of their factors.
    """
    ranks = [rank for person in people for rank in person.order()]
    frame_of = {key: frame for frame, _, key in ranks}
    shapes = {person.shape_key for person in people}
    own = [key for key in values.keys() if key not in frame_of and key not in shapes]  # noqa: SIM118
    for key in own:
        factors = (each.keys for each in people[0].ties.active if key in each.keys)
        last = max((frame_of.get(other, -1) for keys in factors for other in keys), default=-1)
        ranks.append((last if last >= 0 else MAX_FRAME, 3, key))
    return gtsam.Ordering([*(key for _, _, key in sorted(ranks)), *shapes])


def graph_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> dict[tuple[int, int], Array]:
    """Covariance of each variable, (key, key), and of each pair that elimination in this order
    connects, such as a body with the joints of its frame and with the next body.

    `gtsam.Marginals` computes one per call. They are those of the linearised graph, computed
    backwards over its Bayes net. Raises RuntimeError if the system is singular.
    """
    net = graph.linearize(values).eliminateSequential(ordering)
    found, last, after = dict[tuple[int, int], Array](), list[int](), np.empty((0, 0))
    for n in range(net.size() - 1, -1, -1):
        conditional = net.at(n)
        key, *others = conditional.keys()
        R = np.asarray(conditional.R())
        inverse = np.linalg.inv(R)
        own = inverse @ inverse.T
        if others:
            if others != last:
                after = np.block([[found[a, b] for b in others] for a in others])
                last = others
            gain = inverse @ conditional.S()
            across = -gain @ after
            own -= across @ gain.T
            ends = np.cumsum([len(found[each, each]) for each in others])[:-1]
            for other, part in zip(others, np.split(across, ends, axis=1), strict=True):
                found[key, other], found[other, key] = part, part.T
        found[key, key] = (own + own.T) / 2
    return found
