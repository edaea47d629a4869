"""Combines the views of asynchronous cameras into frames as they come."""

from dataclasses import dataclass, field, replace

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.live.cameras import SILENT_S
from shapepose_fg.live.clock import JUMP_S

SHORTEST_S = 1 / 250
"""Shortest time between a camera's pictures, s; closer ones are duplicates of one picture."""
MOST_S = 1e12
"""Largest time, s: beyond it the resolution of doubles is too coarse."""

Frame = tuple[Detections, Array]
"""Detections of all cameras, and their times (V,)."""


@dataclass
class ViewsInStep:
    """Views that wait for the others of their frame."""

    views: int
    """V, the number of views."""
    waiting: dict[int, tuple[Detections, float]] = field(default_factory=dict)
    """By view: its detections, and their time."""
    heard_s: Array = field(default_factory=lambda: np.zeros(0))
    """(V,) time of the last view of each camera."""
    done_s: float = -np.inf
    """Time of the last complete frame, s."""
    # Assumed time between a camera's pictures until two have come, s.
    period_s: float = 1 / 30
    """Approximate time between pictures of a camera, s."""

    def __post_init__(self) -> None:
        if len(self.heard_s) == 0:
            self.heard_s = np.full(self.views, -np.inf)

    def is_late(self, view: int, time_s: float) -> bool:
        """Whether the view belongs to a frame that is complete already, or repeats the camera's
        last view.
        """
        step_s = min(self.period_s, max(time_s - float(self.heard_s[view]), SHORTEST_S))
        return time_s <= max(self.heard_s[view], self.done_s + step_s / 2)

    def heard(self, view: int, time_s: float) -> None:
        """Record the time of a view, also of a late one."""
        self.heard_s[view] = max(self.heard_s[view], time_s)

    def add(self, view: int, detections: Detections, time_s: float) -> list[Frame]:
        """Add a view; returns the frames that are complete with it."""
        found = self.rest() if view in self.waiting else []
        step_s = time_s - float(self.heard_s[view])
        if np.isfinite(step_s):
            # Weight of a camera's last step in the running mean of its period.
            self.period_s += 0.05 * (
                min(max(step_s, SHORTEST_S), 3 * self.period_s) - self.period_s
            )
        self.heard_s[view] = time_s
        self.waiting[view] = detections, time_s
        # The first frame waits for every camera, until one comes again.
        awaited = (time_s - self.heard_s <= SILENT_S) | np.isinf(self.done_s)
        alive = np.flatnonzero(awaited).tolist()
        return found + (self.rest() if all(each in self.waiting for each in alive) else [])

    def rest(self) -> list[Frame]:
        """The waiting views as a frame, with those whose times agree; others are dropped."""
        if len(self.waiting) == 0:
            return []
        every = [time_s for _, time_s in self.waiting.values()]
        most = max(every, key=lambda time_s: sum(abs(other - time_s) <= JUMP_S for other in every))
        self.heard_s = np.where(np.abs(self.heard_s - most) <= JUMP_S, self.heard_s, -np.inf)
        self.waiting = {
            view: each for view, each in self.waiting.items() if abs(each[1] - most) <= JUMP_S
        }
        mean = float(np.mean([time_s for _, time_s in self.waiting.values()]))
        times = np.full(self.views, mean)
        for view, (_, time_s) in self.waiting.items():
            times[view] = time_s
        together = Detections.joined([self.waiting[view][0] for view in sorted(self.waiting)])
        self.waiting, self.done_s = {}, mean
        return [(together, times)]


def with_pose(
    rig: Rig, view: int, time_s: float, pose: Array, covariance: Array | None, since_s: float
) -> Rig:
    """The rig with one more pose (4, 4) of a camera, or its carrier, at `time_s`, with covariance
    (6, 6).

    Poses before `since_s` are dropped except the last. Raises ValueError for invalid poses.
    """
    camera = rig.cameras[view]
    name = camera.carrier or camera.name
    others = tuple(each for each in rig.trajectories if each.name != name)
    known = [each for each in rig.trajectories if each.name == name]
    pose = np.asarray(pose, dtype=np.float64)
    covariance = (
        np.zeros((6, 6)) if covariance is None else np.asarray(covariance, dtype=np.float64)
    )
    if pose.shape != (4, 4) or covariance.shape != (6, 6):
        raise ValueError(
            f"pose must be (4, 4) and pose_covariance (6, 6), got {pose.shape} and "
            f"{covariance.shape}"
        )
    # Time before a camera's first pose from which on this pose is used, s.
    times, poses, covariances = np.array([time_s - 0.4]), pose[None], covariance[None]
    if len(known) > 0:
        times, poses, covariances = (
            known[0].time_s,
            known[0].wTb,
            known[0].covariance_at(known[0].time_s),
        )
    stays = (times != time_s) & (times >= times[times <= since_s].max(initial=-np.inf))
    times, poses = np.append(times[stays], time_s), np.append(poses[stays], pose[None], axis=0)
    order, covariances = (
        np.argsort(times, kind="stable"),
        np.append(covariances[stays], covariance[None], axis=0),
    )
    goes = Trajectory(name, times[order], poses[order], covariances[order])
    cameras = [replace(each, carrier=name) if each is camera else each for each in rig.cameras]
    return replace(rig, cameras=tuple(cameras), trajectories=(*others, goes))
