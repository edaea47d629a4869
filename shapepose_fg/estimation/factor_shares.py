"""Information about a joint from user factors."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors import split_key
from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.user_factors import PersonWindow, UserFactor


@dataclass(frozen=True)
class FactorEvidence:
    """Information about a joint from one user factor."""

    name: str
    """Name of the function that created the factor."""
    others: tuple[tuple[int, int, int], ...]
    """Joints to which the factor connects this joint: person, joint and frame of each."""
    information: Array
    """(3, 3) information on the joint's position, 1/m², given the covariance of the factor's other
    variables without this factor."""


def factor_evidence(window: PersonWindow, t: int, joint: int) -> list[FactorEvidence]:
    """Information on the position of a joint in row `t` of a solved window, from the user factors
    on it.

    The other variables of a factor are marginalised out with their covariance in the graph without
    user factors on this joint and frame. Factors in other frames contribute by motion.
    """
    key, ties = int(window.keys[t, joint]), window.ties
    own_factors = [factor for factor in ties.active if key in factor.keys]
    if len(own_factors) == 0 or window.failure:
        return []
    first = window.graph.size() - len(ties.active)  # user factors are last
    without = {first + n for n, factor in enumerate(ties.active) if key in factor.keys}
    rest = gtsam.NonlinearFactorGraph()
    for n in range(window.graph.size()):
        if n not in without:
            rest.push_back(window.graph.at(n))
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 100.0)  # for joints determined by these factors only
    for other in {other for factor in own_factors for other in factor.keys}:
        if window.ties.start.exists(other):
            continue
        rest.push_back(gtsam.PriorFactorPoint3(other, window.values.atPoint3(other), wide))
    try:
        marginals = gtsam.Marginals(rest, window.values)
        return [_evidence(factor, key, window, marginals) for factor in own_factors]
    except RuntimeError:  # a user variable is otherwise undetermined
        return []


def _evidence(
    factor: UserFactor, key: int, window: PersonWindow, marginals: gtsam.Marginals
) -> FactorEvidence:
    linear = factor.factor.linearize(window.values)
    keys = list(linear.keys())
    sizes = [len(marginals.marginalCovariance(each)) for each in keys]
    ends = np.cumsum([0, *sizes])
    at = {each: np.arange(ends[n], ends[n + 1]) for n, each in enumerate(keys)}
    H = np.asarray(linear.information())
    own, others = at[key], [each for each in keys if each != key]
    information = H[np.ix_(own, own)]
    if len(others) > 0:
        rest = np.concatenate([at[each] for each in others])
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector(others))
        covariance = np.block([[joint.at(a, b) for b in others] for a in others])
        across = H[np.ix_(own, rest)]
        # H_jj - H_jo (H_oo + C^-1)^-1 H_oj, for a covariance C of any rank.
        known = covariance @ np.linalg.inv(np.eye(len(rest)) + H[np.ix_(rest, rest)] @ covariance)
        information = information - across @ known @ across.T
    people = {each.track for each in window.ties.people}
    named = [split_key(each) for each in others if not window.ties.start.exists(each)]
    tied = tuple((each.person, each.joint, each.frame) for each in named if each.person in people)
    return FactorEvidence(factor.name, tied, (information + information.T) / 2)
