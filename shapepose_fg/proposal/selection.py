"""Who is there: hypotheses chosen by evidence, each detection explained once."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.proposal.association import owned
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.evidence import Evidence
from shapepose_fg.proposal.hypotheses import Array, Frame, Hypotheses, settled
from shapepose_fg.proposal.pairs_of_people import pooled

_ROUNDS = 8
"""How often people are sought at most, among what those who were found leave: 2D people are put together anew."""
_PASSES = 2
"""How often detections are given out around the joints of those who were chosen."""
_SHARED = 0.2
"""Of its joints, those that a missing part of somebody has in common with that person at most."""
_SCALE = 0.27
"""Evidence to log-odds: logistic fit to 1561 hypotheses on simulated crowds (two to six cameras); 1240 on the real
operating room of MVOR gave 0.23."""
_PRIOR = -1.75
"""Log-odds of a hypothesis without evidence; the same fit (-1.2 in the operating room)."""
PRIOR_WITH_BODY = -0.3
"""The same for one whose joints a body could be fitted to, and whose detections were given out again."""


def probability(score: Array, prior: float = _PRIOR) -> Array:
    """How probable it is that people of so much evidence (H,) are there."""
    return 1 / (1 + np.exp(-(_SCALE * score + prior)))


def choose(points: PairPoints, frame: Frame, least: float) -> tuple[Hypotheses, Array]:
    """The people of a frame who are there with a probability of at least `least`, and these probabilities (P,)."""
    people, sure = Hypotheses.none(frame), np.zeros(0)
    for _ in range(_ROUNDS):
        taken = np.asarray(owned(people.chosen, len(frame.detections)).any(axis=0))
        pool = pooled(points, ~taken, frame)
        more = _greedy(pool, people, taken, frame, least)
        if more is None:
            break
        people, sure = _given_out(more, frame, least)
    return people, sure


def _greedy(
    pool: Hypotheses, people: Hypotheses, taken: NDArray[np.bool_], frame: Frame, least: float
) -> Hypotheses | None:
    """`people`, who have the detections `taken` (D,), and who else of the pool is there, the surest first.

    Who can be a missing part of somebody becomes that. None where nobody is there besides.
    """
    evidence, taken, before = Evidence.of(pool, frame), taken.copy(), people
    open_ = np.ones(len(pool), dtype=bool)
    while open_.any():  # once a person or part
        score = np.where(open_, evidence.score(taken), -np.inf)
        best = np.array([score.argmax()])
        if probability(score[best])[0] < least:
            break
        open_[best] = False
        new = pool.rows(best)
        taken[new.chosen[new.chosen >= 0]] = True
        whole = _whole(new.places[0], people.places, frame)
        people = people.with_more(new) if whole is None else people.completed(whole, new)
    return None if people is before else people


def _given_out(people: Hypotheses, frame: Frame, least: float) -> tuple[Hypotheses, Array]:
    """The people with each detection given to one of them; who has too little goes, the least sure first."""
    while True:
        people = settled(
            people.places, owned(people.chosen, len(frame.detections)), frame, _PASSES, exclusive=True
        )
        sure = existence(people, frame)
        if len(people) == 0 or sure.min() >= least:
            return people, sure
        people = people.rows(np.arange(len(people)) != sure.argmin())


def existence(people: Hypotheses, frame: Frame, prior: float = _PRIOR) -> Array:
    """(P,) how probable each of the people is, where what two explain is nobody's own."""
    owners = np.bincount(people.chosen[people.chosen >= 0], minlength=len(frame.detections))
    return probability(Evidence.of(people, frame).score(owners > 1), prior)


def _whole(places: Array, people: Array, frame: Frame) -> int | None:
    """Which of `people` (P, J, 3) has `places` (J, 3) as a missing part, legs of a trunk, say; None for nobody.

    They have hardly a joint in common, and bones would connect them. Two real people have both.
    """
    has, of = np.isfinite(places[:, 0]), np.isfinite(people[..., 0])
    pairs, most = frame.spans
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    reach = np.linalg.norm(places[one] - people[:, other], axis=-1) / np.tile(most, 2)
    nearest = np.nan_to_num(reach, nan=np.inf).min(axis=1, initial=np.inf)
    nearest[(of & has).sum(axis=1) > _SHARED * has.sum()] = np.inf
    return int(nearest.argmin()) if (nearest < 1).any() else None
