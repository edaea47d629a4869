"""How good a reconstruction of the Shelf recording is: PCP@0.5, MPJPE and recall against its annotation.

No precision: not everyone in view is annotated, so a prediction without an annotation may well be right.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.other_results.skeleton_text import SHELF_JOINTS
from shapepose_fg.evaluation.shelf_ground_truth import (
    ShelfGroundTruth,
    read_shelf_ground_truth,
    shelf_joints,
)

__all__ = ["ShelfGroundTruth", "ShelfScore", "evaluate_shelf", "read_shelf_ground_truth", "shelf_joints"]

LIMBS = ((9, 10), (8, 7), (10, 11), (7, 6), (3, 4), (2, 1), (4, 5), (1, 0), (12, 13), (12, 14))
"""The 10 scored limbs, as pairs of `SHELF_JOINTS`."""
LIMB_NAMES = (
    "left upper arm",
    "right upper arm",
    "left lower arm",
    "right lower arm",
    "left upper leg",
    "right upper leg",
    "left lower leg",
    "right lower leg",
    "head",
    "torso",
)
ACTORS = (0, 1, 2)
"""The scored ids of the annotation: actors 1, 2 and 3."""

MISSING_JOINT_M = 0.5
"""What a missing joint counts in the choice of a prediction, metres."""
RECALL_M = 0.2
"""A joint is recalled when it is at most this far from the annotated one, metres."""

_A, _B = np.array(LIMBS).T


@dataclass(frozen=True)
class ShelfScore:
    """What `evaluate_shelf` found."""

    limbs_right: NDArray[np.int64]
    """(3, 10) limbs that are right, by actor and limb."""
    limbs_all: NDArray[np.int64]
    """(3, 10) limbs that are annotated, by actor and limb."""
    mpjpe_mm: float
    """Mean distance of the joints of people who were found (mean joint distance under 0.5 m), millimetres."""
    recall: float
    """Share of the actors' annotated joints with a prediction within 0.2 m."""
    people_found: int
    """Annotated people with a prediction whose mean joint distance is under 0.5 m."""
    people: int
    """Annotated people who were scored: the actors, in the scored frames."""
    frames: int
    """Frames that were scored: annotated, and reconstructed."""
    frames_annotated: int
    """Frames with an annotated actor."""

    @property
    def pcp(self) -> NDArray[np.float64]:
        """(3,) percentage of right limbs of each actor; NaN for one who is not in the scored frames."""
        return _percent(self.limbs_right.sum(axis=1), self.limbs_all.sum(axis=1))

    @property
    def pcp_average(self) -> float:
        """Mean of the actors' PCP, per cent: the figure that papers call Avg."""
        scored = self.pcp[np.isfinite(self.pcp)]
        return float(scored.mean()) if len(scored) else float("nan")

    @property
    def pcp_pooled(self) -> float:
        """Right limbs of all limbs whoever they belong to, per cent."""
        return float(_percent(self.limbs_right.sum(), self.limbs_all.sum()))

    def as_dict(self) -> dict[str, Any]:
        """The figures under plain names, for JSON; None where there is nothing to score."""
        by_limb = _percent(self.limbs_right, self.limbs_all)
        return {
            "pcp_average": _plain(self.pcp_average),
            "pcp_actor": {f"actor {a + 1}": _plain(self.pcp[a]) for a in ACTORS},
            "pcp_limb": {
                f"actor {a + 1}": {name: _plain(by_limb[a, i]) for i, name in enumerate(LIMB_NAMES)}
                for a in ACTORS
            },
            "limbs_right": int(self.limbs_right.sum()),
            "limbs": int(self.limbs_all.sum()),
            "mpjpe_mm": _plain(self.mpjpe_mm),
            "recall_at_200mm": _plain(100 * self.recall),
            "people_found": self.people_found,
            "people": self.people,
            "frames": self.frames,
            "frames_annotated": self.frames_annotated,
        }

    def table(self) -> Table:
        """PCP by limb and actor, for a terminal."""
        table = Table(title=f"Shelf, {self.frames} of {self.frames_annotated} annotated frames: PCP@0.5, %")
        table.add_column("limb")
        for actor in ACTORS:
            table.add_column(f"actor {actor + 1}", justify="right")
        table.add_column("pooled", justify="right")
        table.add_column("right / all", justify="right")
        by_actor = _percent(self.limbs_right, self.limbs_all)
        right, count = self.limbs_right.sum(axis=0), self.limbs_all.sum(axis=0)
        for i, name in enumerate(LIMB_NAMES):
            cells = [*by_actor[:, i], float(_percent(right[i], count[i]))]
            table.add_row(name, *map(_cell, cells), f"{right[i]} / {count[i]}")
        table.add_section()
        totals = f"{right.sum()} / {count.sum()}"
        table.add_row("all limbs", *map(_cell, [*self.pcp, self.pcp_pooled]), totals, style="bold")
        table.caption = (
            f"Avg {_cell(self.pcp_average)} %   MPJPE {_cell(self.mpjpe_mm)} mm\n"
            f"recall at 0.2 m {100 * self.recall:.2f} %   people found {self.people_found} / {self.people}"
        )
        return table


def evaluate_shelf(
    people: People, ground_truth: ShelfGroundTruth, frames: Iterable[int] | None = None
) -> ShelfScore:
    """Score `people` against the annotated actors, in `frames` or in all annotated frames.

    Each annotated person takes the prediction of its frame with the smallest mean joint distance; two may take
    the same one; a missing joint counts 0.5 m in that choice and makes its limbs wrong. A limb is right when
    the mean error of its two ends is at most half its annotated length. Without `frames`, a reconstruction
    whose run says which frames it covered (`run["frames"]`, [start, stop] or several) is scored on those.
    InputError if no annotated frame is left to score.
    """
    matched = match_actors(people, ground_truth, frames)
    member = matched.actor[:, None] == np.array(ACTORS)
    known = np.isfinite(matched.distance) & matched.found[:, None]
    return ShelfScore(
        limbs_right=member.T.astype(np.int64) @ matched.limbs_right,
        limbs_all=np.repeat(member.sum(axis=0)[:, None], len(LIMBS), axis=1),
        mpjpe_mm=1e3 * float(matched.distance[known].mean()) if known.any() else float("nan"),
        recall=float((matched.distance <= RECALL_M).mean()),
        people_found=int(matched.found.sum()),
        people=len(matched.frame),
        frames=len(np.unique(matched.frame)),
        frames_annotated=len(np.unique(ground_truth.frame[np.isin(ground_truth.actor, ACTORS)])),
    )


@dataclass(frozen=True)
class MatchedActors:
    """The G annotated actors of the scored frames, and what each of them takes."""

    frame: NDArray[np.int64]
    """(G,) frame."""
    actor: NDArray[np.int64]
    """(G,) one of `ACTORS`."""
    row: NDArray[np.intp]
    """(G,) row of the people that is taken; -1 where the frame has none."""
    distance: NDArray[np.float64]
    """(G, 15) distance of its joints to the annotated ones, metres; NaN where it lacks one."""
    limbs_right: NDArray[np.bool_]
    """(G, 10) PCP@0.5 of `LIMBS`."""

    @property
    def found(self) -> NDArray[np.bool_]:
        """(G,) whether the mean joint distance is under 0.5 m."""
        distance = np.where(np.isfinite(self.distance), self.distance, MISSING_JOINT_M)
        return distance.mean(axis=1) < MISSING_JOINT_M


def match_actors(
    people: People, ground_truth: ShelfGroundTruth, frames: Iterable[int] | None = None
) -> MatchedActors:
    """What each annotated actor takes of `people`, by the rules of `evaluate_shelf`; it raises the same errors."""
    actor = np.isin(ground_truth.actor, ACTORS)
    scored = actor & _covered(ground_truth.frame, _frames_run(people) if frames is None else frames)
    if not scored.any():
        raise InputError(
            "none of the reconstructed frames is annotated; reconstruct frames that the ground truth covers: "
            f"{_spans(np.unique(ground_truth.frame[actor]))}"
        )
    truth, frame = ground_truth.joints[scored], ground_truth.frame[scored]
    row, chosen = _choose(truth, frame, people)
    distance = np.linalg.norm(chosen - truth, axis=2)
    return MatchedActors(frame, ground_truth.actor[scored], row, distance, _limbs_right(distance, truth))


def _choose(
    truth: NDArray[np.float64], frame: NDArray[np.int64], people: People
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Row (G,) and joints (G, 15, 3) that each annotated person takes; -1 and NaN where its frame has none."""
    joints = _shelf15(people)
    person, row = np.nonzero(frame[:, None] == np.asarray(people.frame)[None, :])
    distance = np.linalg.norm(joints[row] - truth[person], axis=2)
    cost = np.where(np.isfinite(distance), distance, MISSING_JOINT_M).mean(axis=1)
    order = np.lexsort((cost, person))
    first, where = np.unique(person[order], return_index=True)
    taken, chosen = np.full(len(truth), -1), np.full_like(truth, np.nan)
    taken[first] = row[order[where]]
    chosen[first] = joints[taken[first]]
    return taken, chosen


def _shelf15(people: People) -> NDArray[np.float64]:
    """The joints (N, 15, 3) of `people`, who have BODY_25's or Shelf's own; InputError for any others."""
    names, joints = (
        tuple(getattr(people, "joint_names", BODY_25.joints)),
        np.asarray(people.joints, dtype=np.float64),
    )
    if names == SHELF_JOINTS:
        return joints
    if names != BODY_25.joints:
        raise InputError("the people's joints are not those of BODY_25, which this protocol maps to Shelf's 15")
    return shelf_joints(joints)


def _limbs_right(distance: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(G, 10) which limbs are right: PCP@0.5. A missing end (NaN) makes the comparison false."""
    length = np.linalg.norm(truth[:, _A] - truth[:, _B], axis=2)
    return (distance[:, _A] + distance[:, _B]) / 2 <= 0.5 * length


def _frames_run(people: People) -> Iterable[int] | None:
    """The frames that the reconstruction says it covered, if it says so."""
    try:
        spans = covered_frames(getattr(people, "run", None) or {})
    except ValueError as error:
        raise InputError(f"run.json: {error}; restore the file") from None
    return None if spans is None else [frame for span in spans for frame in span]


def _covered(frame: NDArray[np.int64], frames: Iterable[int] | None) -> NDArray[np.bool_]:
    if frames is None:
        return np.ones(len(frame), dtype=bool)
    return np.isin(frame, np.fromiter(frames, dtype=np.int64))


def _spans(frames: NDArray[np.int64]) -> str:
    """Frames as people write them: "0-100, 216-230"."""
    if len(frames) == 0:
        return "none"
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def _percent(part: Any, whole: Any) -> NDArray[np.float64]:
    """100 part / whole, NaN where there is nothing."""
    whole = np.asarray(whole, dtype=np.float64)
    return 100 * np.asarray(part) / np.where(whole > 0, whole, np.nan)


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _cell(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "-"
