"""One person as a factor graph: built once, its gates and priors replaced as the alternation goes on.

Stage II of the paper, the X step: E(X) = w_2D E_2D(X) + w_shape E_shape(X, Theta) with Theta fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import (
    KernelName,
    body_prior_factors,
    joint_keys,
    make_camera,
    projection_factors,
    robust_kernel,
)
from shapepose_fg.camera import Rig


@dataclass(frozen=True)
class PersonGraphConfig:
    """What goes into a person's graph."""

    rho_3d: float = 0.25
    """rho_3D of Eq. 4: joints whose mean confidence over all views is lower are pulled by the body model. The
    paper's figure 5: below 0.25 the body knows better, above it the views do."""
    weight_2d: float = 1.0
    """w_2D of Eq. 5, multiplies the squared reprojection errors. With sigmas that are true, both weights are 1."""
    weight_shape: float = 1.0
    """w_shape of Eq. 5, multiplies the squared distances to the body model."""
    max_iterations: int = 20
    """Levenberg-Marquardt steps at the most."""
    tolerance: float = 1e-4
    """Relative change of the error at which Levenberg-Marquardt stops."""

    def __post_init__(self) -> None:
        for name in ("weight_2d", "weight_shape", "max_iterations", "tolerance"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.rho_3d <= 1:
            raise ValueError(f"rho_3d must be between 0 and 1, got {self.rho_3d}")


def make_cameras(rig: Rig) -> tuple[gtsam.PinholeCameraCal3_S2, ...]:
    """GTSAM's cameras of a rig, to be shared by all graphs."""
    return tuple(make_camera(camera.K, camera.wTc) for camera in rig.cameras)


class PersonGraph:
    """The graph of one person in one frame: a `Point3` for each joint, under the keys `keys`.

    Slots of the graph: a projection factor for each observation (empty where the gate discards it), then one
    for each joint's body prior (empty where there is none), then what `add` appended. Frames compose: the keys
    carry person, joint and frame, so `graph` can be added to another graph as it is.
    """

    def __init__(
        self,
        cameras: Sequence[gtsam.PinholeCameraCal3_S2],
        xy: NDArray[np.float64],
        sigmas_px: NDArray[np.float64],
        config: PersonGraphConfig,
        kernel: KernelName | None = "cauchy",
        *,
        person: int = 0,
        frame: int = 0,
    ) -> None:
        """Build the factors of all observations, none of them active yet.

        `xy` (J, V, 2) in undistorted pixels, `sigmas_px` (J, V), 0 where the view did not see the joint.
        """
        self.config = config
        self.keys = joint_keys(person, np.arange(len(xy)), frame)
        """(J,) key of each joint."""
        self.graph = gtsam.NonlinearFactorGraph()
        """The factors: slots as the class describes them."""
        self._joint, self._view = np.nonzero(sigmas_px > 0)
        self._projections = projection_factors(
            cameras,
            self._view,
            self.keys[self._joint],
            xy[self._joint, self._view],
            sigmas_px[self._joint, self._view] / np.sqrt(config.weight_2d),
            robust_kernel(kernel),
        )
        self.values = gtsam.Values()
        """The last solution, for `gtsam.Marginals` and for graphs that this one is added to."""
        self._active = np.ones(len(self._projections), dtype=bool)
        self._has_prior = np.zeros(len(xy), dtype=bool)
        self._added: list[tuple[gtsam.NonlinearFactor, NDArray[np.intp]]] = []
        for factor in self._projections:
            self.graph.push_back(factor)
        self.graph.resize(len(self._projections) + len(xy))

    def set_gates(self, inlier: NDArray[np.bool_]) -> None:
        """Keep the observations of `inlier` (J, V) and empty the slots of the others (delta_ij of Eq. 2)."""
        wanted = inlier[self._joint, self._view]
        for slot in np.flatnonzero(wanted != self._active).tolist():
            if wanted[slot]:
                self.graph.replace(slot, self._projections[slot])
            else:
                self.graph.remove(slot)
        self._active = wanted

    def set_priors(
        self, pulled: NDArray[np.bool_], mean: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> None:
        """Pull the joints of `pulled` (J,) to `mean` (J, 3) with `covariance` (J, 3, 3), and no others (Eq. 3)."""
        first = len(self._projections)
        joints = np.flatnonzero(pulled)
        new = body_prior_factors(self.keys[joints], mean[joints], covariance[joints] / self.config.weight_shape)
        for joint, factor in zip(joints.tolist(), new, strict=True):
            self.graph.replace(first + joint, factor)
        for joint in np.flatnonzero(self._has_prior & ~pulled).tolist():
            self.graph.remove(first + joint)
        self._has_prior = pulled.copy()

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Append a factor of your own on `keys`; it stays through all alternations.

        While one of its joints is not in the problem, because neither views nor body place it, it rests.
        ValueError if it is on anything but this person's joints.
        """
        joints = np.flatnonzero(np.isin(self.keys, factor.keys()))
        if len(joints) < len(set(factor.keys())):
            raise ValueError("a factor of your own must be on the graph's own keys (PersonGraph.keys) only")
        self._added.append((factor, joints))
        self.graph.push_back(factor)

    def solve(self, initial: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minimise over the joints, from `initial` (J, 3) metres; returns (J, 3).

        A joint with NaN in `initial` is not in the problem: it must have no factor, and stays NaN.
        """
        present = np.isfinite(initial.sum(axis=1))
        values = gtsam.Values()
        for key, point in zip(self.keys[present].tolist(), initial[present], strict=True):
            values.insert(key, point)
        if not present.any():
            self.values = values
            return initial.copy()
        self._rest(present)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph, values, self._parameters)
        self.values = optimizer.optimize()
        joints = np.full(initial.shape, np.nan)
        joints[present] = [self.values.atPoint3(key) for key in self.keys[present].tolist()]
        return joints

    def _rest(self, present: NDArray[np.bool_]) -> None:
        """Take out those added factors of which a joint is not `present` (J,), and put back the others."""
        first = len(self._projections) + len(self.keys)
        for slot, (factor, joints) in enumerate(self._added, start=first):
            if present[joints].all():
                self.graph.replace(slot, factor)
            else:
                self.graph.remove(slot)

    def covariance(self) -> NDArray[np.float64]:
        """Marginal covariance (J, 3, 3) in m² of each joint at the last solution; NaN where it was not solved."""
        result = np.full((len(self.keys), 3, 3), np.nan)
        if self.values.empty():
            return result
        marginals = gtsam.Marginals(self.graph, self.values)
        for joint, key in enumerate(self.keys.tolist()):
            if self.values.exists(key):
                result[joint] = marginals.marginalCovariance(key)
        return result

    @cached_property
    def _parameters(self) -> gtsam.LevenbergMarquardtParams:
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self.config.max_iterations)
        parameters.setRelativeErrorTol(self.config.tolerance)
        return parameters
