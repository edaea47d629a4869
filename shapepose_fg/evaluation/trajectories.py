"""How people move against the truth: accelerations, velocities, fast joints, joints long unseen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.identities import UNMATCHED
from shapepose_fg.evaluation.matching import Matches

Array = NDArray[np.float64]

WRISTS = (BODY_25.index("RWrist"), BODY_25.index("LWrist"))
FAST_M_S = 1.5
"""A wrist faster than this is where a smoother that is too stiff shows, metres a second."""
LONG_UNSEEN = 10
"""A joint is long unseen when no view has seen it in this frame and the nine before it."""


@dataclass(frozen=True)
class Chains:
    """The M matched rows in the order of the truth: person by person, frame after frame."""

    matches: Matches
    """Which rows are whom, when."""
    frames: NDArray[np.int64]
    """(T,) frame numbers of the truth."""
    identity: NDArray[np.int64]
    """(M,) what makes two rows one and the same: their identity, or the true person where there are none."""
    consecutive: NDArray[np.bool_]
    """(T, P) whether a row follows one of the frame number before, and both are of one identity."""

    @classmethod
    def of(
        cls, matches: Matches, frames: NDArray[np.int64], people: int, identity: NDArray[np.integer]
    ) -> "Chains":
        """From the matches, the truth's frame numbers (T,), its people, the `identity` (M,) of matched rows."""
        who = np.full((len(frames), people), UNMATCHED)
        who[matches.frame, matches.person] = identity
        follows = np.zeros(who.shape, dtype=bool)
        follows[1:] = (who[1:] != UNMATCHED) & (who[1:] == who[:-1]) & (np.diff(frames) == 1)[:, None]
        return cls(matches, frames, identity.astype(np.int64), follows)

    def placed(self, values: Array) -> Array:
        """(T, P, ...) `values` (M, ...) of the matched rows; NaN where there is none."""
        table = np.full((*self.consecutive.shape, *values.shape[1:]), np.nan)
        table[self.matches.frame, self.matches.person] = values
        return table


def acceleration_errors(placed: Array, truth: Array, consecutive: NDArray[np.bool_], fps: float) -> Array:
    """(T - 2, P, J) length of the difference of accelerations, m/s²: of `placed` and `truth` (T, P, J, 3), metres.

    The acceleration is the second difference over three consecutive frames; NaN where one of them is missing.
    """
    error = placed - truth
    second = (error[2:] - 2 * error[1:-1] + error[:-2]) * fps**2
    whole = consecutive[1:-1] & consecutive[2:]
    return np.where(whole[..., None], np.linalg.norm(second, axis=-1), np.nan)


def velocities(truth: Array, frames: NDArray[np.integer], fps: float) -> Array:
    """(T, P, J, 3) velocities in m/s of `truth` (T, P, J, 3), metres: half the difference over two frames.

    NaN in the first and last frame, and beside a frame that is missing.
    """
    velocity = np.full(truth.shape, np.nan)
    whole = (frames[2:] - frames[:-2] == 2)[:, None, None, None]
    velocity[1:-1] = np.where(whole, (truth[2:] - truth[:-2]) * fps / 2, np.nan)
    return velocity


def fast_joint_errors(
    placed: Array, truth: Array, frames: NDArray[np.integer], fps: float, joints: tuple[int, ...] = WRISTS
) -> Array:
    """(M,) errors in metres of those `joints` whose truth is faster than 1.5 m/s (difference over two frames)."""
    true = truth[:, :, list(joints)]
    fast = np.linalg.norm(velocities(true, frames, fps), axis=-1) > FAST_M_S
    error = np.linalg.norm(placed[:, :, list(joints)] - true, axis=-1)
    return error[fast & np.isfinite(error)]


def frames_unseen(seen: NDArray[np.bool_], frame: NDArray[np.integer], identity: NDArray[np.integer]) -> NDArray:
    """(N, J) for how many frames, up to this one and with it, a joint of an identity has not been `seen` (N, J).

    The count begins anew where the identity has no row in the frame before.
    """
    order = np.lexsort((frame, identity))
    seen, frame, identity = seen[order], frame[order], identity[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (np.diff(frame) != 1) | (np.diff(identity) != 0)
    place = np.arange(len(order))[:, None]
    last = np.where(seen, place, np.where(starts[:, None], place - 1, -1))
    count = place - np.maximum.accumulate(last, axis=0)
    back = np.empty_like(count)
    back[order] = count
    return back
