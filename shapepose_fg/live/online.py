"""Online reconstruction: `push` detections, read `people` at any time, and collect `settled`
rows.
"""

import threading
from bisect import bisect_left
from collections import deque
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, check_fitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import LEAST_STEP_S
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.estimation.mirrored_sides import mirrored_spread
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.live.cameras import CameraState, CameraWatch
from shapepose_fg.live.clock import JUMP_S, CommonClock
from shapepose_fg.live.filtering import Filter
from shapepose_fg.live.newest_frame import Newest, fed_back, of_poses, people_at
from shapepose_fg.live.refining import LiveState, Slot, WindowQueue
from shapepose_fg.live.saving import read_state, setup_id, write_state
from shapepose_fg.live.views import MOST_S, ViewsInStep, with_pose
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.workers import workers as worker_processes
from shapepose_fg.proposal.thinning import thinned

AHEAD_S = 1.0
"""Longest prediction after the newest frame, s."""
_SETTLES = 2 / 3
"""Minimum share of the lag that a window settles, if the lag has several frames."""
_BEFORE = 7.0
"""Ratio of the lag to the duration that a window includes before the settled frames, which is a
frame or two. With a third of the lag it takes an eighth more time, and errors are 0.04 mm smaller
(two stretches of split `tune`)."""
_BEHIND = 3.0
"""Age of a frame, in lags, at which it is settled without refinement, because solving is too
slow."""
_OFF_CLOCK = 10
"""Number of consecutive views with a wrong time after which the camera is reported, and frames from
`push` are accepted."""
_STANDS = 30
"""Excess of views without a pose over views with one, after which a camera counts as static, with
the rig's pose."""


@dataclass(frozen=True)
class CameraChange:
    """A change of a camera's status during the run."""

    time_s: float
    """Time of the change, s."""
    camera: str
    """Name of the camera."""
    state: CameraState
    """Status of the camera from then on."""


@dataclass(frozen=True)
class LiveReport:
    """Counts of a run, and the status of each camera."""

    frames: int
    """Number of frames that were processed."""
    late: int
    """Number of processed frames that arrived after a later frame."""
    dropped: int
    """Number of frames, or detections of one camera, that were left out because they arrived too
    late or twice."""
    unrefined: int
    """Number of frames that were settled without refinement, because solving was too slow."""
    not_taken: int
    """Number of settled rows that were not collected in time."""
    jumps: int
    """Number of jumps of the common clock, after a pause or because it was set. Tracking restarts
    if the clock went back, or forward by more than the longest gap of a track."""
    cameras: dict[str, CameraState]
    """Status of each camera by name."""


class OnlineReconstructor(AbstractContextManager["OnlineReconstructor"]):
    """Tracks people from frame to frame as they come, and refines them within a fixed lag.

    A context manager; on exit the worker processes end. `push`, `push_view`, `settled`, `catch_up`,
    `save` and `close` exclude each other; `people` and `report` never wait and may be called from
    any thread.
    """

    def __init__(
        self,
        rig: Rig,
        config: PipelineConfig | None = None,
        *,
        skeleton: Skeleton = BODY_25,
        lag_s: float = 0.3,
        workers: int = 2,
        fitter: BodyFitter | None = None,
    ) -> None:
        """`skeleton` are the detector's joints; `lag_s` is the delay of the refined people.

        `workers` is the number of processes for refinement; with 1 it runs within `push`, in a
        fixed order, so that the same frames give the same bytes. Offsets of the detector's joints,
        and its noise law, are read from `config.offsets.source` if it is a file. Raises ValueError
        for fewer than two cameras, or a lag outside 0.1 to 2 seconds.
        """
        config = PipelineConfig() if config is None else config
        if len(rig) < 2:
            raise ValueError(f"at least 2 cameras are needed, got {len(rig)}")
        if not 0.1 <= lag_s <= 2.0:
            raise ValueError(f"lag_s must be 0.1 to 2 seconds, got {lag_s}")
        if not config.temporal:
            raise ValueError(
                "live reconstruction tracks people over time; leave config.temporal at true"
            )
        # Maximum rounds of reassociation in a window: the filter has assigned
        # detections already, and two rounds take a seventh to a fifth more time for the
        # same figures (Shelf, crossing).
        rounds = min(config.windows.again_over_time, 1)
        config = replace(config, windows=replace(config.windows, again_over_time=rounds))
        source, noise = config.offsets.source, NoiseLaw.shipped()
        if source not in ("none", "recording"):
            noise = NoiseLaw.load(source)
        if fitter is None:
            fitter = make_fitter(config.body, BodyModel.default().with_keypoints(skeleton.joints))
            if source not in ("none", "recording"):
                fitter = fitter.with_keypoint_offsets(KeypointOffsets.load(source))
        check_fitter(fitter)
        self.rig, self.lag_s = rig, lag_s
        setup = Setup(rig, skeleton, config, fitter, noise=noise)
        self._setup, self._config, self._id = setup, config, setup_id(rig, skeleton, config, lag_s)
        self._filter = Filter(setup.engine(Notebook()).tracker, config.stitching)
        self._motion = MotionModel.load(skeleton.joints, config.motion, config.law)
        self._lock = threading.RLock()
        self._open = ExitStack()
        pool = self._open.enter_context(worker_processes(workers, setup))
        self._most_waiting = 1 if workers == 1 else 2 * workers
        self._windows = WindowQueue(pool, self._filter)
        start = (
            CameraWatch.of(len(rig)),
            ViewsInStep(len(rig)),
            CommonClock(len(rig)),
            self._filter.nobody,
        )
        self._state = LiveState(rig, *start)
        self._behind = 0
        self._changes = deque[CameraChange](maxlen=1000)
        self._now = Newest(0, self._filter.nobody, fitter)

    @classmethod
    def load(
        cls,
        path: Path | str,
        rig: Rig,
        config: PipelineConfig | None = None,
        *,
        skeleton: Skeleton = BODY_25,
        lag_s: float = 0.3,
        workers: int = 2,
        fitter: BodyFitter | None = None,
    ) -> "OnlineReconstructor":
        """Resume from a file of `save`. Raises InputError unless cameras, settings and lag are the
        same.
        """
        found = cls(rig, config, skeleton=skeleton, lag_s=lag_s, workers=workers, fitter=fitter)
        try:
            found._state = read_state(Path(path), found._id)
            found._show()
        except InputError:
            found.close()
            raise
        return found

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker processes. Settled rows can still be collected."""
        with self._lock:
            self._open.close()

    def push(self, detections: Detections, time_s: float | Array) -> None:
        """Process a frame of all cameras, taken at `time_s`: seconds, or (V,) for asynchronous
        cameras.

        A camera without detections is treated as absent from the frame. Frames may come late or out
        of order by up to the lag: all later frames are then tracked again. Older frames, and
        duplicates of a time, are counted and ignored; ten in a row that are seconds old mean that
        the clock was set back, and tracking restarts. Raises ValueError if a detection is not
        finite, has no valid camera or joint, or is of a moving camera (`push_view`) without a known
        pose, and for times seconds apart.
        """
        times = np.broadcast_to(np.asarray(time_s, dtype=np.float64), (len(self.rig),)).copy()
        self._check_time(times)
        if np.ptp(times) > JUMP_S:
            raise ValueError(
                f"the times of one frame must be within {JUMP_S:g} s, got {np.ptp(times):g} s"
            )
        self._check(detections)
        with self._lock:
            slots = self._state.slots
            self._check_places(detections, times)
            ahead_s = float(times.mean()) - slots[-1].time_s if len(slots) > 0 else 0.0
            self._behind = self._behind + 1 if ahead_s < -JUMP_S else 0
            if self._behind >= _OFF_CLOCK or ahead_s > self._config.stitching.longest_gap_s:
                self._begin_anew()
                self._behind, self._state.jumps = 0, self._state.jumps + 1
            self._take(detections, times)

    def push_view(
        self,
        camera: str,
        detections: Detections,
        time_s: float,
        pose: Array | None = None,
        pose_covariance: Array | None = None,
    ) -> None:
        """Process the detections of one camera at `time_s`, seconds, on the common clock.

        A frame is complete when it has a view of every camera that was active in the last half
        second (the first frame: of every camera), or when a camera comes again. A view for a
        completed frame is added to it if it is within half a frame of it and within the lag; else
        it is counted and ignored. `detections` are assigned to `camera`; their `view` is not used.

        A view with a time seconds away from the others' waits until those of other cameras confirm
        it: a single camera does not move the common clock. If all cameras jump, the waiting views
        are processed.

        `pose` (4, 4) is world from camera at that time, or from its carrier (`Camera.carrier`),
        metres; `pose_covariance` (6, 6) its covariance, rotation before translation along its own
        axes, rad² and m² (GTSAM's order); without it, the pose is exact. Poses are interpolated if
        they are at most half a second apart. A camera without a carrier moves if its first view has
        a pose. Raises ValueError as `push` does, for an unknown camera, and for the pose of a
        static camera; the state is then unchanged.
        """
        if camera not in self.rig.names:
            raise ValueError(f"there is no camera {camera}; there are {', '.join(self.rig.names)}")
        self._check_time(np.array(time_s))
        view = self.rig.names.index(camera)
        own = replace(detections, view=np.full(len(detections), view))
        self._check(own)
        with self._lock:
            state = self._state
            rig = self._placed(view, time_s, pose, pose_covariance)
            self._check_places(own, np.full(len(self.rig), time_s), rig)
            was_off, given = (
                state.clock.off.get(view, 0),
                (view, own, time_s, pose, pose_covariance),
            )
            taken, jumps = state.clock.admit(view, time_s, state.views.done_s, given)
            self._say_clock(view, was_off, state.clock.off.get(view, 0))
            if jumps:
                self._jump(taken[0][2])
            refused = None
            for each in taken:
                try:
                    self._take_view(*each)
                except ValueError as error:
                    refused = error if each is given else refused
            if refused is not None:
                raise refused

    def _placed(
        self, view: int, time_s: float, pose: Array | None, covariance: Array | None
    ) -> Rig:
        """The rig with the checked pose of a view. Raises ValueError without changing the state."""
        state, name = self._state, self.rig.names[view]
        moves, alone = bool(state.rig.cameras[view].carrier), not self.rig.cameras[view].carrier
        if pose is None:
            state.without_pose[view] = min(state.without_pose[view] + 1, _STANDS)
            if moves and alone and state.without_pose[view] >= _STANDS:
                stands = replace(state.rig.cameras[view], carrier="", bTc=np.eye(4))
                others = tuple(each for each in state.rig.trajectories if each.name != name)
                cameras = tuple(
                    stands if n == view else each for n, each in enumerate(state.rig.cameras)
                )
                state.rig = replace(state.rig, cameras=cameras, trajectories=others)
            return state.rig
        if alone and not moves and state.without_pose[view] > 0:
            raise ValueError(
                f"camera {name} is fixed, because its earlier views had no pose; leave out its pose"
            )
        # Additional time for which poses of moving cameras are kept, beyond the longest
        # wait of a frame, s.
        since_s = max(state.views.done_s, time_s) - (1 + _BEHIND) * self.lag_s - 1.0
        rig = with_pose(state.rig, view, time_s, pose, covariance, since_s)
        rig.at(np.full(len(rig), time_s))
        return rig

    def _take_view(
        self,
        view: int,
        own: Detections,
        time_s: float,
        pose: Array | None,
        covariance: Array | None,
    ) -> None:
        """Add a view to the frame its time belongs to."""
        if pose is not None:
            self._state.rig = self._placed(view, time_s, pose, covariance)
            self._state.without_pose[view] = max(self._state.without_pose[view] - 1, 0)
        if self._state.views.is_late(view, time_s):
            self._state.views.heard(view, time_s)
            self._join(view, own, time_s)
            return
        for frame, times in self._state.views.add(view, own, time_s):
            self._take(frame, times)

    def _say_clock(self, view: int, was_off: int, off: int) -> None:
        """Count a view that is ignored for its time, and report its camera after several."""
        self._state.dropped += int(off > 1)
        if off == _OFF_CLOCK or (off == 0 and was_off >= _OFF_CLOCK):
            code = (
                CameraState.OFF_CLOCK
                if off > 0
                else CameraState(int(self._state.watch.state[view]))
            )
            self._changes.append(CameraChange(self._state.views.done_s, self.rig.names[view], code))

    def _jump(self, time_s: float) -> None:
        """Continue the common clock at `time_s`."""
        state = self._state
        for frame, times in state.views.rest():
            self._take(frame, times)
        ahead_s = time_s - state.views.done_s
        state.views = ViewsInStep(len(self.rig), period_s=state.views.period_s)
        state.jumps += 1
        if not 0 <= ahead_s <= self._config.stitching.longest_gap_s:
            self._begin_anew()

    def _begin_anew(self) -> None:
        """Settle all frames; the next one starts tracking again."""
        state = self._state
        self._refine(last=True)
        if len(state.slots) > 0:
            last = state.slots[-1].state
            state.begin = replace(
                self._filter.nobody, next_track=last.next_track, next_identity=last.next_identity
            )
        state.slots.clear()
        state.before, state.watch, state.rig = None, CameraWatch.of(len(self.rig)), self.rig

    @property
    def newest_s(self) -> float:
        """Time of the newest frame, seconds, also if nobody is in it; not finite before the first
        frame.
        """
        return float(self._now.state.tracks.time_s)

    def people(self, time_s: float | None = None) -> Reconstruction:
        """The people at `time_s`, from the newest frame's time (the default) to a second after it.

        A row per person, with the newest frame's number. Joints are predicted by the motion model,
        and their covariances grow with the prediction time. Bodies are fitted to the newest joints
        at the first call, and moved with them; joints seen by fewer than two views are the body's.
        Raises ValueError for any other time.
        """
        newest = self._now
        newest_s = newest.state.tracks.time_s
        ahead_s = 0.0 if time_s is None or not np.isfinite(newest_s) else time_s - newest_s
        if not -1e-9 <= ahead_s <= AHEAD_S + 1e-9:
            raise ValueError(
                f"people are known from {newest_s:g} s (the newest frame) to {AHEAD_S:g} s "
                f"later, but not at {time_s:g} s; earlier people are in settled()"
            )
        return people_at(newest, self._setup.skeleton, self._motion, max(ahead_s, 0.0))

    def settled(self, *, wait: bool = False) -> Reconstruction:
        """The refined rows of all frames that have settled since the last call; with `wait`, also
        those of windows that are still being solved. Rows that are not collected within ten seconds
        are counted and dropped.
        """
        with self._lock:
            self._collect(wait=wait)
            parts = list(self._state.settled)
            self._state.settled.clear()
        names = self._setup.skeleton.joints
        return Reconstruction.concatenate(parts) if len(parts) > 0 else Reconstruction.empty(names)

    def finish(self) -> Reconstruction:
        """`settled` of all frames up to the newest, at the end of the stream."""
        with self._lock:
            for frame, times in self._state.views.rest():
                self._take(frame, times)
            self._refine(last=True)
            return self.settled(wait=True)

    def catch_up(self) -> None:
        """Wait until a further window can be submitted.

        Call this after each `push` of frames from a file, which is read faster than windows are
        solved; otherwise the oldest frames are settled without refinement (`report().unrefined`).
        """
        with self._lock:
            if self._windows.waiting >= self._most_waiting:
                self._collect(wait=True)

    def save(self, path: Path | str) -> None:
        """Write the state for `load`, after waiting for windows in progress. The same state gives
        the same bytes. Changes of cameras' statuses (`camera_changes`) are left out.
        """
        with self._lock:
            self._collect(wait=True)
            write_state(Path(path), self._state, self._id)

    def report(self) -> LiveReport:
        """Counts, and the status of each camera."""
        cameras = {
            name: CameraState(code)
            for name, code in zip(self.rig.names, self._state.watch.state, strict=True)
        }
        counts = (
            self._state.frames,
            self._state.late,
            self._state.dropped,
            self._state.unrefined,
            self._state.not_taken,
            self._state.jumps,
        )
        return LiveReport(*counts, cameras)

    def camera_changes(self) -> list[CameraChange]:
        """Changes of cameras' statuses, oldest first; the last thousand."""
        return list(self._changes)

    def _check_time(self, time_s: Array) -> None:
        if not (np.abs(time_s) <= MOST_S).all():
            raise ValueError(f"time_s must be finite, and at most {MOST_S:g}")

    def _check(self, detections: Detections) -> None:
        for name, values, count in (
            ("view", detections.view, len(self.rig)),
            ("joint", detections.joint, len(self._setup.skeleton)),
        ):
            if len(values) > 0 and (values.min() < 0 or values.max() >= count):
                raise ValueError(
                    f"{name} must be 0 to {count - 1}, got {values.min()} to {values.max()}"
                )
        if not (np.isfinite(detections.xy).all() and np.isfinite(detections.confidence).all()):
            raise ValueError("xy and confidence must be finite")

    def _check_places(self, detections: Detections, times: Array, rig: Rig | None = None) -> None:
        """Raise ValueError if a moving camera has detections without a known pose."""
        rig = self._state.rig if rig is None else rig
        for view in np.flatnonzero(rig.carrier >= 0).tolist():
            if (detections.view == view).any() and not rig.trajectories[rig.carrier[view]].covers(
                times[view]
            ):
                raise ValueError(
                    f"camera {rig.names[view]} moves; give a pose with its view at "
                    f"{times[view]:g} s"
                )

    def _take(self, detections: Detections, times: Array) -> None:
        """Insert a frame among the others by its time."""
        time_s, slots = float(times.mean()), self._state.slots
        detections, _ = thinned(detections, self.rig, self._config.candidates)
        if len(slots) > 0 and time_s <= slots[-1].time_s + LEAST_STEP_S:
            self._insert(detections, times, time_s)
            return
        last_s = slots[-1].time_s if len(slots) > 0 else time_s
        before, stands = self._state.watch, self._state.rig.at(times)
        watch, rig = before.seen(detections, self._state.before, stands, time_s)
        last = slots[-1].state if len(slots) > 0 else self._state.begin
        given = Input(self._state.frames, times, _without(detections, rig), rig)
        state, candidate, given = self._filter.step(last, given)
        self._state.frames += 1
        self._state.before = detections
        seen = (state.views >= 2) & state.named[:, None]
        shown = np.where(seen[..., None], state.tracks.joints.position, np.nan)
        self._state.watch = watch.compared(detections, shown, stands, time_s - last_s)
        for view in np.flatnonzero(watch.state != before.state).tolist():
            self._changes.append(
                CameraChange(time_s, self.rig.names[view], CameraState(watch.state[view]))
            )
        slots.append(Slot(given, state, candidate))
        self._refine()
        self._collect()

    def _insert(self, detections: Detections, times: Array, time_s: float) -> None:
        """Insert a frame that came after later ones, which are tracked again."""
        slots = self._state.slots
        at = bisect_left([slot.time_s for slot in slots], time_s)
        twice = any(
            abs(slot.time_s - time_s) <= LEAST_STEP_S for slot in slots[max(at - 1, 0) : at + 1]
        )
        if at == 0 or twice or slots[-1].time_s - time_s > self.lag_s:
            self._state.dropped += 1
            return
        rig = self._state.watch.believed(detections, self._state.rig.at(times))
        given = Input(self._state.frames, times, _without(detections, rig), rig)
        slots.insert(
            at, Slot(given, slots[at].state, slots[at].candidate, settled=slots[at].settled)
        )
        self._state.frames, self._state.late = self._state.frames + 1, self._state.late + 1
        self._again(at)

    def _join(self, view: int, detections: Detections, time_s: float) -> None:
        """Add a camera's detections that came after their frame, which is processed again."""
        times = np.array([slot.time_s for slot in self._state.slots])
        at = int(np.abs(times - time_s).argmin()) if len(times) > 0 else 0
        near_s = self._state.views.period_s / 2
        if at == 0 or abs(times[at] - time_s) > near_s or times[-1] - time_s > self.lag_s:
            self._state.dropped += 1
            return
        slot = self._state.slots[at]
        if (slot.given.detections.view == view).any():
            self._state.dropped += 1
            return
        at_s = slot.given.time_s.copy()
        at_s[view] = time_s
        both = Detections.joined(
            [slot.given.detections, thinned(detections, self.rig, self._config.candidates)[0]]
        )
        excluded = tuple(each for each in slot.given.rig.excluded if each != view)
        rig = replace(self._state.rig.at(at_s), excluded=excluded, doubted=slot.given.rig.doubted)
        slot.given = replace(slot.given, time_s=at_s, detections=both, rig=rig)
        self._state.late += 1
        self._again(at)

    def _again(self, first: int) -> None:
        """Track again from slot `first` on."""
        for at in range(first, len(self._state.slots)):
            slot = self._state.slots[at]
            last = self._state.slots[at - 1].state
            slot.state, slot.candidate, slot.given = self._filter.step(last, slot.given)
            if slot.refined is not None:
                slot.state = fed_back(self._filter.tracker, slot.state, slot.refined)
        self._show()

    def _restart(self, refined: Reconstruction) -> None:
        """Restart tracking at a frame with refined people, since their joints are more accurate;
        not at a frame older than the lag, because tracking again since then takes too long.
        """
        slots = self._state.slots
        frames = [slot.given.frame for slot in slots if slots[-1].time_s - slot.time_s < self.lag_s]
        if refined.frame[0] in frames:
            at = len(slots) - len(frames) + frames.index(refined.frame[0])
            slots[at].refined = refined
            slots[at].state = fed_back(self._filter.tracker, slots[at].state, refined)
            self._again(at + 1)

    def _refine(self, *, last: bool = False) -> None:
        """Submit windows that are due, and drop frames that are no longer needed.

        A window settles what is older than a third of the lag as soon as a frame is as old as the
        lag, with the third after it and a little before it.
        """
        slots, around_s = self._state.slots, self.lag_s / 3
        if len(slots) == 0:
            return
        age_s = slots[-1].time_s - np.array([slot.time_s for slot in slots]) + 1e-6
        settled = np.array([*(slot.settled for slot in slots), False])
        first = int(settled.argmin())
        if first < len(slots) and (last or age_s[first] >= self.lag_s):
            stop = len(slots) if last else int((age_s >= around_s).sum())
            if last or self._windows.waiting < self._most_waiting:
                begin = int((age_s > age_s[first] + self.lag_s / _BEFORE).sum())
                self._windows.send(slots[begin:], first - begin, stop - first, self._state.rig)
                for slot in slots[first:stop]:
                    slot.settled = True
                first = stop
            elif age_s[first] > _BEHIND * self.lag_s:
                slots[first].settled = True
                self._state.unrefined += 1
        # The frames that a late frame may follow, and those that the next window includes before
        # its own.
        needed_s = max(self.lag_s, age_s[first] if first < len(slots) else 0.0) + around_s
        del slots[: int((age_s > needed_s).sum())]

    def _collect(self, *, wait: bool = False) -> None:
        """Collect the windows solved meanwhile: settled rows, and bodies for the newest frame."""
        for refined in self._windows.came(wait=wait):
            if len(refined.rows) > 0:
                self._state.settled.append(refined.rows)
            if len(refined.newest) > 0:
                self._restart(refined.newest)
        settled = self._state.settled
        # Time for which settled rows are kept if they are not collected, s.
        while len(settled) > 10.0 / (_SETTLES * self.lag_s):
            self._state.not_taken += len(settled.popleft())
        self._show()

    def _show(self) -> None:
        """Use the newest state for `people` from now on."""
        if len(self._state.slots) > 0:
            newest, rig, setup, added = self._state.slots[-1], self._state.rig, self._setup, None
            if rig.moves or newest.given.detections.mirrored.any():
                rows = self._filter.observations(newest.state, newest.candidate, newest.given)
                joints = newest.state.tracks.joints
                added = mirrored_spread(joints.position, rows.mirrored, setup.skeleton.joints)
                added += of_poses(rows, joints, rig, setup.estimator) if rig.moves else 0.0
            doubted = len(newest.given.rig.doubted) > 0
            self._now = Newest(newest.given.frame, newest.state, self._setup.fitter, doubted, added)


def _without(detections: Detections, rig: Rig) -> Detections:
    """Detections without those of excluded cameras."""
    excluded = np.zeros(len(rig), dtype=bool)
    excluded[list(rig.excluded)] = True
    return (
        detections.only(~excluded[detections.view])
        if excluded[detections.view].any()
        else detections
    )
