"""The pipeline: triangulate, propose and associate people; track them, solve windows, fit bodies;
return rows.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, check_fitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.core.arrays import Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes, check_cuts, spans_of
from shapepose_fg.core.notes import Notebook, Notes
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.core.trust import with_poses
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.estimation.trajectory_graph import CameraFactors
from shapepose_fg.estimation.user_factors import ExtraFactors, functions_of, name_of
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.keyframes import keyframes
from shapepose_fg.pipeline.offsets import Sample, kept_noise, kept_offsets
from shapepose_fg.pipeline.offsets import estimate_offsets as estimate_offsets
from shapepose_fg.pipeline.person_shapes import WindowBodies, bodies_with_shapes
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.parts import Parts
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.setup import find_people as find_people
from shapepose_fg.pipeline.solved_windows import SolvedWindows
from shapepose_fg.pipeline.trajectories import about, keep, kept_rig, refine, unrefined
from shapepose_fg.pipeline.workers import Pool
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.tracking.stitching import Ends, Trace, stitch
from shapepose_fg.tracking.track_selection import probability


def reconstruct(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    frames: range | None = None,
    times: FrameTimes | None = None,
    cuts: Sequence[int] = (),
    shapes: SubjectShapes | None = None,
    fitter: BodyFitter | None = None,
    extra_factors: ExtraFactors | None = None,
    execution: Execution | None = None,
) -> Reconstruction:
    """Reconstruct the people of a recording over time, or each frame separately.

    Frames are separate if `config.temporal` is false.

    `frames` selects frames of the recording (default: all). `times` are the times of the frames.
    Without them, 30 frames per second are assumed, and `run` says so. `cuts` are the first frames
    after cuts. No states or identities are carried over a cut. `shapes` are people known from other
    recordings. `fitter` replaces the body fitter. `extra_factors`, one function or several, adds
    your own factors to every person's window; they may connect people (docs/extending.md), and
    `run` has their number. Trajectories of moving cameras are refined first, unless
    `refine_trajectories` has done so. `Trusted(detections, check_setup(detections, rig).trust)`
    leaves out cameras that contradict the others. `execution` sets how the work is executed:
    processes, a cluster, chunks, and a callback for progress.

    In the result, `person` is an identity over time. If each frame is reconstructed separately, it
    is the number of a person within the frame. `run` has the configuration, versions, seconds per
    stage (over all processes), numbers of people found and dropped, with reasons, and offsets of
    the detector's joints from the body's. The offsets are estimated from frames spread over the
    whole recording, whatever `frames` selects; with your own fitter only if it has a `model`.
    Raises ValueError for an argument that does not fit the recording.
    """
    config = PipelineConfig() if config is None else config
    task = Task(detections, rig, config, frames, times, cuts, shapes, fitter, extra_factors)
    kept = InMemory()
    people = reconstruct_parts(kept, task, execution).reconstruction(consume=True)
    for name, counts in people.run.get("extra_factors", {}).items():
        if counts["made"] == counts["inactive"]:
            what = (
                "is active, because joints that they need have no position"
                if counts["made"] > 0
                else "was made"
            )
            warnings.warn(f"extra_factors: {name}: none of its factors {what}", stacklevel=2)
    return replace(people, rig=kept_rig(kept, rig) or rig)


def refine_trajectories(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    frames: range | None = None,
    times: FrameTimes | None = None,
    cuts: Sequence[int] = (),
    camera_factors: CameraFactors | None = None,
) -> Rig:
    """Refine the trajectories of moving cameras with the people that the cameras see; returns the
    rig, with covariances.

    `reconstruct` does this first where cameras move; it does not refine the returned rig again.
    People constrain a pose where two cameras see them that do not move together; elsewhere the
    odometry is used. If all cameras move, the world is the frame of the first carrier at the start.
    `camera_factors` add your own factors on the carriers' poses. Poses of separate frames
    (`config.temporal` false) are used as they are.
    """
    config = PipelineConfig() if config is None else config
    task = Task(detections, rig, config, frames, times, cuts, camera_factors=camera_factors)
    fitter = make_fitter(
        config.body, BodyModel.default().with_keypoints(detections.skeleton.joints)
    )
    return _with_refined(
        InMemory(), task, Setup(rig, detections.skeleton, config, fitter), Notebook()
    ).rig


@dataclass(frozen=True)
class Task:
    """Arguments of `reconstruct`, described there."""

    detections: DetectionSequence
    rig: Rig
    config: PipelineConfig = field(default_factory=PipelineConfig)
    frames: range | None = None
    times: FrameTimes | None = None
    cuts: Sequence[int] = ()
    shapes: SubjectShapes | None = None
    fitter: BodyFitter | None = None
    extra_factors: ExtraFactors | None = None
    camera_factors: CameraFactors | None = None

    def whole(self) -> tuple[range, FrameTimes, list[int]]:
        """Frames, times and cuts, with defaults for missing ones; raises ValueError if they are
        inconsistent.
        """
        if len(self.rig) < 2:
            raise ValueError(f"at least 2 cameras are needed, got {len(self.rig)}")
        count = len(self.detections)
        frames = range(count) if self.frames is None else self.frames
        if frames.step != 1 or not 0 <= frames.start <= frames.stop <= count:
            raise ValueError(f"frames must be a range of step 1 within 0:{count}, got {frames}")
        times = FrameTimes.assumed(count) if self.times is None else self.times
        times.check(count, len(self.rig))
        return frames, times, list(check_cuts(self.cuts, count))

    def keyframes(self) -> Index:
        """(K,) the frames in which people are searched for: all, or the keyframes."""
        frames, times, cuts = self.whole()
        apart_s = self.config.windows.keyframe_s if self.config.temporal else 0.0
        chosen = keyframes(times.frame_s, frames, cuts, apart_s)
        return frames.start + np.flatnonzero(chosen[frames.start : frames.stop])


def reconstruct_parts(kept: KeptArrays, task: Task, execution: Execution | None = None) -> Assembly:
    """`reconstruct` with solved windows stored in `kept`, and a result assembled from them.

    Windows that an interrupted call for the same task left in `kept` are not solved again; the
    result is identical in every byte.
    """
    execution = Execution() if execution is None else execution
    config, rig, skeleton, chunk = (
        task.config,
        task.rig,
        task.detections.skeleton,
        execution.chunk_frames,
    )
    frames, times, cuts = task.whole()
    if chunk is not None and not (config.temporal and chunk >= config.batch_frames):
        raise ValueError(
            f"chunk_frames must be at least batch_frames ({config.batch_frames}), for people "
            f"over time; got {chunk}"
        )
    notebook, fitter = Notebook(), task.fitter
    pictures = WithoutRepeats(with_poses(task.detections, rig, times), len(rig))
    detections = ThinnedFrames(pictures, rig, config.candidates)
    with notebook.stage("load"):
        if fitter is None:
            fitter = make_fitter(config.body, BodyModel.default().with_keypoints(skeleton.joints))
        check_fitter(fitter)
    report, passes = execution.progress_over(len(frames)), 1 + (unrefined(rig) and config.temporal)
    setup = Setup(rig, skeleton, config, fitter, task.extra_factors)
    setup = _with_refined(kept, task, setup, notebook, lambda done: report(done // passes))
    sample = Sample(setup, detections, times)
    offsets = kept_offsets(kept, sample, notebook)
    if offsets is not None:
        setup = replace(setup, fitter=fitter.with_keypoint_offsets(offsets))
    setup = replace(setup, noise=kept_noise(kept, sample, notebook))
    parts = Parts(kept)
    parts.check(skeleton.joints, rig.names, frames, times.frame_s)
    done = parts.notes().frames
    windows = SolvedWindows(
        setup, detections, pictures, times, frames, cuts, task.keyframes(), notebook
    )
    with execution.pool(setup, len(frames)) as pool:
        beginning = notebook.flush()
        nobody = setup.engine(notebook).tracker.nobody()
        begin = parts.checkpoint(windows.read, frames, nobody, skeleton)
        for part in windows.after(begin, pool, chunk):
            parts.append(part)
            done += part.notes.frames
            report((done + (passes - 1) * len(frames)) // passes)
        result = Assembly(parts, skeleton.joints, rig.names)
        if config.temporal and len(parts) > 0:
            with notebook.stage("follow"):
                # half way between frames, to avoid rounding
                cuts_s = (times.frame_s[cuts] + times.frame_s[[cut - 1 for cut in cuts]]) / 2
                result = replace(result, names=_names(result, setup, cuts_s.tolist()))
        floor: Floor | str = "frame by frame" if not config.temporal else "not sought"
        model = setup.fitter.model
        if config.temporal and model is not None and len(result) > 0:
            with notebook.stage("bodies over time"):
                if config.motion.floor:
                    floor = result.floor(model, rig.up_vector)
                ground = floor if isinstance(floor, Floor) else None
                result = _with_person_shapes(result, task.shapes, model, ground, pool)
    notes = beginning
    for each in (parts.notes(), notebook.flush()):
        notes.add(each)
    entries = {"time": times.as_dict(), "cuts": cuts}
    entries |= {
        "floor": floor.as_dict() if isinstance(floor, Floor) else {"found": False, "why": floor}
    }
    if rig.moves:
        entries |= {"trajectories": about(rig, setup.rig)}
    if functions := functions_of(task.extra_factors):
        made = {
            name_of(function): notes.factors.get(name_of(function), (0, 0))
            for function in functions
        }
        counts = {name: {"made": count, "inactive": idle} for name, (count, idle) in made.items()}
        entries |= {"extra_factors": counts}
    entries |= {
        "keypoint_offsets": None if offsets is None else offsets.as_dict(),
        "noise_law": setup.noise.as_dict(),
    }
    return result.with_run(**_summary(notes, config, frames, result), **entries)


def _with_refined(
    kept: KeptArrays,
    task: Task,
    setup: Setup,
    notebook: Notebook,
    report: Callable[[int], object] = lambda done: None,
) -> Setup:
    """The set-up with refined trajectories for moving cameras; the run stores them. `report` gets
    the number of frames that are done.
    """
    rig, config = setup.rig, setup.config
    if not unrefined(rig) or not config.temporal:
        return setup
    if (known := kept_rig(kept, rig)) is None:
        frames, times, cuts = task.whole()
        pictures = WithoutRepeats(with_poses(task.detections, rig, times), len(rig))
        thinned = ThinnedFrames(pictures, rig, config.candidates)
        # Notes on people are made when they are tracked again.
        every = np.arange(frames.start, frames.stop)
        windows = SolvedWindows(setup, thinned, pictures, times, frames, cuts, every, Notebook())
        with notebook.stage("trajectories"):
            known = refine(windows, task.camera_factors, report)
        keep(kept, known)
    return replace(setup, rig=known)


def _with_person_shapes(
    result: Assembly,
    known: SubjectShapes | None,
    model: BodyModel,
    floor: Floor | None,
    pool: Pool[Setup],
) -> Assembly:
    """The result with one shape per person, and bodies with these shapes."""

    def parts() -> Iterator[WindowBodies]:
        return map(result.bodies, range(len(result.parts)))

    def mapped(work: Any, items: Any) -> Iterator[Any]:
        return pool.map(_on_bodies, ((work, each) for each in items))

    shapes, bodies = bodies_with_shapes(parts, result.parts_of, model, known, floor, mapped)
    for n, columns in enumerate(bodies):
        result.keep_bodies(n, columns)
    return replace(result, shapes=shapes)


def _on_bodies(setup: Setup, job: tuple[Callable[[Any, float, Any], Any], Any]) -> Any:
    """Apply the job's function to its part, with the body model, in any process."""
    return job[0](setup.fitter.model, setup.config.body.model_sigma_m, job[1])


def _names(tracks: Assembly, setup: Setup, cuts_s: Sequence[float]) -> dict[int, int]:
    """New numbers of tracks that are joined over longer gaps."""

    def trace(track: int) -> Trace:
        pieces = tracks.own_pieces(track, ("time_s", "joints"))
        return Trace.concatenate(
            [Trace.of(track, time_s, joints, setup.skeleton) for time_s, joints in pieces]
        )

    return stitch(Ends.of(map(trace, tracks.parts_of)), setup.config.stitching, cuts_s)


def _summary(
    notes: Notes, config: PipelineConfig, frames: range, result: Assembly
) -> dict[str, Any]:
    """Entries of run.json about a run, without its inputs."""
    problems = [
        {
            "person": result.names.get(each.track, each.track),
            "frame": each.frame,
            "joint": result.joint_names[each.joint],
            "reason": each.reason,
        }
        for each in notes.problems
    ]
    dropped = {reason: frames for reason, frames in notes.dropped.items() if len(frames) > 0}

    def spans(of: dict[str, list[int]]) -> dict[str, list[list[int]]]:
        return {
            name: [[span.start, span.stop] for span in spans_of(numbers)]
            for name, numbers in of.items()
        }

    named = Notes()
    for track, each in notes.evidence.items():
        named.add(Notes(evidence={result.names.get(track, track): each}))
    mean = {name: total / rows for name, (total, rows) in sorted(named.evidence.items())}
    probable = [
        {"person": name, "evidence": round(each, 3), "probability": round(probability(each), 3)}
        for name, each in mean.items()
    ]
    return {
        "configuration": asdict(config),
        "versions": versions(),
        "frames": [frames.start, frames.stop],
        "seconds": notes.seconds,
        "people": {
            **result.counts(),
            "dropped": {reason: len(frames) for reason, frames in dropped.items()},
            "problems": problems,
        },
        "probability": probable if config.temporal else dict(sorted(notes.probable.items())),
        "dropped_frames": spans(dropped),
        "thinned_frames": spans(notes.thinned_frames),
        "repeated_pictures": spans(notes.repeated_pictures),
    }
