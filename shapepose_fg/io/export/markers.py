"""Points with names, for files of markers: TRC and C3D."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.skeleton import MID_HIP, SMPL_24
from shapepose_fg.io.export.job import MarkerSet
from shapepose_fg.io.export.skinned import motion_of
from shapepose_fg.io.export.take import Take, opensim_axes


@dataclass(frozen=True)
class Markers:
    """One person's M markers over T frames, in the axes of TRC and C3D."""

    names: tuple[str, ...]
    """(M,) names."""
    xyz: NDArray[np.float64]
    """(T, M, 3) metres, y up; NaN where the marker is missing."""
    sigma_m: NDArray[np.float64]
    """(T, M) standard deviation, root mean square over the axes, metres; NaN where it is not known."""

    @property
    def there(self) -> NDArray[np.bool_]:
        """(T, M) where a marker is not missing."""
        return np.asarray(np.isfinite(self.xyz).all(axis=2))

    @property
    def frames(self) -> NDArray[np.intp]:
        """(F,) the frames with a marker."""
        return np.flatnonzero(self.there.sum(axis=1))


def markers_of(take: Take, person: int, kind: MarkerSet, arrays: SmplArrays | None = None) -> Markers:
    """The markers of one person; `arrays` is the body model, for `MarkerSet.BODY` only."""
    axes = opensim_axes(take.up)
    if kind == MarkerSet.BODY:
        if arrays is None:
            raise ValueError("markers on the body need the body model")
        xyz = np.full((len(take.frames), len(SMPL_24), 3), np.nan)
        motion = motion_of(take, person, arrays, axes)
        if motion is not None:
            xyz[motion.index] = motion.joints()
        return Markers(SMPL_24, xyz, np.full(xyz.shape[:2], np.nan))
    names = tuple(take.people.joint_names.tolist())
    xyz = take.column("joints", person) @ axes.T
    sigma = sigma_m(take.column("covariance", person))
    return Markers(opensim_names(names) if kind == MarkerSet.OPENSIM else names, xyz, sigma)


def opensim_names(joints: tuple[str, ...]) -> tuple[str, ...]:
    """The names that Pose2Sim's OpenSim models have for joints: ours, but for the middle of the hips, which is
    `Hip` in the model for HALPE_26, which has the top of the head too, and `CHip` in those for BODY_25 and COCO.
    """
    hip = "Hip" if "Head" in joints else "CHip"
    return tuple(hip if name == MID_HIP else name for name in joints)


def sigma_m(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) standard deviation of positions with covariance (..., 3, 3): root mean square over the axes."""
    variance = np.trace(covariance, axis1=-2, axis2=-1) / 3
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(variance >= 0, variance, np.nan))
