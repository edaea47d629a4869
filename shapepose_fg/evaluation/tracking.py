"""Metrics of a reconstruction over time against ground truth: joints, identities, motion,
covariances.
"""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyParameters
from shapepose_fg.body.model.result_body import model_of
from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import (
    covariance_calibration,
    known_mean,
    match_people,
    metrics_of,
)
from shapepose_fg.evaluation.track_metrics import TrackFrame, track_metrics

WRISTS = [BODY_25.index("RWrist"), BODY_25.index("LWrist")]
UNMATCHED = np.iinfo(np.int64).min
"""Code for "no identity"; every other number may be an identity."""


def score_tracks(
    people: Reconstruction, truth: Reconstruction, fps: float, *, identities: bool = True
) -> dict[str, float | None]:
    """Compare `people` with the `truth` of a recording of `fps` frames a second (`truth_of`, or any
    result); returns figures by name, None if there is nothing to measure.

    | figure | of |
    |---|---|
    | `f1`, `precision`, `recall` | joints within 0.2 m, % |
    | `false_positives`, `people_missed` | number of people (`JointMetrics`) |
    | `idf1`, `switches` | identities (`track_metrics`), % and number |
    | `mpjpe_mm`, `acceleration_error` | mean error of joints of matched rows, mm and m/s² |
    | `fast_wrist_error_mm` | median error of wrists with a true speed above 1.5 m/s, mm |
    | `body_...` | these three for the bodies' own joints |
    | `velocity_error` | mean error of the velocities of joints, m/s |
    | `..._inside_50`, `..._log_score`, `joints_...` | covariances of a class (`CovarianceCalibration`) and number of its joints |

    Classes are `velocity`, and joints that two views or more see in that frame (`seen`), one view
    (`one_view`), none (`no_view`), and none in this frame and the nine before (`unseen`).

    The frames from the first to the last of the truth are scored. Without `identities`, the column
    `person` only numbers the people of a frame; metrics over time then use the true person with
    whom a row is matched. ValueError for an identity twice in one frame.
    """  # noqa: E501
    true, first = joints_by_frame(truth), int(truth.frame.min()) if len(truth) > 0 else 0
    frames = range(first, first + len(true))
    matches = match_people(people.frame, people.joints, true, frames)
    found, at = people.rows(matches.row), (matches.frame, matches.person)
    identity = found.person if identities else matches.person
    matched, follows = np.full(true.shape[:2], UNMATCHED), np.zeros(true.shape[:2], dtype=bool)
    matched[at] = identity
    follows[1:] = (matched[1:] != UNMATCHED) & (matched[1:] == matched[:-1])
    joints = metrics_of(matches, people.joints, true)
    figures = {name: 100 * getattr(joints, name) for name in ("f1", "precision", "recall")}
    figures |= {name: getattr(joints, name) for name in ("false_positives", "people_missed")}
    if identities:
        placed = people.rows(np.isfinite(people.joints.sum(axis=2)).any(axis=1))
        by_frame = ((truth.rows(truth.frame == frame), placed.rows(placed.frame == frame))
                    for frame in frames)  # fmt: skip
        tracks = track_metrics(TrackFrame.of(*pair) for pair in by_frame)
        figures |= {"idf1": 100 * tracks.idf1, "switches": tracks.switches}
    for prefix, given in {"": found.joints, "body_": body_joints(found)}.items():
        placed = np.full(true.shape, np.nan)
        placed[at] = given
        fast = fast_wrist_errors(placed, true, fps)
        figures |= {
            f"{prefix}mpjpe_mm": 1e3 * known_mean(np.linalg.norm(placed - true, axis=-1)),
            f"{prefix}acceleration_error": known_mean(
                acceleration_errors(placed, true, follows, fps)
            ),
            f"{prefix}fast_wrist_error_mm": 1e3 * np.median(fast) if len(fast) > 0 else np.nan,
        }
    views, error = views_used(found), found.joints - true[at]
    moving = found.velocity - velocities(true, fps)[at]
    figures["velocity_error"] = known_mean(np.linalg.norm(moving, axis=-1))
    classes = {
        "seen": views >= 2,
        "one_view": views == 1,
        "no_view": views == 0,
        "unseen": frames_unseen(views > 0, found.frame, identity) >= 10,
    }
    pairs = {name: (error[those], found.covariance[those]) for name, those in classes.items()}
    for name, pair in (pairs | {"velocity": (moving, found.velocity_covariance)}).items():
        calibration = covariance_calibration(*pair)
        figures |= {
            f"{name}_inside_{100 * level:.0f}": 100 * share
            for level, share in calibration.coverage.items()
        }
        figures |= {f"{name}_log_score": calibration.log_score}
        figures |= {f"joints_{name}": len(calibration.nees)}
    return {name: float(v) if np.isfinite(v) else None for name, v in figures.items()}


def body_joints(people: Reconstruction) -> Array:
    """(N, J, 3) joints of the fitted bodies, metres, with the detector offsets that the run
    estimated; NaN without a body.
    """
    model = model_of(people.run)
    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    return model.keypoints(BodyParameters(*columns))


def views_used(people: Reconstruction) -> Index:
    """(N, J) number of views with a detection from which the joint was solved.

    Without recorded observations a joint with a confidence counts as seen by two views.
    """
    if people.observations is None:
        return np.where(people.confidence > 0, 2, 0)
    return people.observations.used.sum(axis=-1)


def joints_by_frame(people: Reconstruction) -> Array:
    """(T, P, J, 3) joints of the P identities, in rising order, from first to last frame; NaN where
    absent.
    """
    names, number = np.unique(people.person, return_inverse=True)
    index = people.frame - people.frame.min() if len(people) > 0 else people.frame
    table = np.full((index.max(initial=-1) + 1, len(names), *people.joints.shape[1:]), np.nan)
    table[index, number] = people.joints
    return table


def acceleration_errors(placed: Array, truth: Array, follows: Mask, fps: float) -> Array:
    """(T - 2, P, J) error of second differences, m/s², of `placed` and `truth` (T, P, J, 3),
    metres.

    `follows` (T, P) marks frames that directly follow the previous row; NaN if one of the three
    frames does not.
    """
    error = placed - truth
    second = (error[2:] - 2 * error[1:-1] + error[:-2]) * fps**2
    whole = follows[1:-1] & follows[2:]
    return np.where(whole[..., None], np.linalg.norm(second, axis=-1), np.nan)


def velocities(truth: Array, fps: float) -> Array:
    """(T, P, J, 3) velocities, m/s, of `truth` (T, P, J, 3), metres: by central differences; NaN
    next to missing frames.
    """
    velocity = np.full(truth.shape, np.nan)
    velocity[1:-1] = (truth[2:] - truth[:-2]) * fps / 2
    return velocity


def fast_wrist_errors(placed: Array, truth: Array, fps: float) -> Array:
    """(M,) errors in metres of the wrists with a true speed above 1.5 m/s (central differences)."""
    true = truth[:, :, WRISTS]
    # Speed of a wrist, m/s, above which too much smoothing becomes visible.
    fast = np.linalg.norm(velocities(true, fps), axis=-1) > 1.5
    error = np.linalg.norm(placed[:, :, WRISTS] - true, axis=-1)
    return error[fast & np.isfinite(error)]


def frames_unseen(seen: Mask, frame: Whole, identity: Whole) -> NDArray:
    """(N, J) number of consecutive frames, the current one included, in which a joint of an
    identity has not been `seen` (N, J).

    The count restarts if the identity has no row in the previous frame.
    """
    order = np.lexsort((frame, identity))
    seen, frame, identity = seen[order], frame[order], identity[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (np.diff(frame) != 1) | (np.diff(identity) != 0)
    place = np.arange(len(order))[:, None]
    last = np.where(seen, place, np.where(starts[:, None], place - 1, -1))
    count = np.empty(last.shape, dtype=np.intp)
    count[order] = place - np.maximum.accumulate(last, axis=0)
    return count
