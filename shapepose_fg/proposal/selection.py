"""Who is there: hypotheses chosen by evidence, each detection explained once."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.proposal.association import owned
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.evidence import Evidence
from shapepose_fg.proposal.hypotheses import Array, Frame, Hypotheses, settled
from shapepose_fg.proposal.pairs_of_people import pooled

_ROUNDS = 3
"""How often people are sought among what those who were found leave: 2D people are put together anew there."""
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
        taken = owned(people.chosen, len(frame.detections)).any(axis=0)
        new = _greedy(pooled(points, ~taken, frame), people, taken, frame, least)
        if len(new) == 0:
            break
        people, sure = _given_out(people.with_more(new), frame, least)
    return people, sure


def _greedy(
    pool: Hypotheses, people: Hypotheses, taken: NDArray[np.bool_], frame: Frame, least: float
) -> Hypotheses:
    """Those of the pool who are there besides `people`, who have the detections `taken` (D,): the surest first."""
    evidence, taken = Evidence.of(pool, frame), taken.copy()
    open_ = ~_parts(pool.places, people.places, frame)
    kept = list[int]()
    while open_.any():  # once a person
        score = np.where(open_, evidence.score(taken), -np.inf)
        best = int(score.argmax())
        if probability(score[best : best + 1])[0] < least:
            break
        kept.append(best)
        taken[pool.chosen[best][pool.chosen[best] >= 0]] = True
        open_ &= ~_parts(pool.places, pool.places[[best]], frame)
        open_[best] = False
    return pool.rows(np.array(kept, dtype=np.intp))


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


def _parts(places: Array, people: Array, frame: Frame) -> NDArray[np.bool_]:
    """(H,) whether `places` (H, J, 3) can be a missing part of one of `people` (P, J, 3): legs of a trunk, say.

    They have hardly a joint in common, and bones would connect them. Two real people have both.
    """
    has, of = (np.isfinite(each[..., 0]) for each in (places, people))
    shared = has.astype(np.intp) @ of.T.astype(np.intp)
    pairs, most = frame.spans
    near = np.zeros(shared.shape, dtype=bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        near |= (np.linalg.norm(places[:, None, one] - people[None, :, other], axis=-1) < most).any(axis=-1)
    return (near & (shared <= _SHARED * has.sum(axis=1)[:, None])).any(axis=1)
