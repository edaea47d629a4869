"""SMPL-only: bodies fitted to all views' 2D detections directly, without 3D joints or a graph in between.

Multi-view SMPLify (Bogo et al., ECCV 2016), the paper's "SMPL-only": robust reprojection error weighted by
confidence, pose prior, shape prior; the root first, then everything, with priors that loosen and a kernel that
narrows.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.energy import BodyEnergy, EnergyTargets, robust_weight
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.rotation import log_so3
from shapepose_fg.body.model.target_skeletons import slots
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.linearisation import ObservationConfig, triangulate
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.evaluation.tracking import detector_s_body

TORSO = ("Neck", "RShoulder", "LShoulder", "MidHip", "RHip", "LHip")
"""What the root is found by."""
_MOMENTUM, _MEMORY, _TINY = 0.8, 0.95, 1e-8
"""Adam's averages."""
_STEP_BETA, _STEP_RAD, _STEP_M = 0.5, 0.2, 0.03
"""Lengths of the first steps along betas, angles and translation; they fall to zero as half a cosine."""
_MIN_DEPTH_M, _START_SIGMA_M, _MIN_START_JOINTS = 0.2, 0.05, 3
_ROOT_STEPS, _STEPS = 15, 85
"""Steps of Adam: of the root only, by the torso's joints, and of everything. These and the next were chosen on
the split `tune` (docs/evaluation.md)."""
_NO_KERNEL = 1e9
_SIGMA_M, _STIFF = 0.02, 10.0
"""One sigma of a detection of confidence 1, as a length at the person's depth; how many times as stiff the priors
begin: they loosen to 1 by the middle of the steps."""


@dataclass(frozen=True)
class SmplOnly:
    """SMPL-only beside a result without time, row by row, from the same detections."""

    people: PlainPeople
    """Bodies fitted to the detections directly."""
    triangulated: Array
    """(N, J, 3) X_0: robust triangulation of the views alone, metres; NaN where no two views agree."""
    cpu_s: float
    """Processor time of the fit of all rows, seconds."""


def smpl_only(people: Reconstruction, rig: Rig, config: ObservationConfig) -> SmplOnly:
    """SMPL-only on the people and detections of a result without time.

    `config` is how that triangulated. ValueError where the result does not say what it was solved from.
    """
    if people.observations is None:
        raise ValueError("people without observations: reconstruct them again")
    observations = people.observations.observations(np.full_like(people.joints, np.nan), people.time_s)
    start = triangulate(observations, Views.of(rig), config)
    fitter = MultiViewSmplify(detector_s_body(people))
    began = time.process_time()
    joints, _ = fitter.fit(observations, rig, start)
    return SmplOnly(PlainPeople(people.frame.astype(np.int64), joints), start, time.process_time() - began)


class MultiViewSmplify:
    """Fits bodies to the views' detections of rows that have nothing to do with each other, all at once."""

    def __init__(self, model: BodyModel | None = None, kernel_scale: float = 2.5):
        """At `kernel_scale` sigmas the Geman-McClure kernel has cut a detection's weight to a quarter."""
        model, prior = BodyModel.default() if model is None else model, PosePrior.default()
        self._kernel_scale = kernel_scale
        self.model = model
        self._frame = PersonFrame.of_angles(model, prior.mean, prior.covariance)
        self._slots = slots(model.keypoint_names)
        self._energy = BodyEnergy(self.model, prior)
        self._torso = np.array([name in TORSO for name in model.keypoint_names])

    def fit(self, observations: Observations, rig: Rig, start: Array) -> tuple[Array, BodyParameters]:
        """Bodies of N rows: joints (N, J, 3) where the detector puts them, metres, and parameters; NaN for none.

        Where triangulation puts the joints, `start` (N, J, 3), metres, NaN where it does not, gives the root's
        first place, and nothing else. Rows with fewer than three joints have no body.
        """
        placed = np.asarray(np.isfinite(start).all(axis=-1))
        rows = np.flatnonzero(placed.sum(axis=1) >= _MIN_START_JOINTS)
        N, J = start.shape[:2]
        joints = np.full((N, J, 3), np.nan)
        free = np.full((N, self._energy.num_free), np.nan)
        if len(rows) > 0:
            rotation, pelvis = self._root(start[rows], placed[rows])
            views = ViewTargets.of(observations.rows(rows), rig, pelvis, _SIGMA_M)
            solved = self._solve(rotation, views)
            joints[rows] = self.model.keypoints(self._energy.complete(solved)) + pelvis[:, None]
            solved[:, -3:] += pelvis
            free[rows] = solved
        return joints, self._energy.complete(free)

    def _root(self, start: Array, placed: Mask) -> tuple[Array, Array]:
        """Rotations (B, 3, 3) and places (B, 3) of the root, by the torso's joints, or by all if these are few."""
        torso = placed & self._torso
        used = np.where(torso.sum(axis=1, keepdims=True) >= _MIN_START_JOINTS, torso, placed)
        variance = np.where(used, _START_SIGMA_M**2, 1e6)
        # Nothing of a joint that is not used: its place is that of those that are.
        centre = np.nanmean(np.where(used[..., None], start, np.nan), axis=1, keepdims=True)
        return self._frame.place(np.where(used[..., None], start, centre), variance, self._slots)

    def _solve(self, rotation: Array, views: "ViewTargets") -> Array:
        """Free parameters (B, P) around the root's start: all steps of Adam (Kingma and Ba 2015)."""
        energy, B = self._energy, len(rotation)
        angles, transl = (np.broadcast_to(v, (B, len(v))) for v in (energy.priors.mean, self._frame.transl))
        free = np.concatenate((np.zeros((B, 10)), log_so3(rotation), angles, transl), 1)
        lengths = np.full(energy.num_free, _STEP_RAD)
        lengths[:10], lengths[-3:] = _STEP_BETA, _STEP_M
        for root_only in (True, False):
            steps = _ROOT_STEPS if root_only else _STEPS
            only = self._torso if root_only else None
            first, second = np.zeros_like(free), np.zeros_like(free)
            for n in range(steps):
                looser = 1.0 if root_only else max(0.0, 1.0 - 2.0 * n / steps)
                stiff, scale = _STIFF**looser, self._kernel_scale * 4.0**looser
                # The priors are the energy's own; stiffer ones are detections that weigh less.
                gradient = self._gradient(free, views, scale, 1 / stiff, only)
                if root_only:
                    gradient[:, :10] = gradient[:, 13:-3] = 0.0
                first = _MOMENTUM * first + (1 - _MOMENTUM) * gradient
                second = _MEMORY * second + (1 - _MEMORY) * gradient**2
                unbiased = math.sqrt(1 - _MEMORY ** (n + 1)) / (1 - _MOMENTUM ** (n + 1))
                length = 0.5 * (1 + math.cos(math.pi * n / steps)) * unbiased * lengths
                free = energy.retract(free, -length * first / (np.sqrt(second) + _TINY))
        return free

    def _gradient(
        self, free: Array, views: "ViewTargets", scale: float, weight: float, only: Mask | None
    ) -> Array:
        """Half the gradient (B, P) of priors and views: a force is a target that is as far, known to a metre."""
        energy, B = self._energy, len(free)
        xyz, held = self.model.keypoints(energy.complete(free)), energy.held_by_priors(B)
        _, forces = views.pull(xyz, scale, weight, only)
        targets = EnergyTargets(xyz - forces, np.broadcast_to(np.eye(3), (*xyz.shape, 3)))
        return energy.linearise(free, targets, _NO_KERNEL, held, slope_only=True).gradient


@dataclass(frozen=True)
class ViewTargets:
    """The detections of B rows as lengths at each row's depth, around each row's own origin."""

    cTw: Array
    """(V, 3, 3) rotations, camera from world."""
    origin: Array
    """(B, V, 3) the row's origin in each camera, metres."""
    xy: Array
    """(B, J, V, 2) detections, normalised image coordinates."""
    weight: Array
    """(B, J, V) confidence; 0 where there is none."""
    scale: Array
    """(B, V) depth of the origin over sigma: from normalised coordinates to sigmas."""

    @classmethod
    def of(cls, observations: Observations, rig: Rig, origin: Array, sigma_m: float) -> "ViewTargets":
        """The detections of B rows, with `origin` (B, 3) in the world."""
        B, J, V = observations.confidence.shape
        view = np.tile(np.arange(V), B * J)
        xy = rig.normalise(view, observations.xy.reshape(-1, 2)).reshape(B, J, V, 2)
        in_camera = np.einsum("vij,bj->bvi", rig.cTw[:, :, :3], origin) + rig.cTw[:, :, 3]
        scale = np.maximum(in_camera[..., 2], _MIN_DEPTH_M) / sigma_m
        parts = (rig.cTw[:, :, :3], in_camera, xy, observations.confidence, scale)
        return cls(*parts)

    def pull(self, xyz: Array, kernel_scale: float, weight: float, only: Mask | None) -> tuple[Array, Array]:
        """Squared distances (B, J) of keypoints (B, J, 3), summed over the views, and half the gradient (B, J, 3)
        of their energy.
        """
        camera = np.einsum("vij,bkj->bkvi", self.cTw, xyz, optimize=True) + self.origin[:, None]
        depth = np.maximum(camera[..., 2], _MIN_DEPTH_M)
        projected = camera[..., :2] / depth[..., None]
        residual = (projected - self.xy) * self.scale[:, None, :, None]
        squared = np.square(residual).sum(-1)
        strength = weight * self.weight * (camera[..., 2] > _MIN_DEPTH_M)
        if only is not None:
            strength = strength * only[:, None]
        robust = strength * robust_weight(squared, kernel_scale)
        across = (robust * self.scale[:, None] / depth)[..., None] * residual
        along = -(across * projected).sum(-1, keepdims=True)
        forces = np.einsum("vij,bkvi->bkj", self.cTw, np.concatenate((across, along), -1), optimize=True)
        return (strength * squared).sum(-1), forces
