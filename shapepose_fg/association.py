"""Which 2D detections are whose: proposals projected back into the views, filtered by part affinities.

Stage I (e) of the paper (section 3.1): gives each person *their* 2D observation of every joint in every view.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig
from shapepose_fg.candidates import Candidates
from shapepose_fg.detections import Detections
from shapepose_fg.observations import Observations
from shapepose_fg.proposals import Proposals, match_best_first
from shapepose_fg.skeleton import Skeleton


@dataclass(frozen=True)
class AssociationConfig:
    """When a 2D detection is an observation of a proposal's joint."""

    near_m: float = 0.08
    """How closeness to the projected joint falls off: sigma of a Gaussian, as a length at the joint's depth. A
    detector is 2 cm off on a visible joint and several on a hidden one."""
    far_m: float = 0.25
    """No detection farther than this from the projection of a joint whose place is known is taken."""
    reach_m: float = 0.6
    """A joint whose place is not known yet is sought this far around its neighbours on the skeleton: no limb
    from a joint to the next is longer, the trunk aside."""
    least_affinity: float = 0.3
    """A joint whose place is not known is only taken by an affinity of at least this to an observed neighbour."""
    overlap_px: float = 6.0
    """Two people's projected joints closer than this overlap: the one detection there serves both."""
    passes: int = 2
    """How often the choice is made again with the neighbours that the last one chose."""
    min_observed_parts: float = 0.4
    """Least fraction of the core joints (trunk, arms, legs) that two views must see. A person of whom only the
    upper body shows has 9 of 15; a phantom, born where rays of different people cross, finds that all its
    detections belong better to somebody else."""

    def __post_init__(self) -> None:
        for name in ("near_m", "far_m", "reach_m", "overlap_px", "passes"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def associate(
    proposals: Proposals,
    candidates: Candidates,
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssociationConfig,
) -> tuple[Observations, int]:
    """Give every person at most one detection per joint and view, and every detection to one person.

    A pair is scored by how near the detection is to the projected joint and by its affinities to the detections
    already chosen for the joint's neighbours in that view. A detection on which two people's joints lie serves
    both. Proposals that are left with hardly any joint seen by two views are dropped, and what they took is given
    out anew; the second value is their number.
    """
    places = np.full((len(proposals), len(skeleton), 3), np.nan)
    known = proposals.candidate >= 0
    places[known] = candidates.xyz[proposals.candidate[known]]
    owns = _by_support(proposals, candidates, len(detections))
    chosen = _choose(places, owns, detections, rig, skeleton, config)
    real = _observed_parts(chosen, skeleton) >= config.min_observed_parts
    places, chosen = places[real], chosen[real]
    for _ in range(config.passes):
        chosen = _choose(places, _owned(chosen, len(detections)), detections, rig, skeleton, config)
    seen = chosen >= 0
    observations = Observations(
        xy=np.where(seen[..., None], detections.xy[chosen] if len(detections) > 0 else 0.0, 0.0),
        confidence=np.where(seen, detections.confidence[chosen] if len(detections) > 0 else 0.0, 0.0),
        initial=places,
    )
    return observations, int((~real).sum())


def _choose(
    places: NDArray[np.float64],
    owns: NDArray[np.bool_],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssociationConfig,
) -> NDArray[np.intp]:
    """(P, J, V) detections for people whose joints are at `places` and who are thought to own `owns` (P, D)."""
    distance_m, distance_px = _distances(places, detections, rig)
    placed = np.isfinite(places[:, detections.joint, 0])
    affinity, neighbours = _affinity(owns, detections, skeleton, len(rig))
    # Where no neighbour is seen, the affinities say nothing: neither for nor against.
    spoken = np.where(neighbours > 0, affinity, config.least_affinity)
    score = np.exp(-0.5 * (distance_m / config.near_m) ** 2) + spoken
    likely = placed & (distance_m < config.far_m) & (score >= 2 * config.least_affinity)
    reachable = ~placed & _reachable(places, detections, rig, skeleton, config)
    likely |= reachable & (affinity >= config.least_affinity)
    chosen = _match(likely, score, detections, (*places.shape[:2], len(rig)))
    overlap = placed & (distance_px < config.overlap_px) & (affinity >= config.least_affinity)
    _share(chosen, overlap, distance_px, detections)
    return chosen


def _owned(chosen: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    """(P, D) whether a detection is chosen for a person."""
    owns = np.zeros((len(chosen), count), dtype=bool)
    person, _, _ = np.nonzero(chosen >= 0)
    owns[person, chosen[chosen >= 0]] = True
    return owns


def _observed_parts(chosen: NDArray[np.intp], skeleton: Skeleton) -> NDArray[np.float64]:
    """(P,) fraction of the core joints that at least two views see."""
    return ((chosen >= 0).sum(axis=2) >= 2)[:, skeleton.core].mean(axis=1)


def _by_support(proposals: Proposals, candidates: Candidates, count: int) -> NDArray[np.bool_]:
    """(P, D) whether a detection supports one of the person's candidates."""
    has = np.zeros((len(proposals), len(candidates) + 1), dtype=bool)
    np.put_along_axis(has, proposals.candidate, True, axis=1)  # -1 marks the spare last column
    person, row = np.nonzero(has[:, candidates.support[:, 0]])
    owns = np.zeros((len(proposals), count), dtype=bool)
    owns[person, candidates.support[row, 1]] = True
    return owns


def _distances(
    points_world: NDArray[np.float64], detections: Detections, rig: Rig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(P, D) distance of each detection from the projection of each person's same joint: metres at the joint's
    depth, and pixels; infinite where the joint is unknown or behind the camera.
    """
    xy, depth = rig.project(points_world)
    at = (detections.view, slice(None), detections.joint)
    offset_px = np.linalg.norm(xy[at] - detections.xy[:, None], axis=-1).T
    offset_m = offset_px * depth[at].T / rig.focal_px[detections.view]
    return np.nan_to_num(offset_m, nan=np.inf), np.nan_to_num(offset_px, nan=np.inf)


def _reachable(
    initial: NDArray[np.float64],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssociationConfig,
) -> NDArray[np.bool_]:
    """(P, D) whether a detection is within reach of a known neighbour of its joint."""
    reachable = np.zeros((len(initial), len(detections)), dtype=bool)
    for neighbour in skeleton.tree_neighbours.T:  # two or three: a joint has few neighbours
        exists = neighbour >= 0
        around = np.where(exists[:, None], initial[:, neighbour], np.nan)
        distance_m, _ = _distances(around, detections, rig)
        reachable |= distance_m < config.reach_m
    return reachable


def _affinity(
    owns: NDArray[np.bool_], detections: Detections, skeleton: Skeleton, views: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """(P, D) mean affinity of each detection to what the person owns at its limbs' other ends, and the number."""
    people, count = owns.shape
    head, tail = detections.pairs.T
    total = np.zeros((people, count))
    for end, other in ((head, tail), (tail, head)):
        person, edge = np.nonzero(owns[:, other])
        key = person * count + end[edge]
        total += np.bincount(key, detections.affinity[edge], people * count).reshape(people, count)
    sees = np.zeros((people, views, len(skeleton)), dtype=bool)
    person, detection = np.nonzero(owns)
    sees[person, detections.view[detection], detections.joint[detection]] = True
    neighbours = (sees @ skeleton.adjacency)[:, detections.view, detections.joint]
    return total / np.maximum(neighbours, 1), neighbours


def _match(
    likely: NDArray[np.bool_],
    score: NDArray[np.float64],
    detections: Detections,
    shape: tuple[int, ...],
) -> NDArray[np.intp]:
    """(P, J, V) the detections matched to people, joints and views, best score first, each serving one."""
    person, detection = np.nonzero(likely)
    slot = np.ravel_multi_index((person, detections.joint[detection], detections.view[detection]), shape)
    picked = match_best_first(slot, detection, score[person, detection])
    chosen = np.full(shape, -1, dtype=np.intp)
    chosen.reshape(-1)[slot[picked]] = detection[picked]
    return chosen


def _share(
    chosen: NDArray[np.intp],
    overlap: NDArray[np.bool_],
    distance_px: NDArray[np.float64],
    detections: Detections,
) -> None:
    """Let the detection that lies on a joint serve that joint too where the joint has none of its own."""
    person, detection = np.nonzero(overlap)
    joint, view = detections.joint[detection], detections.view[detection]
    order = np.argsort(-distance_px[person, detection], kind="stable")  # the nearest is written last
    empty = order[chosen[person, joint, view][order] < 0]
    chosen[person[empty], joint[empty], view[empty]] = detection[empty]
