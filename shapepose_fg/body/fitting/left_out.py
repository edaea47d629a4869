"""Leave-one-out: which targets are taken out together, and the fits that do not see them.

A fit without a set is held by the priors, not by where the network arrived, which had seen the set. It starts
from the fit with all targets, whose factor serves for it, too: taking a few targets out changes a Hessian by
little. Where a further step would still move some joint by half of its standard deviation, it is linearised
anew, to the optimum.
"""

from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.energy import SETTLED, BodyEnergy, Evaluated, Held, WhitenedTargets, robust_weight
from shapepose_fg.body.fitting.evidence import Evidence, determine_pose
from shapepose_fg.body.fitting.fitter import BodyConfig
from shapepose_fg.body.fitting.optimisers import LevenbergMarquardt
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.kernels.solving import lessened, stepped
from shapepose_fg.core.arrays import Array, Index, Mask

SETS = 6
"""So many sets: more cost more fits, and leave fewer joints out at a time."""
_POSES = 8
"""Poses of the prior at which the coupling of joints is linearised."""
_ROOT_INFORMATION = 1e-2
"""Of the root's rotation and place in that linearisation, 1/rad² and 1/m²: next to nothing."""
NEAR = 0.5
"""A fit without a set is linearised anew where another step would still move a joint of the set by more, in
standard deviations. On Shelf that is one in five; the others are 0.08 from the optimum (median), 0.28 (95 %)."""

_SETTLED = 0.1
"""That is done when a step lowers its energy by less: no joint moves by a third of its standard deviation."""


@dataclass(frozen=True)
class Pairs:
    """N fits, each to the targets of a row but some."""

    row: Index
    """(N,) whose."""
    group: Index
    """(N,) the set that they are of."""
    without: Index
    """(N, M) joints that are left out, then -1."""
    together: Mask
    """(N,) whether these are all of the set: what is left determines the pose."""
    betas: Array
    """(N, 10) around which shape the fit is held: 0 is the prior's."""
    stiffness: Array
    """(N,) precision of each beta: 1 is the prior's."""

    @classmethod
    def of(cls, evidence: Evidence, sets: Index, groups: Index) -> "Pairs":
        """One for each row (R) and set of joints (J,).

        A set without a target in any row of a group (R,) needs none. Where what is left would not determine the
        pose, the joints of the set are left out one by one.
        """
        seen, full = evidence.root.any(axis=(2, 3)), np.isfinite(evidence.variance_m2)
        member = sets == np.arange(sets.max() + 1)[:, None]  # (S, J)
        _, group = np.unique(groups, return_inverse=True)
        asked = np.zeros((group.max() + 1, len(member)), dtype=bool)
        np.logical_or.at(asked, group, seen @ member.T)
        determined = determine_pose(evidence.xyz[:, None], full[:, None] & ~member)  # (R, S)
        together, singly = (
            np.argwhere(asked[group] & determined),
            np.argwhere((asked[group] & ~determined)[:, sets]),
        )
        joints = np.full((len(member), member.sum(axis=1).max()), -1)
        for number, one in enumerate(member):
            joints[number, : one.sum()] = np.flatnonzero(one)
        alone = np.full((len(singly), joints.shape[1]), -1)
        alone[:, 0] = singly[:, 1]
        return cls(
            np.concatenate([together[:, 0], singly[:, 0]]),
            np.concatenate([together[:, 1], sets[singly[:, 1]]]),
            np.concatenate([joints[together[:, 1]], alone]),
            np.arange(len(together) + len(singly)) < len(together),
            np.zeros((len(together) + len(singly), 10)),
            np.ones(len(together) + len(singly)),
        )

    def part(self, chosen: Index | Mask) -> "Pairs":
        """Some of them."""
        return Pairs(*(value[chosen] for value in vars(self).values()))

    def at_shape(self, group: int, betas: Array, settled: Mask) -> "Pairs":
        """The same, those of a set next to immovable at shapes `betas` (R, 10) where these are `settled` (R,)."""
        mine = (self.group == group) & settled[self.row]
        held = np.where(mine[:, None], betas[self.row], self.betas)
        return replace(self, betas=held, stiffness=np.where(mine, SETTLED, self.stiffness))

    def of_rows(self, rows: Index) -> "Pairs":
        """Those of some rows (K,), which are numbered from 0 then."""
        place = np.full(max(self.row.max(initial=0), rows.max(initial=0)) + 1, -1)
        place[rows] = np.arange(len(rows))
        chosen = self.part(place[self.row] >= 0)
        return replace(chosen, row=place[chosen.row])


@dataclass(frozen=True)
class Without:
    """What N pairs say."""

    xyz: Array
    """(N, M, 3) the joints that were left out, metres."""
    covariance: Array
    """(N, M, 3, 3) of these (Laplace), m²."""
    betas: Array
    """(N, 10) shape."""
    betas_covariance: Array
    """(N, 10, 10) of it."""


def fitted_without(
    energy: BodyEnergy,
    body: Evaluated,
    targets: WhitenedTargets,
    scale: float,
    pairs: Pairs,
    plain: LevenbergMarquardt,
) -> Without:
    """Fit the `pairs` (N) of rows (B) whose fits with all `targets` are `body`, linearised where they are, and
    reduced (`Evaluated.covariances`). `plain` fits those that are far.
    """
    (N, M), P, place = pairs.without.shape, energy.num_free, np.arange(len(pairs.row))[:, None]
    held = Held(pairs.betas, pairs.stiffness, np.tile(energy.priors.mean, (N, 1)))
    root, free = targets.root[pairs.row], body.free[pairs.row]
    out = np.zeros((N, M, 3, 3))
    known = pairs.without >= 0
    weight = np.sqrt(robust_weight(body.squared, scale))[pairs.row[:, None], pairs.without]
    out[known] = (weight[..., None, None] * root[place, pairs.without])[known]
    root[np.nonzero(known)[0], pairs.without[known]] = 0.0
    given, xyz = WhitenedTargets(targets.xyz[pairs.row], root), np.zeros((N, *body.xyz.shape[1:]))
    Y, B, C = np.empty((N, 6 * M + 10, P)), np.empty((N, 6 * M + 11, 3 * M)), np.empty((N, 3 * M + 10, 3 * M + 10))
    good = np.zeros(N, dtype=bool)
    lessened(body.system, pairs.row, pairs.without, out, Y, B, C, good)
    covariance = np.stack([C[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(M)], axis=1)
    sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 3)
    going, step, move = np.flatnonzero(good), np.zeros((N, P)), np.zeros((N, 3 * M))
    row, before, better = pairs.row[going], np.full(N, np.inf), np.ones(len(going), dtype=bool)
    for _ in range(2):  # the second time only to see how far that was
        free[going] = energy.retract(free[going], step[going])
        slope = energy.linearise(free[going], given.rows(going), scale, held.rows(going), slope_only=True)
        better, before[going] = np.asarray(slope.energy < before[going]), slope.energy
        stepped(body.system, row, going, Y, B, slope.gradient, step, move)
    xyz[going] = slope.xyz
    free[going[~better]] = body.free[row[~better]]
    good[going] = better
    close = np.linalg.norm(move.reshape(N, M, 3), axis=2) < NEAR * sigma  # NaN is not
    shape, far = C[:, -10:, -10:], np.flatnonzero(~(good & (close | ~known).all(axis=1)))
    if len(far) > 0:
        anew = plain.again(free[far], given.rows(far), held.rows(far), _SETTLED)
        free[far], xyz[far] = anew.free, anew.xyz
        joints, shape[far] = anew.covariances()
        covariance[far] = joints[np.arange(len(far))[:, None], pairs.without[far]]
    return Without(xyz[place, pairs.without], covariance, free[:, :10], shape)


def left_out_sets(energy: BodyEnergy, prior: PosePrior) -> Index:
    """Which of `SETS` sets each joint (J,) is left out with: joints that tell little of each other.

    The cost of a pair is how much less certain each of the two is when the other is missing too (`_coupling`); the
    sum over all pairs in one set is made small by placing joint by joint, then moving and exchanging them.
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
    """(J, J) how much a pair of joints costs that are left out together, nats.

    With P the covariance of all joints under the priors and K = (P + model_sigma² I)^-1, the joints A are
    predicted from all others with the covariance K_AA^-1. Leaving b out with a widens a's part of it.
    """
    free = np.zeros((_POSES, energy.num_free))
    poses = prior.sample(np.random.default_rng(0), _POSES).reshape(_POSES, -1)
    free[:, 13:-3] = poses[:, energy.angles]
    count = len(energy.model.keypoint_names)
    nothing = WhitenedTargets(np.zeros((_POSES, count, 3)), np.zeros((_POSES, count, 3, 3)))
    linear = energy.linearise(free, nothing, 1.0, energy.held_by_priors(_POSES))
    H, J = linear.hessian, linear.jacobian
    root = [10, 11, 12, -3, -2, -1]
    H[:, root, root] += _ROOT_INFORMATION
    covariance = J @ np.linalg.solve(H, J.swapaxes(1, 2)) + BodyConfig.model_sigma_m**2 * np.eye(3 * count)
    K = np.linalg.inv(covariance).reshape(_POSES, count, 3, count, 3).swapaxes(2, 3)  # (N, J, J, 3, 3)
    own = K[:, np.arange(count), np.arange(count)]
    # The Schur complement: K_aa - K_ab K_bb^-1 K_ba is a's information when b is missing too.
    less = own[:, :, None] - K @ np.linalg.solve(own[:, None], K.swapaxes(-1, -2))
    with np.errstate(divide="ignore", invalid="ignore"):
        widened = np.linalg.slogdet(own)[1][:, :, None] - np.linalg.slogdet(less)[1]
    cost = np.nan_to_num(widened, nan=0.0, posinf=0.0).mean(axis=0) / 2
    cost = cost + cost.T
    np.fill_diagonal(cost, 0.0)
    return cost
