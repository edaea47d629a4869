"""Is what Levenberg-Marquardt ends in the optimum? Asked of SciPy's L-BFGS, in double precision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter, PlainFitterConfig
from shapepose_fg.body.fitting.energy import BodyEnergy, WhitenedTargets
from shapepose_fg.body.fitting.evidence import weigh
from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import right_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OptimumCheck:
    """Energies at the end of Levenberg-Marquardt, and of L-BFGS from there and from elsewhere; R rows."""

    energy: Array
    """(R,) where Levenberg-Marquardt ends, in squared standard deviations."""
    from_there: Array
    """(R,) where L-BFGS ends that starts there."""
    from_elsewhere: Array
    """(R,) where L-BFGS ends that starts at other bodies."""
    moved_mm: Array
    """(R,) mean distance that the joints move in the first of the two."""


def check_optimum(targets: JointTargets, elsewhere: BodyFit) -> OptimumCheck:
    """Fit by `LevenbergMarquardtFitter`, then by L-BFGS from its result and from the bodies `elsewhere`.

    Default body, prior and settings; rows without a body are left out.
    """
    fit = LevenbergMarquardtFitter().fit(targets)
    rows = np.flatnonzero(fit.ok & elsewhere.ok)
    objective = _Objective(targets, rows)
    here, there = objective.free(fit), objective.free(elsewhere)
    energy = np.array([objective(i, here[i])[0] for i in range(len(rows))])
    found = [_descend(objective, i, here[i]) for i in range(len(rows))]
    other = [_descend(objective, i, there[i])[0] for i in range(len(rows))]
    moved = [objective.apart_mm(here[i], found[i][1]) for i in range(len(rows))]
    return OptimumCheck(energy, np.array([value for value, _ in found]), np.array(other), np.array(moved))


class _Objective:
    """The energy and its gradient of single rows, over plain vectors."""

    def __init__(self, targets: JointTargets, rows: NDArray[np.intp]):
        import torch

        config = PlainFitterConfig()
        evidence = weigh(targets, config.evidence)
        self.energy = BodyEnergy(BodyModel.default().to(torch.float64), PosePrior.default())
        self.rows, self.centre = rows, evidence.centre[rows]
        xyz, root = evidence.xyz[rows] - self.centre[:, None], evidence.root[rows]
        self._targets = WhitenedTargets(torch.from_numpy(xyz), torch.from_numpy(root))
        self._scale = torch.tensor([[config.kernel_scale]], dtype=torch.float64)

    def free(self, fit: BodyFit) -> Array:
        """(R, P) the free parameters of fitted bodies."""
        angles = fit.body_pose[self.rows].reshape(len(self.rows), -1)[:, self.energy.angles]
        transl = fit.transl[self.rows] - self.centre
        return np.concatenate([fit.betas[self.rows], fit.global_orient[self.rows], angles, transl], axis=1)

    def __call__(self, row: int, free: Array) -> tuple[float, Array]:
        import torch

        theta = torch.from_numpy(free)[None]
        here = self.energy.linearise(theta, self._targets[torch.tensor([row])], self._scale)
        gradient = 2 * here.gradient[0]
        # From the right tangent of the orientation to its vector: exp(a + da) = exp(a) exp(Jr da).
        gradient[10:13] = right_jacobian(theta[0, 10:13]).T @ gradient[10:13]
        return float(here.energy(self._scale)), gradient.numpy()

    def apart_mm(self, first: Array, second: Array) -> float:
        """Mean distance between the joints of two vectors of parameters."""
        import torch

        both = self.energy.complete(torch.from_numpy(np.stack([first, second])))
        xyz = self.energy.model.keypoints(both).numpy()
        return float(1e3 * np.linalg.norm(xyz[1] - xyz[0], axis=-1).mean())


def _descend(objective: _Objective, row: int, start: Array) -> tuple[float, Array]:
    options = {"maxiter": 2000, "maxfun": 4000, "ftol": 1e-12, "gtol": 1e-6, "maxcor": 30}
    result = minimize(lambda free: objective(row, free), start, jac=True, method="L-BFGS-B", options=options)
    return float(result.fun), result.x
