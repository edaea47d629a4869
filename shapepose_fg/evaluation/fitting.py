"""How good body fitters are against known bodies: targets made worse step by step, errors, honest covariances."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import CovarianceCalibration, covariance_calibration

Array = NDArray[np.float64]

SHAPE_LIMIT = 2.5
"""Betas of the people who are drawn are standard normal, clipped here."""
ROOM_M = 4.0
"""Side of the square that they stand in."""
SIGMA_FLOOR_M = 0.005
"""Nobody claims to know a joint better than this."""
LIMBS = tuple(
    tuple(BODY_25.index(side + part) for part in parts.split())
    for side in "LR"
    for parts in ("Shoulder Elbow Wrist", "Hip Knee Ankle BigToe SmallToe Heel")
)
"""What is hidden together: arms and legs."""
GROUPS = {
    "trunk": "Neck MidHip RShoulder LShoulder RHip LHip",
    "face": "Nose REye LEye REar LEar",
    "elbows, knees": "RElbow LElbow RKnee LKnee",
    "wrists, ankles": "RWrist LWrist RAnkle LAnkle",
    "feet": "LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel",
}
"""Joints that are alike, for `sigma_ratios`."""


@dataclass(frozen=True)
class TrueBodies:
    """N bodies whose every parameter is known."""

    betas: Array
    """(N, 10) shapes."""
    global_orient: Array
    """(N, 3) rotation of the root in a world with z up, axis-angle, rad."""
    body_pose: Array
    """(N, 23, 3) rotations of the other joints relative to their parents, axis-angle, rad."""
    transl: Array
    """(N, 3) translation, metres."""
    keypoints: Array
    """(N, 25, 3) BODY_25 joints, metres."""

    def __len__(self) -> int:
        """Count of bodies, N."""
        return len(self.betas)

    def rows(self, index: NDArray) -> "TrueBodies":
        """Some of the bodies, by indices or a mask."""
        return TrueBodies(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


@dataclass(frozen=True)
class Corruption:
    """What is done to joints before a fitter sees them."""

    name: str
    """For tables."""
    sigma_m: float = 0.0
    """Standard deviation of the noise along each axis, metres."""
    missing: float = 0.0
    """Expected share of the joints without a target: half of them with their whole limb, half singly."""

    def __post_init__(self) -> None:
        if self.sigma_m < 0:
            raise ValueError(f"sigma_m must not be negative, got {self.sigma_m}")
        if not 0 <= self.missing < 1:
            raise ValueError(f"missing must be a share of the joints from 0 to below 1, got {self.missing}")


SETTINGS = (Corruption("clean"), Corruption("10 mm", 0.01), Corruption("20 mm, 30 % missing", 0.02, 0.3))
"""Noise per axis, and the share of the joints that are missing."""


@dataclass(frozen=True)
class FitErrors:
    """Distances to the truth, millimetres, of the rows that every fitter was asked for."""

    joints_mm: Array
    """(N, 25) of each joint; NaN where there is no body."""
    missing: NDArray[np.bool_]
    """(N, 25) joints that had no target."""
    vertices_mm: Array
    """(M,) mean over the mesh, of the rows whose mesh was compared; NaN where there is no body."""

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """(N,) rows that have a body."""
        return np.asarray(np.isfinite(self.joints_mm).all(axis=1))

    @property
    def mean_mm(self) -> float:
        """Over all joints."""
        return _mean(self.joints_mm)

    @property
    def seen_mm(self) -> float:
        """Over the joints that had a target."""
        return _mean(self.joints_mm[~self.missing])

    @property
    def missing_mm(self) -> float:
        """Over the joints that had none; NaN where all had one."""
        return _mean(self.joints_mm[self.missing])

    @property
    def vertex_mm(self) -> float:
        """Over the mesh."""
        return _mean(self.vertices_mm)


def true_bodies(poses: NDArray[np.floating], model: BodyModel, rng: np.random.Generator) -> TrueBodies:
    """Bodies of random shapes in recorded `poses` (N, 24, 3), axis-angle, y up; each somewhere in a room, z up.

    Shapes, headings and places come from `rng`.
    """
    import torch

    count = len(poses)
    if poses.shape != (count, 24, 3):
        raise ValueError(f"poses must be (N, 24, 3): the root's rotation and 23 others, got {poses.shape}")
    heading = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (count, 1)))
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    orient = (heading * upright * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    betas = np.clip(rng.normal(size=(count, 10)), -SHAPE_LIMIT, SHAPE_LIMIT)
    transl = np.concatenate([rng.uniform(-ROOM_M / 2, ROOM_M / 2, (count, 2)), np.ones((count, 1))], axis=1)
    parts = (betas, orient, poses[:, 1:].astype(np.float64), transl)
    with torch.no_grad():
        keypoints = model.to(torch.float64).keypoints(BodyParameters(*map(torch.from_numpy, parts)))
    return TrueBodies(*parts, keypoints.numpy())


def corrupt(
    keypoints: Array, corruption: Corruption, rng: np.random.Generator
) -> tuple[JointTargets, NDArray[np.bool_]]:
    """Targets of joints (N, 25, 3), and which are missing (N, 25): NaN there, and without information."""
    missing = draw_missing(len(keypoints), corruption.missing, rng)
    xyz = keypoints + rng.normal(0.0, 1.0, keypoints.shape) * corruption.sigma_m
    precision = np.where(missing, 0.0, max(corruption.sigma_m, SIGMA_FLOOR_M) ** -2)
    xyz[missing] = np.nan
    return JointTargets(xyz, precision[..., None, None] * np.eye(3)), missing


def draw_missing(count: int, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N, 25) joints that are missing: each limb as a whole, then each joint left by itself.

    The chances are such that either way is expected to take `share` / 2 of the 25 joints.
    """
    each_way = share / 2 * len(BODY_25)
    missing = np.zeros((count, len(BODY_25)), dtype=bool)
    gone = rng.random((count, len(LIMBS))) < each_way / sum(map(len, LIMBS))
    for limb, joints in enumerate(LIMBS):
        missing[:, joints] = gone[:, limb, None]
    return missing | (rng.random(missing.shape) < each_way / (len(BODY_25) - each_way))


def concatenated(fits: list[BodyFit]) -> BodyFit:
    """The rows of all, in order."""
    return BodyFit(**{f.name: np.concatenate([getattr(fit, f.name) for fit in fits]) for f in fields(BodyFit)})


def batches(targets: JointTargets, size: int) -> list[JointTargets]:
    """The rows in order, `size` at a time."""
    starts = range(0, len(targets), size)
    return [JointTargets(targets.xyz[i : i + size], targets.information[i : i + size]) for i in starts]


def fit_errors(
    fit: BodyFit, truth: TrueBodies, missing: NDArray[np.bool_], model: BodyModel, meshes: int = 256
) -> FitErrors:
    """Distances of fitted bodies to the true ones; the mesh of `meshes` rows, evenly spread, is compared too."""
    rows = np.unique(np.linspace(0, len(truth) - 1, min(meshes, len(truth))).astype(np.intp))
    found, true = (_vertices(bodies.rows(rows), model) for bodies in (fit, truth))
    vertices = 1e3 * np.linalg.norm(found - true, axis=-1).mean(axis=1)
    vertices[~fit.ok[rows]] = np.nan
    return FitErrors(1e3 * np.linalg.norm(fit.joints - truth.keypoints, axis=-1), missing, vertices)


def fit_calibration(
    fit: BodyFit, truth: TrueBodies, joints: NDArray[np.bool_], *, left_out: bool = False
) -> CovarianceCalibration:
    """Whether the true joints of the mask (N, 25) lie where `covariance` says.

    With `left_out`, where `prior_covariance` says that the body alone puts them: that one is a prediction of the
    detector's joint, which here is the true one.
    """
    xyz, covariance = (fit.prior_xyz, fit.prior_covariance) if left_out else (fit.joints, fit.covariance)
    return covariance_calibration((xyz - truth.keypoints)[joints], covariance[joints])


def sigma_ratios(fit: BodyFit, truth: TrueBodies, joints: NDArray[np.bool_]) -> dict[str, float]:
    """Sigma claimed over error found, root mean square per axis, of the joints of the mask, by `GROUPS`.

    1 is honest, more is modest; NaN for a group without joints.
    """
    error = np.square(fit.joints - truth.keypoints).mean(axis=-1)
    claimed = np.trace(fit.covariance, axis1=-2, axis2=-1) / 3
    known = joints & np.isfinite(error) & np.isfinite(claimed)
    ratios = {}
    for name, members in GROUPS.items():
        mask = np.zeros_like(known)
        mask[:, [BODY_25.index(joint) for joint in members.split()]] = True
        mask &= known
        ratios[name] = float(np.sqrt(claimed[mask].mean() / error[mask].mean())) if mask.any() else float("nan")
    return ratios


def _vertices(bodies: BodyFit | TrueBodies, model: BodyModel) -> Array:
    import torch

    parts = (bodies.betas, bodies.global_orient, bodies.body_pose, bodies.transl)
    with torch.no_grad():
        parameters = BodyParameters(*(torch.from_numpy(part).to(model.dtype) for part in parts))
        return model.vertices(parameters).double().numpy()


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) > 0 else float("nan")
