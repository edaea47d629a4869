"""One person's bodies over time: what they are fitted to, who fits them, and what comes out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets, Shapes
from shapepose_fg.body.model.soles import above_floor
from shapepose_fg.estimation.floor import Floor


@dataclass(frozen=True)
class Person:
    """What one person's bodies are fitted to, N rows; plain data, which can be sent to another process."""

    number: int
    """Who it is."""
    targets: JointTargets
    """The joints as they were solved."""
    time_s: NDArray[np.float64]
    """(N,) seconds."""
    shapes: Shapes | None = None
    """What is known of the shape, (1)."""
    fixed_shapes: bool = False
    """Whether the shape is known and stays."""
    kept: range | None = None
    """The rows whose bodies are wanted, None for all. Others overlap with what is before and after, or tell of the
    shape only."""
    floor: Floor | None = None
    """What bodies do not sink into, where it was found."""

    @classmethod
    def of(
        cls,
        number: int,
        joints: NDArray[np.float64],
        covariance: NDArray[np.float64],
        time_s: NDArray[np.float64],
    ) -> "Person":
        """From the solved rows of one person: `joints` (N, J, 3), `covariance` (N, J, 3, 3), `time_s` (N,)."""
        solved = np.isfinite(joints.sum(axis=-1)) & np.isfinite(covariance.sum(axis=(-1, -2)))
        information = np.zeros_like(covariance)
        information[solved] = np.linalg.inv(covariance[solved])
        information = (information + information.swapaxes(-1, -2)) / 2
        return cls(number, JointTargets(np.where(solved[..., None], joints, 0.0), information), time_s)

    def fitted(self, fitter: BodyFitter) -> "PersonBodies":
        """The bodies, and the shape that they share."""
        group = np.full(len(self.time_s), self.number)
        found = fitter.fit_sequence(self.targets, group, self.time_s, self.shapes, fixed_shapes=self.fixed_shapes)
        fit = found.fit if self.kept is None else found.fit.rows(np.arange(self.kept.start, self.kept.stop))
        bodies = fit.betas, fit.global_orient, fit.body_pose, fit.transl
        if self.floor is not None and fitter.model is not None:
            bodies = above_floor(fitter.model, bodies, self.floor.normal, self.floor.height_m)
        return PersonBodies(fit.ok, *bodies, found.shapes)


@dataclass(frozen=True)
class PersonBodies:
    """One person's bodies in N rows."""

    ok: NDArray[np.bool_]
    """(N,) which rows have one."""
    betas: NDArray[np.float64]
    """(N, 10), and the next three as in `Reconstruction`."""
    global_orient: NDArray[np.float64]
    body_pose: NDArray[np.float64]
    transl: NDArray[np.float64]
    shape: Shapes
    """(1) what all rows say of the shape."""
