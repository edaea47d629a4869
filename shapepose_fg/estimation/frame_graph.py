"""Factor graph of a person in a frame: a position of every joint.

The X step of the paper, in single frames: E(X) = w_2D E_2D(X) + w_shape E_shape(X, Theta) with
fixed Theta.
"""

from collections import deque
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from factors import (
    DEFAULT_WIDTH_SIGMA,
    KernelName,
    body_prior_factors,
    make_camera,
    projection_factors,
    robust_kernel,
    split_key,
    state_keys,
)
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.minimise import NotFinite, descend, undetermined_key
from shapepose_fg.estimation.user_factors import PersonWindow

UNDETERMINED_M = 10.0
"""Standard deviation, metres, above which a joint is undetermined, in its worst direction; also
that of weak priors on joints, since one behind its cameras would make a system singular."""


class FrameGraph(PersonWindow):
    """Graph of one person in one frame, T = 1.

    Joints, and people, are coupled only by user factors, so that marginal covariances are cheap.
    Coupled people (`ties`) are one graph; `graph` and `values` are then of all of them.
    """

    def __init__(
        self,
        observations: Observations,
        sigmas_px: Array,
        views: Views,
        config: EstimatorConfig,
        rows: Index | None = None,
        first: Array | None = None,
    ) -> None:
        """Build the factors of all observations: one row.

        `sigmas_px` (1, J, V), 0 if the view has no detection of the joint; `views` are their
        cameras; `rows` (1,) is the index in a larger problem, `first` (1, J, 3) the initial joints.
        """
        T, J, _ = sigmas_px.shape
        frames, track = observations.frame, int(observations.track[0])
        if T != 1:
            raise ValueError(f"a graph is of one frame, got {T}")
        keys = state_keys(track, np.arange(J), frames[:, None], 2)
        super().__init__(track, frames, observations.time_s.mean(axis=1), keys, rows, first)
        self.config = config.graph
        self._observations, self._sigmas_px, self._views = observations, sigmas_px, views
        self._names = config.joints
        self._kernel: KernelName | None = config.observations.robust_kernel
        self.present: Mask = np.zeros((T, J), dtype=bool)
        """(1, J) joints in the last problem."""
        self.positions = np.full((T, J, 3), np.nan)
        """(1, J, 3) positions of the last solution, metres; NaN if not in it."""

    @property
    def seen(self) -> Mask:
        """(1, J, V) whether there is a detection of the joint."""
        return self._observations.seen

    def solve(self, inlier: Mask, body: JointTargets, initial: Array) -> Array:
        """`prepare` and `optimise` for a person without coupling; returns joints (1, J, 3),
        metres.
        """
        self.prepare(inlier, body, initial)
        self.optimise()
        return self.positions

    def prepare(self, inlier: Mask, body: JointTargets, initial: Array) -> None:
        """Build the problem of this person's joints, starting at `initial` (1, J, 3) metres.

        `inlier` (1, J, V) are the used observations (delta_ij of Eq. 2), `body` the priors (Eq. 3).
        A joint with NaN in `initial` is not in the problem and stays NaN.
        """
        self.failure, self.present = "", np.asarray(np.isfinite(initial).all(axis=2))
        self.build()
        deque(map(self.values.insert, self._present_keys(), initial[self.present]), maxlen=0)
        self._add(self._seen(inlier & (self._sigmas_px > 0) & self.present[..., None]))
        self.body = body.where(self.present, self.config.weight_shape)
        self._add(self._pulled(self.body))

    def of_body(self, t: int, joint: int) -> Array:
        """(3, 3) information on a joint from its body, 1/m²."""
        return self.body.information[t, joint]

    def optimise(self) -> None:
        """Minimise over the joints of this person and all coupled people, who must be prepared,
        too.

        `graph` and `values` of all of them are then those of the whole problem.
        """
        people = self.ties.people
        graph, values = self.ties.joined()
        failure = ""
        if not values.empty():
            try:
                values = self._minimum(graph, values)
            except NotFinite as error:
                failure = self.ties.problem or str(error)
            except RuntimeError as error:
                where = _where(error, people, self._names)
                failure = f"the solver failed: its system is singular{where}"
        for person in people:
            assert isinstance(person, FrameGraph)
            person.set_graph(graph, values)
            person.failure = failure
            person.positions = np.full((*person.present.shape, 3), np.nan)
            if person.present.any():
                person.positions[person.present] = list(
                    map(values.atPoint3, person._present_keys())
                )

    def _minimum(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The solution, starting at `values`; raises RuntimeError if there is none."""
        if len(self.ties.factors) > 0:
            return descend(graph, values, None, self.config, over_time=False)
        ordering = gtsam.Ordering(self._present_keys())
        return descend(graph, values, ordering, self.config, over_time=False)

    def _present_keys(self) -> list[int]:
        return self.keys[self.present].tolist()

    def _add(self, factors: Iterable[gtsam.NonlinearFactor]) -> None:
        deque(map(self.graph.add, factors), maxlen=0)

    def _seen(self, used: Mask) -> Sequence[gtsam.NonlinearFactor]:
        """Projection factors of used observations."""
        _, joint, view = chosen = np.nonzero(used)
        # In pixels the kernel's width is as before the weight scaled the sigma.
        scale, kernel = 1.0 / np.sqrt(self.config.weight_2d), self._kernel
        width = None if kernel is None else DEFAULT_WIDTH_SIGMA[kernel] / scale
        return projection_factors(
            gtsam_cameras(self._views), view, self.keys[0, joint], self._observations.xy[chosen],
            scale * self._sigmas_px[chosen], robust_kernel(kernel, width),
        )  # fmt: skip

    def _pulled(self, pulls: JointTargets) -> list[gtsam.NonlinearFactor]:
        """Body prior factors on joints."""
        known = pulls.known
        covariances = np.linalg.inv(pulls.information[known])
        symmetric = (covariances + covariances.swapaxes(1, 2)) / 2
        return list(body_prior_factors(self.keys[known], pulls.xyz[known], symmetric))


def _where(error: RuntimeError, people: Sequence[PersonWindow], names: Sequence[str]) -> str:
    """Description of the joint that a singular system leaves undetermined."""
    key = undetermined_key(error)
    if key is None or all(key not in set(person.state_keys.ravel().tolist()) for person in people):
        return ""
    joint = split_key(key)
    of_person = f" of person {joint.person}" if len(people) > 1 else ""
    place = f"{names[joint.joint]}{of_person} in frame {joint.frame}"
    return f" near {place}: no factor determines it there"


def gtsam_cameras(views: Views) -> list[gtsam.PinholeCameraCal3_S2]:
    """GTSAM cameras: V of them, or T V by row if they move."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*views.cTw.shape[:-2], 1, 4))
    wTc = np.linalg.inv(np.concatenate([views.cTw, last], axis=-2))
    shape = np.broadcast_shapes(views.K.shape[:-2], wTc.shape[:-2])
    K, wTc = np.broadcast_to(views.K, (*shape, 3, 3)), np.broadcast_to(wTc, (*shape, 4, 4))
    return list(map(make_camera, K.reshape(-1, 3, 3), wTc.reshape(-1, 4, 4)))


def state_covariances(graphs: Sequence[FrameGraph]) -> list[Array]:
    """For each solved graph, covariances (1, J, 3, 3) of positions, m².

    NaN for joints not in the problem, and for undetermined ones (`UNDETERMINED_M`): singular
    systems raise no error.
    """
    known = dict[int, gtsam.Marginals]()
    return [_of_graph(graph, known) for graph in graphs]


def _of_graph(graph: FrameGraph, known: dict[int, gtsam.Marginals]) -> Array:
    """Marginals of one person; coupled people share one graph, which is factorised once: `known` is
    the cache.
    """
    found = np.full((*graph.keys.shape, 3, 3), np.nan)
    keys = graph.keys[graph.present].tolist()
    if graph.failure or len(keys) == 0:
        return found
    for make in (lambda: graph.graph, lambda: _damped(graph)):
        try:
            marginals = known.get(id(graph.ties)) or gtsam.Marginals(make(), graph.values)
            of_keys = [marginals.marginalCovariance(key) for key in keys]
        except RuntimeError:
            known.pop(id(graph.ties), None)
            continue
        known[id(graph.ties)] = marginals
        found[graph.present] = of_keys
        return determined_only(found)
    return found


def _damped(graph: FrameGraph) -> gtsam.NonlinearFactorGraph:
    """The problem with a prior of 100 m on all variables; results wider than 10 m are then
    undetermined.
    """
    damped = gtsam.NonlinearFactorGraph(graph.graph)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 100.0)
    for key in (key for person in graph.ties.people for key in person.keys.ravel().tolist()):
        if graph.values.exists(key):
            damped.push_back(gtsam.PriorFactorPoint3(key, graph.values.atPoint3(key), wide))
    return damped


def determined_only(covariance: Array) -> Array:
    """Return covariances (..., 3, 3), with NaN for those above `UNDETERMINED_M` in some
    direction.
    """
    largest = np.trace(covariance, axis1=-2, axis2=-1)  # upper bound
    doubtful = np.isfinite(largest) & (largest >= UNDETERMINED_M**2)
    largest[doubtful] = np.linalg.eigvalsh(covariance[doubtful])[..., -1]
    return np.where((largest < UNDETERMINED_M**2)[..., None, None], covariance, np.nan)
