"""Native projection factors: a joint detected by a camera with a fixed, an unknown or a moving
pose.

Residual of every factor here, in pixels (x right, y down, image points undistorted):

    r = project(camera, joint) - uv

GTSAM does not raise an error for a point behind the camera: the residual is (2 fx, 2 fx) and the
Jacobian 0, so the factor constrains nothing and its error stays. Gate on depth (`in_front`) before
adding one.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray

from factors.motion import contained
from factors.noise import Kernel, KernelName, isotropic, isotropic_models, kernel_weight


def make_camera(K: ArrayLike, wTc: ArrayLike) -> gtsam.PinholeCameraCal3_S2:
    """Make GTSAM's camera from `K` (3, 3) in pixels and the world-from-camera pose `wTc` (4, 4) in
    metres.

    OpenCV's convention: x right, y down, z forward. Make it once per view; factors can share it.
    """
    pose = np.asarray(wTc, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"wTc must be a (4, 4) matrix of finite numbers, got {pose}")
    return gtsam.PinholeCameraCal3_S2(gtsam.Pose3(pose), make_calibration(K))


def make_calibration(K: ArrayLike) -> gtsam.Cal3_S2:
    """Make GTSAM's calibration from the intrinsic matrix `K` (3, 3), pixels."""
    matrix = np.asarray(K, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ValueError(f"K must be a (3, 3) matrix of finite numbers, got {matrix.tolist()}")
    return gtsam.Cal3_S2(matrix[0, 0], matrix[1, 1], matrix[0, 1], matrix[0, 2], matrix[1, 2])


def projection_factor(
    camera: gtsam.PinholeCameraCal3_S2,
    uv: ArrayLike,
    sigma_px: float,
    key: int,
    kernel: Kernel | None = None,
) -> gtsam.NoiseModelFactor:
    """Make the factor of a detection at `uv` (2,) by a camera with a fixed pose.

    Its variable is the joint `key`, a `Point3`; `sigma_px` is the standard deviation per axis.
    """
    return gtsam.TriangulationFactorCal3_S2(camera, _pixel(uv), isotropic(2, sigma_px, kernel), key)


def projection_factors(
    cameras: Sequence[gtsam.PinholeCameraCal3_S2],
    view: ArrayLike,
    keys: ArrayLike,
    xy: ArrayLike,
    sigmas_px: ArrayLike,
    kernel: Kernel | None = None,
) -> list[gtsam.NoiseModelFactor]:
    """One projection factor for each of D observations: `projection_factor` for arrays (Eq. 1).

    Observation d: `cameras[view[d]]` detected the joint `keys[d]` at `xy[d]` (D, 2) with the
    standard deviation `sigmas_px[d]`, pixels. A factor is immutable and may sit in several graphs:
    if only the gates change between two solves, select from this list instead of building the
    factors again. ValueError for shapes that disagree or pixels that are not finite.
    """
    points = np.asarray(xy, dtype=np.float64)
    views, key_list = np.asarray(view), np.asarray(keys)
    count = len(points)
    if points.shape != (count, 2) or not views.shape == key_list.shape == np.shape(sigmas_px) == (
        count,
    ):
        raise ValueError(
            f"view, keys and sigmas_px must be (D,) and xy (D, 2), got {views.shape}, "
            f"{key_list.shape}, {np.shape(sigmas_px)}, {points.shape}"
        )
    if not np.isfinite(points).all():
        raise ValueError("xy holds a value that is not finite: drop unseen joints first")
    if count and (views.min() < 0 or views.max() >= len(cameras)):
        raise ValueError(
            f"view must be 0 to {len(cameras) - 1}, got {views.min()} to {views.max()}"
        )
    models = isotropic_models(2, sigmas_px, kernel)
    chosen = [cameras[index] for index in views.tolist()]
    return list(map(gtsam.TriangulationFactorCal3_S2, chosen, points, models, key_list.tolist()))


def moving_projection_factors(
    keys: ArrayLike,
    velocity_keys: ArrayLike,
    lead_s: ArrayLike,
    points: ArrayLike,
    slopes: ArrayLike,
    residuals: ArrayLike,
    sigmas_px: ArrayLike,
    kernel: KernelName | None = None,
    width: float = 1.0,
) -> list[gtsam.NonlinearFactor]:
    """D detections of moving joints, exposed `lead_s` (D,) seconds after the time of their states;
    linear factors.

    At the exposure, the joint is at x + lead v, with position x (`keys` (D,)) and velocity v
    (`velocity_keys` (D,)). The projection is linearised at `points` (D, 3), metres in the world,
    with the derivative of the pixel `slopes` (D, 2, 3), pixels per metre, and the residual
    `residuals` (D, 2), pixels. The weight of a robust kernel, with its `width` in standard
    deviations, is computed once, at this point.
    """
    position, velocity = np.asarray(keys), np.asarray(velocity_keys)
    at, slope, off = (np.asarray(each, dtype=np.float64) for each in (points, slopes, residuals))
    lead, sigma, count = (
        np.asarray(lead_s, dtype=np.float64),
        np.asarray(sigmas_px, dtype=np.float64),
        len(at),
    )
    shapes = [np.shape(each) for each in (position, velocity, lead, sigma, at, slope, off)]
    if shapes != [(count,)] * 4 + [(count, 3), (count, 2, 3), (count, 2)]:
        raise ValueError(
            "keys, lead_s and sigmas_px must be (D,), points (D, 3), slopes (D, 2, 3), got "
            f"{shapes}"
        )
    if (
        not all(np.isfinite(each).all() for each in (lead, sigma, at, slope, off))
        or not (sigma > 0).all()
    ):
        raise ValueError("every observation must be finite and its sigma positive")
    weight = np.sqrt(kernel_weight(kernel, np.linalg.norm(off, axis=1) / sigma, width)) / sigma
    slope = slope * weight[:, None, None]
    right = (slope @ at[..., None])[..., 0] - off * weight[:, None]
    order = np.argsort(position, kind="stable")
    first = np.flatnonzero(np.diff(position[order], prepend=position[order[:1]] - 1))
    linear = [
        gtsam.JacobianFactor(
            int(position[rows[0]]), slope[rows].reshape(-1, 3),
            int(velocity[rows[0]]), (slope[rows] * lead[rows, None, None]).reshape(-1, 3),
            right[rows].ravel(), noiseModel.Unit.Create(2 * len(rows)),
        )
        for rows in np.split(order, first[1:])
        if len(rows) > 0
    ]  # fmt: skip
    return contained(linear, np.concatenate([position, velocity]))


def posed_projection_factor(
    calibration: gtsam.Cal3_S2,
    uv: ArrayLike,
    sigma_px: float,
    pose_key: int,
    key: int,
    kernel: Kernel | None = None,
    body_T_sensor: gtsam.Pose3 | None = None,
) -> gtsam.NoiseModelFactor:
    """Make the factor of a detection at `uv` (2,) by a camera with an unknown or moving pose.

    Its variables are the joint `key`, a `Point3`, and `pose_key`, a `Pose3`: world from camera, or,
    with `body_T_sensor` (robot from camera), world from the robot that carries the camera.
    `sigma_px` is the standard deviation per axis. The world frame as a whole is not determined:
    fix a pose with a prior.
    """
    model: noiseModel.Base = isotropic(2, sigma_px, kernel)
    if body_T_sensor is None:
        return gtsam.GenericProjectionFactorCal3_S2(_pixel(uv), model, pose_key, key, calibration)
    return gtsam.GenericProjectionFactorCal3_S2(
        _pixel(uv), model, pose_key, key, calibration, body_T_sensor
    )


def posed_projection_factors(
    calibrations: Sequence[gtsam.Cal3_S2],
    view: ArrayLike,
    pose_keys: ArrayLike,
    sensors: Sequence[gtsam.Pose3],
    keys: ArrayLike,
    xy: ArrayLike,
    sigmas_px: ArrayLike,
    kernel: Kernel | None = None,
) -> list[gtsam.NoiseModelFactor]:
    """`posed_projection_factor` for arrays of D observations.

    Observation d: the camera `sensors[d]`, carrier from camera, on the carrier `pose_keys[d]`, with
    the lens `calibrations[view[d]]`, detected the joint `keys[d]` at `xy[d]` (D, 2) with the
    standard deviation `sigmas_px[d]`, pixels.
    """
    points, chosen = np.asarray(xy, dtype=np.float64), np.asarray(view)
    poses, joints, count = np.asarray(pose_keys), np.asarray(keys), len(points)
    shapes = [each.shape for each in (chosen, poses, joints)]
    if (
        points.shape != (count, 2)
        or shapes != [(count,)] * 3
        or not len(sensors) == np.size(sigmas_px) == count
    ):
        raise ValueError(
            "view, pose_keys, keys and sigmas_px must be (D,), xy (D, 2), and sensors D, got "
            f"{shapes}, {np.shape(sigmas_px)}, {points.shape} and {len(sensors)}"
        )
    if not np.isfinite(points).all():
        raise ValueError("xy holds a value that is not finite: drop unseen joints first")
    models, lenses = (
        isotropic_models(2, sigmas_px, kernel),
        [calibrations[each] for each in chosen.tolist()],
    )
    given = points, models, poses.tolist(), joints.tolist(), lenses, sensors
    return list(map(gtsam.GenericProjectionFactorCal3_S2, *given))


def in_front(depth_m: ArrayLike, min_depth_m: float = 0.1) -> NDArray[np.bool_]:
    """Which depths (...,) along the optical axis are at least `min_depth_m`, metres; NaN is not."""
    return np.asarray(depth_m, dtype=np.float64) >= min_depth_m


def inlier_gate(residual_px: ArrayLike, rho_2d_px: ArrayLike) -> NDArray[np.bool_]:
    """delta_ij of Eq. 2: which reprojection distances (...,) are under `rho_2d_px` (...,); NaN is
    not.
    """
    rho = np.asarray(rho_2d_px, dtype=np.float64)
    if np.any(rho <= 0):
        raise ValueError(f"rho_2d_px must be positive, got {rho.min()}")
    return np.asarray(residual_px, dtype=np.float64) < rho


def _pixel(uv: ArrayLike) -> NDArray[np.float64]:
    point = np.asarray(uv, dtype=np.float64)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ValueError(f"uv must be two finite pixels, got {uv}")
    return point
