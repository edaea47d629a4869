"""Leave-one-out predictions: sets of targets to leave out, and the passes of a fit without them."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.energy import BodyEnergy, EnergyTargets
from shapepose_fg.body.fitting.evidence import Evidence, determine_pose
from shapepose_fg.body.fitting.fitter import BodyConfig
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.core.arrays import Array, Index, Mask

SETS = 6
"""Number of sets. More sets cost more passes, but leave fewer joints out at once."""
_POSES = 8
"""Number of poses, sampled from the prior, at which the coupling of joints is linearised."""
_ROOT_INFORMATION = 1e-2
"""Prior information on the root's rotation, 1/rad², and position, 1/m², for that linearisation:
negligible."""


@dataclass(frozen=True)
class Passes:
    """M fits to the targets of R rows: first each row with all its targets, then with some of them
    left out.

    The prediction of a joint is from a pass without its target, so that it does not depend on the
    target's noise, exactly and not only to first order.
    """

    evidence: Evidence
    """(R) the targets."""
    row: Index
    """(M,) row of each pass; the first R are 0 to R - 1."""
    without: Mask
    """(M, J) targets that are left out."""
    pool: Index
    """(M,) pool of each pass: passes of one group with the same targets left out get one shape."""
    votes: Mask
    """(M,) whether a pass contributes to its pool's shape."""

    @classmethod
    def whole(cls, evidence: Evidence, groups: Index) -> "Passes":
        """One pass per row of `groups` (R,), with all targets."""
        R, J = evidence.xyz.shape[:2]
        return cls(
            evidence, np.arange(R), np.zeros((R, J), dtype=bool), groups, np.ones(R, dtype=bool)
        )

    @classmethod
    def of(cls, evidence: Evidence, sets: Index, groups: Index) -> "Passes":
        """One pass per row (R) with all targets, and one for every set of joints (J,) to leave out.

        A set without targets in any row of a group (R,) needs no pass. If the remaining joints do
        not determine the pose, those of the set are left out one by one; these passes take the
        shape of their group's others.
        """
        seen, full = evidence.information.any(axis=(2, 3)), np.isfinite(evidence.variance_m2)
        R, J, S = *seen.shape, sets.max() + 1
        member = sets == np.arange(S)[:, None]  # (S, J)
        _, group = np.unique(groups, return_inverse=True)
        asked = np.zeros((group.max() + 1, S), dtype=bool)
        np.logical_or.at(asked, group, seen @ member.T)
        determined = determine_pose(evidence.xyz[:, None], full[:, None] & ~member)  # (R, S)
        together = np.argwhere(asked[group] & determined)
        singly = np.argwhere((asked[group] & ~determined)[:, sets])
        of_set = np.concatenate([np.full(R, -1), together[:, 1], sets[singly[:, 1]]])
        row = np.concatenate([np.arange(R), together[:, 0], singly[:, 0]])
        alone = np.eye(J, dtype=bool)[singly[:, 1]]
        without = np.concatenate([np.zeros((R, J), dtype=bool), member[together[:, 1]], alone])
        votes = np.arange(len(row)) < R + len(together)
        return cls(evidence, row, without, group[row] * (S + 1) + of_set + 1, votes)

    def chunks(self, size: int) -> list[Index]:
        """Pass indices in parts of at most `size`: first those with all targets, then
        the others.
        """
        R, M = len(self.evidence.xyz), len(self.row)
        ends = [(0, R), (R, M)]
        return [
            np.arange(at, min(at + size, end))
            for start, end in ends
            for at in range(start, end, size)
        ]

    def asked(self, index: Index) -> Index:
        """(B, N) joints that some passes must predict: all, or those left out, padded with others
        to equal number.
        """
        without = self.without[index]
        if not without.any():
            return np.broadcast_to(np.arange(without.shape[1]), without.shape)
        return np.argsort(~without, axis=1, kind="stable")[:, : self.without.sum(axis=1).max()]

    def given(self, index: Index) -> tuple[EnergyTargets, Array]:
        """Targets of some passes, relative to the centres of their rows, and the variance of each
        (B, J); infinite for targets left out.
        """
        evidence, row, without = self.evidence, self.row[index], self.without[index]
        xyz = evidence.xyz[row] - evidence.centre[row, None]
        information = evidence.information[row] * ~without[..., None, None]
        return EnergyTargets(xyz, information), np.where(without, np.inf, evidence.variance_m2[row])


def left_out_sets(energy: BodyEnergy, prior: PosePrior) -> Index:
    """Set (of `SETS`) with which each joint (J,) is left out, such that joints of a set carry
    little information about each other.

    The cost of a pair is the increase of each one's uncertainty if the other is missing too
    (`_coupling`). The sum over all pairs within sets is reduced by greedy assignment, then by
    moving and exchanging joints.
    """
    cost = _coupling(energy, prior)
    sets = np.full(len(cost), -1)
    for joint in np.argsort(-cost.sum(axis=1), kind="stable"):
        sets[joint] = np.argmin([cost[joint, sets == each].sum() for each in range(SETS)])
    while True:
        by_set = cost @ (sets[:, None] == np.arange(SETS))  # (J, S) cost of each joint in each set
        own = by_set[np.arange(len(sets)), sets]
        moved = by_set - own[:, None]
        swapped = moved[:, sets] + moved[:, sets].T - 2 * cost
        swapped[sets[:, None] == sets] = 0.0
        if min(moved.min(), swapped.min()) > -1e-9:
            return sets
        if moved.min() <= swapped.min():
            joint, to = np.unravel_index(moved.argmin(), moved.shape)
            sets[joint] = to
        else:
            one, other = np.unravel_index(swapped.argmin(), swapped.shape)
            sets[one], sets[other] = sets[other], sets[one]


def _coupling(energy: BodyEnergy, prior: PosePrior) -> Array:
    """(J, J) cost of leaving a pair of joints out together, nats.

    With P the covariance of all joints under the priors and K = (P + model_sigma² I)^-1, the joints
    A are predicted from all others with covariance K_AA^-1. Leaving b out as well increases a's
    part of it.
    """
    free = np.zeros((_POSES, energy.num_free))
    poses = prior.sample(np.random.default_rng(0), _POSES).reshape(_POSES, -1)
    free[:, 13:-3] = poses[:, energy.angles]
    count = len(energy.model.keypoint_names)
    nothing = EnergyTargets(np.zeros((_POSES, count, 3)), np.zeros((_POSES, count, 3, 3)))
    linear = energy.linearise(free, nothing, 1.0, energy.held_by_priors(_POSES))
    H, J = linear.hessian, linear.jacobian
    root = [10, 11, 12, -3, -2, -1]
    H[:, root, root] += _ROOT_INFORMATION
    covariance = J @ np.linalg.solve(H, J.swapaxes(1, 2)) + BodyConfig.model_sigma_m**2 * np.eye(
        3 * count
    )
    K = (
        np.linalg.inv(covariance).reshape(_POSES, count, 3, count, 3).swapaxes(2, 3)
    )  # (N, J, J, 3, 3)
    own = K[:, np.arange(count), np.arange(count)]
    # The Schur complement: K_aa - K_ab K_bb^-1 K_ba is a's information when b is missing too.
    less = own[:, :, None] - K @ np.linalg.solve(own[:, None], K.swapaxes(-1, -2))
    with np.errstate(divide="ignore", invalid="ignore"):
        widened = np.linalg.slogdet(own)[1][:, :, None] - np.linalg.slogdet(less)[1]
    cost = np.nan_to_num(widened, nan=0.0, posinf=0.0).mean(axis=0) / 2
    cost = cost + cost.T
    np.fill_diagonal(cost, 0.0)
    return cost
