"""How good a reconstruction over time is against a known truth: joints, identities, motion, covariances."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.bodies import TWIST_JUMP, body_joints, bone_rotations, statures, twists
from shapepose_fg.evaluation.identities import IdentityMetrics, identity_metrics
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import (
    CovarianceCalibration,
    JointMetrics,
    covariance_calibration,
    metrics_of,
)
from shapepose_fg.evaluation.trajectories import (
    LONG_UNSEEN,
    Chains,
    acceleration_errors,
    fast_joint_errors,
    frames_unseen,
    velocities,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionScore:
    """How joints of matched rows move, against the truth: those of the result, or those of its bodies."""

    mpjpe_mm: float
    """Mean distance to the true joints, millimetres."""
    acceleration_error: float
    """Mean length of the difference between a joint's acceleration and the true one, m/s²."""
    fast_wrist_error_mm: float
    """Median error of the wrists whose truth is faster than 1.5 m/s, millimetres."""


@dataclass(frozen=True)
class TrackingScore:
    """What `score_tracks` found."""

    joints: JointMetrics
    """Precision, recall, F1 at 0.2 m, MPJPE, duplicates and other false positives."""
    identities: IdentityMetrics | None
    """IDF1, switches, tracks; None where `person` is no identity."""
    motion: MotionScore
    """The motion of the joints."""
    bodies: MotionScore
    """The motion of the bodies' own joints."""
    stature_spread_m: float
    """Tallest minus smallest body of an identity, metres: the largest over the identities."""
    twist_jumps: int
    """Bones of bodies that turn about their own axis by 20 degrees more from a frame to the next than in truth."""
    velocity_error: float
    """Mean length of the difference between a joint's velocity and the true one, m/s; NaN without velocities."""
    calibration: dict[str, CovarianceCalibration]
    """Covariances of `velocity`, and of the joints of matched rows that two views or more see in that frame
    (`seen`), one view (`one_view`), none (`no_view`), and none in this frame and the nine before (`unseen`)."""

    def as_dict(self) -> dict[str, Any]:
        """The figures under plain names, for tables and JSON; None where there is nothing to measure."""
        figures = {
            "f1": 100 * self.joints.f1,
            "precision": 100 * self.joints.precision,
            "recall": 100 * self.joints.recall,
            "idf1": np.nan if self.identities is None else 100 * self.identities.idf1,
            "stature_spread_cm": 100 * self.stature_spread_m,
            "velocity_error": self.velocity_error,
        }
        for prefix, motion in {"": self.motion, "body_": self.bodies}.items():
            figures |= {f"{prefix}{name}": value for name, value in vars(motion).items()}
        counts = {"false_positives": self.joints.false_positives, "people_missed": self.joints.people_missed}
        counts |= {"twist_jumps": self.twist_jumps}
        for name, calibration in self.calibration.items():
            figures |= {f"{name}_inside_{100 * level:.0f}": 100 * s for level, s in calibration.coverage.items()}
            figures[f"{name}_log_score"] = calibration.log_score
            counts[f"joints_{name}"] = len(calibration.nees)
        if self.identities is not None:
            names = ("tracks", "false_tracks", "longest_false_positive", "switches")
            counts |= {name: getattr(self.identities, name) for name in names}
        return {name: float(v) if np.isfinite(v) else None for name, v in figures.items()} | counts


def score_tracks(
    people: Reconstruction,
    truth: Reconstruction,
    fps: float,
    *,
    identities: bool = True,
    frames: Sequence[int] | range | None = None,
) -> TrackingScore:
    """Compare `people` with the `truth` of a recording of `fps` frames a second (`truth_of`, or any result).

    `frames` are the frame numbers that are scored, by default those from the truth's first to its last. Without
    `identities` the column `person` only counts the people of a frame; what asks for one and the same person then
    goes by the person of the truth with whom a row is matched. ValueError for an identity twice in one frame.
    """
    numbers = _span(truth) if frames is None else np.asarray(frames, dtype=np.int64)
    true = joints_by_frame(truth, numbers)
    matches = match_people(people.frame, people.joints, true, numbers.tolist())
    chains = Chains.of(
        matches, numbers, true.shape[1], people.person[matches.row] if identities else matches.person
    )
    found, index = people.rows(matches.row), frame_index(people.frame, numbers)
    views = views_used(found)
    error = found.joints - true[matches.frame, matches.person]
    moving = found.velocity - velocities(true, numbers, fps)[matches.frame, matches.person]
    classes = {
        "seen": views >= 2,
        "one_view": views == 1,
        "no_view": views == 0,
        "unseen": frames_unseen(views > 0, found.frame, chains.identity) >= LONG_UNSEEN,
    }
    calibration = {
        name: covariance_calibration(error[those], found.covariance[those]) for name, those in classes.items()
    }
    return TrackingScore(
        metrics_of(matches, people.joints, true),
        identity_metrics(matches, index, people.person, people.joints, true) if identities else None,
        motion=_motion(found.joints, true, chains, fps),
        bodies=_motion(body_joints(found), true, chains, fps),
        stature_spread_m=_widest(statures(found.betas), chains.identity),
        twist_jumps=_twist_jumps(found, truth, numbers, chains),
        velocity_error=_mean(np.linalg.norm(moving, axis=-1)),
        calibration=calibration | {"velocity": covariance_calibration(moving, found.velocity_covariance)},
    )


def _motion(joints: Array, truth: Array, chains: Chains, fps: float) -> MotionScore:
    """Score `joints` (M, J, 3) of the matched rows, metres, against `truth` (T, P, J, 3)."""
    placed = chains.placed(joints)
    fast = fast_joint_errors(placed, truth, chains.frames, fps)
    return MotionScore(
        mpjpe_mm=1e3 * _mean(np.linalg.norm(placed - truth, axis=-1)),
        acceleration_error=_mean(acceleration_errors(placed, truth, chains.consecutive, fps)),
        fast_wrist_error_mm=1e3 * float(np.median(fast)) if len(fast) > 0 else float("nan"),
    )


def _twist_jumps(found: Reconstruction, truth: Reconstruction, frames: NDArray[np.int64], chains: Chains) -> int:
    """Count of `TrackingScore.twist_jumps` of the matched rows `found`."""
    index, person = frame_index(truth.frame, frames), np.unique(truth.person, return_inverse=True)[1]
    rotations = np.full((*chains.consecutive.shape, 24, 3, 3), np.nan)
    rotations[index[index >= 0], person[index >= 0]] = bone_rotations(truth)[index >= 0]
    turned, true = twists(chains.placed(bone_rotations(found))), twists(rotations)
    jumps = (np.abs(turned) > TWIST_JUMP) & (np.abs(turned - true) > TWIST_JUMP)
    return int(jumps[chains.consecutive[1:]].sum())


def views_used(people: Reconstruction) -> NDArray[np.intp]:
    """(N, J) how many views' detections each joint was solved from.

    Without a record of observations a joint with a confidence counts as seen by two: nothing tells more.
    """
    if people.observations is None:
        return np.where(people.confidence > 0, 2, 0)
    return people.observations.used.sum(axis=-1)


def joints_by_frame(people: Reconstruction, frames: NDArray[np.integer]) -> Array:
    """(T, P, J, 3) joints of the P identities of `people`, in rising order, in `frames` (T,); NaN where absent."""
    names, number = np.unique(people.person, return_inverse=True)
    index = frame_index(people.frame, frames)
    table = np.full((len(frames), len(names), *people.joints.shape[1:]), np.nan)
    table[index[index >= 0], number[index >= 0]] = people.joints[index >= 0]
    return table


def frame_index(frame: NDArray[np.integer], frames: NDArray[np.integer]) -> NDArray[np.intp]:
    """(N,) place of each row's frame in `frames` (T,), which rise; -1 for one that is not among them."""
    if len(frames) == 0:
        return np.full(len(frame), -1)
    if (np.diff(frames) <= 0).any():
        raise ValueError("frames must rise: give each frame number once, smallest first")
    place = np.minimum(np.searchsorted(frames, frame), len(frames) - 1)
    return np.where(frames[place] == frame, place, -1)


def _span(truth: Reconstruction) -> NDArray[np.int64]:
    """All frame numbers from the first to the last."""
    return np.arange(truth.frame.min(), truth.frame.max() + 1) if len(truth) > 0 else np.zeros(0, dtype=np.int64)


def _widest(values: Array, identity: NDArray[np.integer]) -> float:
    """The largest over identities of largest minus smallest value; NaN where there is none."""
    known = np.isfinite(values)
    parts = [values[known & (identity == name)] for name in np.unique(identity[known])]
    return max((float(np.ptp(part)) for part in parts), default=float("nan"))


def _mean(values: Array) -> float:
    """Mean of what is known; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) > 0 else float("nan")
