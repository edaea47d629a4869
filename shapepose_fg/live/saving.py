"""Saves the state of an online reconstruction as arrays, and restores it in another process or
after a restart.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import LEAST_STEP_S
from shapepose_fg.core.reconstruction import MOST_NUMBER, Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import read_npz, write_npz
from shapepose_fg.core.storage.schema import Column, checked_columns
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.live.cameras import CameraState, CameraWatch
from shapepose_fg.live.clock import CommonClock
from shapepose_fg.live.filtering import OF_TRACKS, ON_TRIAL, EndedTracks, Filter, FilterState
from shapepose_fg.live.refining import LiveState, Slot
from shapepose_fg.live.views import MOST_S, SHORTEST_S, ViewsInStep
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import Tracks

FORMAT = "shapepose-fg live state 4"
_CURE = "start without it"
_WHOLE, _SEEN = np.int64, ("view", "joint", "xy", "confidence", "place", "mirrored")
_DETECTIONS = (*_SEEN, "pairs", "affinity")
"""Columns of detections in a saved state."""
_POSES = ("time_s", "wTb", "covariance")
"""Columns of poses of moving cameras, in addition to the carrier's name."""
_LEAST_VARIANCE = 1e-12
"""Minimum variance of a position in any direction, m²: smaller ones have no finite inverse."""
_COUNTS = ("frames", "late", "dropped", "unrefined", "not_taken", "jumps")
"""Names of the counters in a saved state."""
_CAMERAS = {
    "counts": Column(f"{len(_COUNTS)}", _WHOLE, most=MOST_NUMBER),
    "apart_m": Column("V", least=0, most=1e3),
    "heard_s": Column("V"),
    "state": Column("V", _WHOLE, most=len(CameraState), codes=CameraState),
    "last_s": Column("V"),
    "clock": Column("2"),
    "waiting_s": Column("V"),
}
"""Arrays of the cameras and of the views that wait for a frame."""
_COLUMNS = {
    "slots": Column("T 8", _WHOLE, most=MOST_NUMBER),
    "times": Column("T 2"),
    "time_s": Column("T V", most=1e12, finite=True),
    "out": Column("T V", _WHOLE),
    "candidate": Column("A J V", _WHOLE),
    "ids": Column("A", _WHOLE),
    "world": Column("A", _WHOLE),
    "mean": Column("A J S", most=1e9, finite=True),
    "covariance": Column("A J S S", most=1e18, finite=True),
    "evident_s": Column("A", most=1e12),
    "views": Column("A J", _WHOLE),
    "identity": Column("A", _WHOLE),
    "running_s": Column("A", most=1e9),
    "peak_s": Column("A", least=0, most=1e9, finite=True),
    "born_s": Column("A", most=1e12),
    "place": Column("A 3", most=1e6),
    "length_m": Column("A B", least=0, most=1e12, finite=True),
    "count": Column("A B", least=0, most=1e12, finite=True),
    "gone.identity": Column("G", _WHOLE),
    "gone.time_s": Column("G", most=1e12),
    "gone.place": Column("G 3", most=1e6),
    "gone.bones": Column("G B", most=1e6),
    "seen.view": Column("D", _WHOLE),
    "seen.joint": Column("D", _WHOLE),
    "seen.xy": Column("D 2", most=1e9, finite=True),
    "seen.confidence": Column("D", least=0, most=1, finite=True),
    "seen.place": Column("D", _WHOLE),
    "seen.mirrored": Column("D", least=0, most=1, finite=True),
    "seen.pairs": Column("E 2", _WHOLE),
    "seen.affinity": Column("E", least=0, most=10, finite=True),
}
"""Arrays of the frames, concatenated. `slots` has for each frame its number, whether it is settled,
the next track and identity, and its numbers of tracks, detections, pairs and ended tracks."""


def setup_id(rig: Rig, skeleton: Skeleton, config: PipelineConfig, lag_s: float) -> str:
    """Digest of all that a saved state depends on: cameras, skeleton, settings and lag."""
    told = repr((asdict(config), rig.names, skeleton.joints, skeleton.limbs, lag_s)).encode()
    return hashlib.sha256(told + rig.K.tobytes() + rig.cTw.tobytes()).hexdigest()


def slot_arrays(slots: Sequence[Slot]) -> dict[str, NDArray[Any]]:
    """One or more frames and the states after them, as arrays."""
    states, given = [slot.state for slot in slots], [slot.given for slot in slots]
    seen = [each.detections for each in given]
    views = len(given[0].rig)
    out = np.zeros((len(slots), views), dtype=np.int64)
    for row, each in zip(out, given, strict=True):
        row[list(each.rig.doubted)], row[list(each.rig.dark)] = 2, 1
    counts = [
        (
            slot.given.frame, slot.settled, slot.state.next_track, slot.state.next_identity,
            len(slot.state.tracks), len(slot.given.detections), len(slot.given.detections.pairs),
            len(slot.state.gone.identity),
        )
        for slot in slots
    ]  # fmt: skip
    arrays: dict[str, NDArray[Any]] = {
        "slots": np.array(counts, dtype=np.int64),
        "times": np.array([(each.tracks.time_s, each.sought_s) for each in states]),
        "time_s": np.array([each.time_s for each in given]),
        "out": out,
        "candidate": np.concatenate([slot.candidate for slot in slots]),
        "mean": np.concatenate([each.tracks.joints.mean for each in states]),
        "covariance": np.concatenate([each.tracks.joints.covariance for each in states]),
    }
    for name in ("ids", "world", "evident_s"):
        arrays[name] = np.concatenate([getattr(each.tracks, name) for each in states])
    for name in OF_TRACKS:
        arrays[name] = np.concatenate([getattr(each, name) for each in states])
    for each in fields(EndedTracks):
        arrays[f"gone.{each.name}"] = np.concatenate(
            [getattr(state.gone, each.name) for state in states]
        )
    for name in _DETECTIONS:
        arrays[f"seen.{name}"] = np.concatenate([getattr(each, name) for each in seen])
    return arrays


def _carried(arrays: Mapping[str, NDArray[Any]], rig: Rig) -> Rig:
    """The rig with the recent poses of moving cameras from a saved state."""
    if "pose.carrier" not in arrays:
        return rig
    found = []
    for name in np.unique(arrays["pose.carrier"]).tolist():
        own = arrays["pose.carrier"] == name
        time_s, wTb, covariance = (arrays[f"pose.{each}"][own] for each in _POSES)
        found.append(Trajectory(name, time_s, wTb, covariance))
    known = {each.name for each in found}
    cameras = [
        replace(each, carrier=each.carrier or each.name * (each.name in known))
        for each in rig.cameras
    ]
    return replace(rig, cameras=tuple(cameras), trajectories=tuple(found))


def slots_of(arrays: Mapping[str, NDArray[Any]], rig: Rig, nobody: FilterState) -> list[Slot]:
    """The frames from the arrays of `slot_arrays`. Raises ValueError if they are invalid or of
    other cameras.
    """
    J, B = nobody.views.shape[1], nobody.count.shape[1]
    sizes = {"V": len(rig), "J": J, "B": B, "S": nobody.tracks.joints.mean.shape[2]}
    found = checked_columns(_COLUMNS, arrays, sizes)
    counts = found["slots"]
    if any(
        counts[:, n].sum() != sizes.get(letter, 0)
        for n, letter in zip((4, 5, 6, 7), "ADEG", strict=True)
    ):
        raise ValueError("its rows are not of its frames")
    covariance = found["covariance"]
    small = 1e-6 * np.abs(covariance).max(axis=(-2, -1), initial=0.0)
    asymmetric = np.abs(covariance - covariance.mT).max(axis=(-2, -1), initial=0.0) > small
    if asymmetric.any() or (np.linalg.eigvalsh(covariance)[..., 0] < -small).any():
        raise ValueError("covariances of its tracks must be symmetric, with no negative eigenvalue")
    if (np.linalg.eigvalsh(covariance[..., :3, :3])[..., 0] < _LEAST_VARIANCE).any():
        raise ValueError(f"the variances of its positions must be above {_LEAST_VARIANCE:g} m²")
    if not (np.abs(found["times"][:, 0] - found["time_s"].mean(axis=1)) < 1e-3).all():
        raise ValueError("the times of its tracks must be those of its frames")
    if (np.diff(found["time_s"].mean(axis=1)) <= LEAST_STEP_S).any():
        raise ValueError("its frames must be in order of time")
    slots, starts = [], np.vstack([np.zeros((1, 8), dtype=np.int64), np.cumsum(counts, axis=0)])
    for n, (frame, settled, track, identity, *_) in enumerate(counts.tolist()):
        a, d, e, g = (slice(*starts[n : n + 2, column].tolist()) for column in (4, 5, 6, 7))
        dark, doubted = (tuple(np.flatnonzero(found["out"][n] == code).tolist()) for code in (1, 2))
        seen = Detections(
            **{name: found[f"seen.{name}"][d] for name in _SEEN},
            pairs=found["seen.pairs"][e],
            affinity=found["seen.affinity"][e],
        )
        given = Input(
            frame,
            found["time_s"][n],
            seen,
            replace(rig.at(found["time_s"][n]), dark=dark, doubted=doubted),
        )
        candidate = found["candidate"][a].astype(np.intp)
        _check(seen, candidate, len(rig), J)
        time_s, sought_s = found["times"][n].tolist()
        joints = JointStates(found["mean"][a], found["covariance"][a])
        ids, who = found["ids"][a], found["identity"][a]
        if len(np.unique(ids)) < len(ids) or not ((ids >= 0) & (ids < track)).all():
            raise ValueError("the numbers of its tracks must differ")
        if not ((who >= ON_TRIAL) & (who < identity)).all():
            raise ValueError("identities of its people must be below the next one")
        tracks = Tracks(time_s, found["ids"][a], found["world"][a], joints, found["evident_s"][a])
        own = {name: found[name][a] for name in OF_TRACKS}
        gone = EndedTracks(*(found[f"gone.{each.name}"][g] for each in fields(EndedTracks)))
        state = FilterState(
            tracks, **own, gone=gone, sought_s=sought_s, next_track=track, next_identity=identity
        )
        slots.append(Slot(given, state, candidate, bool(settled)))
    return slots


def _check(seen: Detections, candidate: Whole, views: int, joints: int) -> None:
    """Raise ValueError if detections have no valid camera or joint, or if tracks have detections
    that do not exist or are of another joint or camera.
    """
    within = all(
        len(values) == 0 or (values.min() >= 0 and values.max() < most)
        for values, most in ((seen.view, views), (seen.joint, joints), (seen.pairs, len(seen)))
    )
    if not within or (
        candidate.size > 0 and (candidate.min() < -1 or candidate.max() >= len(seen))
    ):
        raise ValueError("its detections are of other cameras, joints or people")
    first, second = seen.pairs.T
    if (seen.view[first] != seen.view[second]).any() or len(np.unique(seen.pairs, axis=0)) < len(
        seen.pairs
    ):
        raise ValueError("its affinities must be of two detections of a camera, each pair once")
    person, joint, view = np.nonzero(candidate >= 0)
    own = candidate[person, joint, view]
    if (seen.joint[own] != joint).any() or (seen.view[own] != view).any():
        raise ValueError("its people have detections of other joints or cameras")


def state_arrays(state: LiveState) -> dict[str, NDArray[Any]]:
    """A state as arrays."""
    views = len(state.watch.state)
    waiting_s = np.full(views, np.nan)
    for view, (_, time_s) in state.views.waiting.items():
        waiting_s[view] = time_s
    arrays: dict[str, NDArray[Any]] = {
        "counts": np.array([getattr(state, name) for name in _COUNTS]),
        "apart_m": state.watch.apart_m,
        "heard_s": state.watch.heard_s,
        "state": state.watch.state,
        "last_s": state.views.heard_s,
        "clock": np.array([state.views.done_s, state.views.period_s]),
        "waiting_s": waiting_s,
    }
    waiting = Detections.joined(
        [each for each, _ in state.views.waiting.values()] or [Detections.empty()]
    )
    for name, seen in (("waiting", waiting), ("before", state.before or Detections.empty())):
        arrays |= {f"{name}.{each}": getattr(seen, each) for each in _DETECTIONS}
    for each in sorted(state.rig.trajectories, key=lambda each: each.name):
        known = (
            np.full(len(each), each.name),
            each.time_s,
            each.wTb,
            each.covariance_at(each.time_s),
        )
        for name, values in zip(("carrier", *_POSES), known, strict=True):
            before = [arrays[f"pose.{name}"]] if f"pose.{name}" in arrays else []
            arrays[f"pose.{name}"] = np.concatenate([*before, values])
    if len(state.settled) > 0:
        settled = Reconstruction.concatenate(list(state.settled))
        arrays |= {f"settled.{each}": getattr(settled, each) for each in Reconstruction.ROWS}
    return arrays | (
        slot_arrays(state.slots) if len(state.slots) > 0 else {"slots": np.zeros((0, 8), np.int64)}
    )


def write_state(path: Path, arrays: Mapping[str, NDArray[Any]], setup: str) -> None:
    """Write a state atomically; equal states give equal bytes."""
    told = {"format": np.array(FORMAT), "setup": np.array(setup), **arrays}
    write_atomically(path, lambda stream: write_npz(stream, told))


def read_state(path: Path, setup: str, rig: Rig, following: Filter) -> LiveState:
    """Read a state. Raises InputError if the file is not a state, or of another set-up."""
    names = [
        *_CAMERAS,
        *(f"{name}.{each}" for name in ("waiting", "before") for each in _DETECTIONS),
    ]
    optional = [f"settled.{each}" for each in Reconstruction.ROWS]
    optional += [f"pose.{each}" for each in ("carrier", *_POSES)]
    arrays = read_npz(path, ("format", "setup", *_COLUMNS, *names, *optional), _CURE)
    if str(arrays.get("format", "")) != FORMAT:
        raise InputError(f"{path}: this is not a saved state of a live reconstruction; {_CURE}")
    if str(arrays.get("setup", "")) != setup:
        raise InputError(
            f"{path}: the state was saved with other cameras, joints, settings or lag; give "
            f"those, or {_CURE}"
        )
    missing = {*names, *(_COLUMNS if len(arrays.get("slots", ())) > 0 else ())} - arrays.keys()
    if missing:
        raise InputError(f"{path}: {min(missing)} is missing; {_CURE}")
    try:
        return _state_of(arrays, rig, following)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: {error}; {_CURE}") from None


def _state_of(arrays: Mapping[str, NDArray[Any]], rig: Rig, following: Filter) -> LiveState:
    """The state from its arrays. Raises ValueError if they do not fit."""
    V, skeleton = len(rig), following.tracker.skeleton
    told = checked_columns(_CAMERAS, arrays, {"V": V})
    heard_s, last_s = told["heard_s"], told["last_s"]
    seen = {}
    for name in ("waiting", "before"):
        own = {f"{name}.{each}": _COLUMNS[f"seen.{each}"] for each in _DETECTIONS}
        found = checked_columns(own, arrays, {}).values()
        seen[name] = Detections(**dict(zip(_DETECTIONS, found, strict=True)))
        _check(seen[name], np.zeros((0, len(skeleton), V), dtype=np.int64), V, len(skeleton))
    waiting = {
        view: (seen["waiting"].only(seen["waiting"].view == view), float(told["waiting_s"][view]))
        for view in np.flatnonzero(np.isfinite(told["waiting_s"])).tolist()
    }
    done_s, period_s = told["clock"].tolist()
    late = np.concatenate([told["waiting_s"], last_s, heard_s, [done_s]])
    if (
        (np.abs(late[np.isfinite(late)]) > MOST_S).any()
        or np.isposinf(late).any()
        or np.isnan(np.append(last_s, heard_s)).any()
    ):
        raise ValueError(f"times must be at most {MOST_S:g} s")
    if np.isnan(done_s) or not SHORTEST_S <= period_s <= 2 * MOST_S:
        raise ValueError(f"clock must hold a time, and a period of {SHORTEST_S:g} s at least")
    watch = CameraWatch(told["apart_m"], heard_s, told["state"])
    rig = _carried(arrays, rig)
    views = ViewsInStep(V, waiting, last_s, *told["clock"].tolist())
    state = LiveState(rig, watch, views, CommonClock(V), following.nobody)
    for name, value in zip(_COUNTS, told["counts"].tolist(), strict=True):
        setattr(state, name, int(value))
    if "settled.frame" in arrays:
        state.settled.append(_rows(arrays, "settled", skeleton))
    if len(arrays["slots"]) > 0:
        state.slots, state.before = slots_of(arrays, rig, following.nobody), seen["before"]
    return state


def _rows(arrays: Mapping[str, NDArray[Any]], name: str, skeleton: Skeleton) -> Reconstruction:
    columns = {each: arrays[f"{name}.{each}"] for each in Reconstruction.ROWS}
    rows = Reconstruction(joint_names=np.array(skeleton.joints), **cast(Any, columns))
    rows.check_ranges()
    return rows
