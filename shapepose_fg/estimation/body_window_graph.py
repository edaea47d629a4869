"""The GTSAM graph of a solved `BodyWindow`: native projections on joints, which hang on bodies."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import (
    DEFAULT_WIDTH_SIGMA,
    body_keys,
    joint_keys,
    make_camera,
    projection_factors,
    robust_kernel,
    shape_factors,
    shape_key,
)
from factors.body_shape import pose_factors
from shapepose_fg.core.camera import Views
from shapepose_fg.estimation.body_window import BodyState, BodyWindow, Marginals


@dataclass
class BodyGraph:
    """A person's window as a GTSAM graph around a solution; variables of `widen` times the
    variance.
    """

    window: BodyWindow
    state: BodyState
    person: int
    frames: NDArray[np.int64]
    """(T,) frame of each row."""
    widen: float = 1.0
    """All covariances of the graph are this many times those of the model: neither solution nor
    kernels change."""
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)

    def __post_init__(self) -> None:
        _T, J = self.window.sigmas_px.shape[:2]
        self.keys = joint_keys(self.person, np.arange(J), self.frames[:, None])
        self.body_keys, self.shape_key = body_keys(self.person, self.frames), shape_key(self.person)

    def build(self) -> "BodyGraph":
        """Make the factors and the values."""
        window, state, add = self.window, self.state, self.graph.push_back
        scale, J = np.sqrt(self.widen), self.keys.shape[1]
        slopes = Marginals(window, state, *(np.empty(0),) * 4).slopes
        T, N = len(window), slopes.shape[-1] - 10
        joints = window.joints(state)
        for key, x in zip(self.keys.ravel().tolist(), joints.reshape(-1, 3), strict=True):
            self.values.insert(key, x)
        for key in self.body_keys.tolist():
            self.values.insert(key, np.zeros(N))
        self.values.insert(self.shape_key, np.zeros(10))
        for each in self._seen(scale):
            add(each)
        flat = slopes.reshape(T * J, 3, -1)
        of_body = (joints - state.deviation).reshape(-1, 3)
        for each in shape_factors(
            self.keys.ravel(), self.body_keys.repeat(J), self.shape_key, of_body, flat[..., 10:], flat[..., :10],
            scale * np.sqrt(window.variance).ravel(),
        ):  # fmt: skip
            add(each)
        eye = np.eye(10) / scale
        zero = gtsam.Values()
        zero.insert(self.shape_key, np.zeros(10))
        linear = gtsam.JacobianFactor(
            self.shape_key, eye, -state.betas / scale, gtsam.noiseModel.Unit.Create(10)
        )
        add(gtsam.LinearContainerFactor(linear, zero))
        for each in self._poses(scale, N):
            add(each)
        return self

    def ordering(self) -> gtsam.Ordering:
        """Joints of a frame before its body, frame by frame, the shape last."""
        keys = np.concatenate([self.keys, self.body_keys[:, None]], axis=1)
        return gtsam.Ordering([*keys.ravel().tolist(), self.shape_key])

    def _seen(self, scale: float) -> list[gtsam.NoiseModelFactor]:
        window, evidence = self.window, self.window.last.evidence
        frame, joint, view = chosen = np.nonzero(evidence.inlier & (window.sigmas_px > 0))
        kernel, views = window.config.robust_kernel, window.views
        width = None if kernel is None else DEFAULT_WIDTH_SIGMA[kernel] / scale
        return projection_factors(
            _cameras(views), view if views.rows_known is None else frame * len(views) + view,
            self.keys[frame, joint], window.observations.xy[chosen], scale * window.sigmas_px[chosen],
            robust_kernel(kernel, width),
        )  # fmt: skip

    def _poses(self, scale: float, N: int) -> list[gtsam.NonlinearFactor]:
        """The pose prior, and motion."""
        window, state = self.window, self.state
        T, priors = len(window), window.energy.priors
        root = np.linalg.cholesky(priors.precision).T
        A = np.zeros((N, N))
        A[3:-3, 3:-3] = root
        A[[0, 1, 2, -3, -2, -1], [0, 1, 2, -3, -2, -1]] = 1e-3
        right = np.zeros((T, N))
        right[:, 3:-3] = (priors.mean - state.others[:, :-3]) @ root.T
        found = pose_factors(
            self.body_keys, [np.broadcast_to(A / scale, (T, N, N))], right / scale, N
        )
        if window.links is None:
            return found
        for matrices, residual in window.links.linear(state.root, state.others):
            found += pose_factors(
                self.body_keys, [each / scale for each in matrices], -residual / scale, N
            )
        return found


def _cameras(views: Views) -> list[gtsam.PinholeCameraCal3_S2]:
    """GTSAM's cameras: V of them, or T V where they move, row by row."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*views.cTw.shape[:-2], 1, 4))
    wTc = np.linalg.inv(np.concatenate([views.cTw, last], axis=-2))
    shape = np.broadcast_shapes(views.K.shape[:-2], wTc.shape[:-2])
    K, wTc = np.broadcast_to(views.K, (*shape, 3, 3)), np.broadcast_to(wTc, (*shape, 4, 4))
    return list(map(make_camera, K.reshape(-1, 3, 3), wTc.reshape(-1, 4, 4)))
