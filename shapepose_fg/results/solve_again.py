"""Solves rows of a result again from their own observations: after manual corrections, and for
their graphs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from factors.keys import MAX_FRAME, MAX_PERSON
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.result_body import model_of
from shapepose_fg.core.arrays import Index, Mask, Whole
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import LEAST_STEP_S, segments
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.estimation.user_factors import ExtraFactors
from shapepose_fg.estimation.window_solution import PersonGraph, WindowSolution
from shapepose_fg.io.calibration.reading import cameras_of
from shapepose_fg.io.config import ANOTHER_VERSION, config_from
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.keyframes import tracked_rows, with_rows_like
from shapepose_fg.pipeline.person_shapes import with_person_shapes
from shapepose_fg.pipeline.solve_window import solve_window
from shapepose_fg.pipeline.windows import near_border, window_stop


@dataclass(frozen=True)
class Solver:
    """The data for solving rows of a result again."""

    rig: Rig
    """The cameras, in the order of the observations' views."""
    config: PipelineConfig
    """The settings."""
    fitter: BodyFitter
    """Fitter of the bodies, with the detector's offsets (`run["keypoint_offsets"]`)."""
    noise: NoiseLaw = field(default_factory=NoiseLaw.shipped)
    """The detector's noise law (`run["noise_law"]`)."""

    @classmethod
    def of(cls, people: Reconstruction, rig: Rig, run_file: Path = Path("run.json")) -> "Solver":
        """The data for a result of these cameras; raises InputError if `run_file` lacks its
        settings.
        """
        configuration = people.run.get("configuration")
        if not isinstance(configuration, dict):
            raise InputError(
                f"{run_file}: configuration is missing; reconstruct the recording again"
            )
        config = config_from(configuration, PipelineConfig, run_file, cure=ANOTHER_VERSION)
        model = model_of(people.run, run_file=run_file)
        fitter = make_fitter(config.body, model.with_keypoints(tuple(people.joint_names.tolist())))
        return cls(rig, config, fitter, NoiseLaw.read(people.run, run_file))

    @classmethod
    def read(cls, folder: Path, people: Reconstruction) -> "Solver":
        """The data for a result loaded from `folder`; raises InputError as `of` does, and for other
        cameras.
        """
        rig, table = cameras_of(folder), people.observations
        if table is not None and tuple(table.view_names.tolist()) != rig.names:
            problem = "the cameras are not those of observations.npz"
            raise InputError(f"{folder / CAMERAS}: {problem}; reconstruct the recording again")
        return cls.of(people, rig, folder / "run.json")


def solve_rows(
    rows: Reconstruction, solver: Solver, extra_factors: ExtraFactors | None = None
) -> Reconstruction:
    """Solve some people of a result again, each over all of their rows, in the windows of the whole
    recording.

    Detections keep their people; they are gated again. `extra_factors` are factors of your own;
    their `window.track` is the result's person. Raises ValueError if `rows` have no observations.
    """
    parts, keyframe_s = [], solver.config.windows.keyframe_s
    motion = MotionModel.load(tuple(rows.joint_names.tolist()), solver.config.motion)
    for own, part, solution in _solved(rows, solver, extra_factors):
        assert part.observations is not None
        solved = solution.result(part.observations.candidate, solver.rig, part.joint_names.tolist())
        if keyframe_s > 0:
            solved = with_rows_like(solved, rows.rows(_rows_of(rows, own, own, 0.0)), motion)
        parts.append(solved.rows(_inside(solved.frame, own)))
    solved = replace(Reconstruction.concatenate(parts), run=rows.run) if parts else rows
    if solver.fitter.model is None or not solver.config.temporal:
        return solved
    floor = Floor.from_dict(rows.run.get("floor"))
    sigma_m = solver.config.body.model_sigma_m
    return with_person_shapes(solved, solver.fitter.model, floor=floor, sigma_m=sigma_m)


def window_solutions(
    people: Reconstruction, rig: Rig, *, extra_factors: ExtraFactors | None = None
) -> Iterator[PersonGraph]:
    """Yield all people of all windows of a result as graphs, with the values and marginals of the
    result.

    Joints and covariances are those of `people`; the graphs are solved again from their
    observations, with the cameras `rig`, in the order of the views. With `extra_factors`, with the
    result's person as `window.track`, joints and covariances are those of the graph. Windows
    overlap: frames near a border are in two. Raises InputError if `people.run` has no settings,
    ValueError if there are no observations.
    """
    solver = Solver.of(people, rig)
    for _, part, solution in _solved(people, solver, extra_factors, again=True):
        for person in solution.people:
            as_reported = {
                "joints": part.joints[person.rows],
                "covariance": part.covariance[person.rows],
            }
            yield person if extra_factors is not None else replace(person, **as_reported)


def solved_around(
    people: Reconstruction,
    solver: Solver,
    person: int,
    frame: int,
    extra_factors: ExtraFactors | None = None,
) -> PersonGraph | None:
    """Graph of a person's window that contains this frame, solved again from the person's own
    observations; None if it is empty. With `extra_factors`, all people in the window are solved.
    The observations must be present.
    """
    if extra_factors is None:
        people = people.rows(
            people.person == person if solver.config.temporal else people.frame == frame
        )
    found = [
        solution for _, _, solution in _solved(people, solver, extra_factors, frame, again=True)
    ]
    return next(
        (each for solution in found for each in solution.people if each.person == person), None
    )


def _solved(
    rows: Reconstruction,
    solver: Solver,
    extra_factors: ExtraFactors | None,
    frame: int | None = None,
    *,
    again: bool = False,
) -> Iterator[tuple[range, Reconstruction, WindowSolution]]:
    """Solve all windows, or that of one `frame`; yields its own frames, the rows including the
    overlap, and the solution: with `again` that of the result, from its joints and, without user
    factors, the detections that it used.
    """
    if rows.observations is None:
        raise ValueError(
            "rows without observations cannot be solved again; reconstruct the recording again"
        )
    config, rig = solver.config, solver.rig
    _check_rows(rows, over_time=config.temporal)
    settings = replace(
        config.estimator, joints=tuple(rows.joint_names.tolist()), noise=solver.noise
    )
    for own, segment in _windows(rows, config):
        if frame is not None and frame not in own:
            continue
        part = rows.rows(_rows_of(rows, own, segment, config.windows.shared_s))
        if config.windows.keyframe_s > 0:
            part = part.rows(tracked_rows(part))
        assert part.observations is not None
        # Initialised from the views, as the current joints may be another person's, unless they are
        # to be found again.
        start = part.joints if again else np.full_like(part.joints, np.nan)
        observations = part.observations.observations(start, part.time_s)
        if again and extra_factors is None:
            used = part.observations.used[..., None] | ~observations.seen[..., None]
            # Coordinate of a detection that the result did not use, outside of all
            # gates, px.
            observations = replace(observations, xy=np.where(used, observations.xy, 1e6))
        views = Views.of(rig, observations.time_s)
        found = solve_window(
            observations, views, solver.fitter, settings, extra_factors=extra_factors
        )
        yield own, part, found


def _check_rows(rows: Reconstruction, *, over_time: bool) -> None:
    """Raise InputError unless rows are consistent over time: files may be edited by hand."""
    order = np.lexsort((rows.frame, rows.person))
    person, frame, time_s = (each[order] for each in (rows.person, rows.frame, rows.time_s))
    same = np.diff(person) == 0
    twice = np.flatnonzero(same & (np.diff(frame) == 0))
    problem = (
        f"person {person[twice[0]]} occurs twice in frame {frame[twice[0]]}"
        if len(twice) > 0
        else ""
    )
    if len(rows) > 0 and (person.max() > MAX_PERSON or frame.max() > MAX_FRAME):
        problem = f"persons must be at most {MAX_PERSON} and frames {MAX_FRAME}"
    if over_time and not problem:
        wrong = ~np.isfinite(time_s)
        wrong[1:] |= same & ~(np.diff(time_s) > LEAST_STEP_S)
        if wrong.any():
            at = int(wrong.argmax())
            problem = (
                f"time_s must increase with the frames, but does not at person {person[at]}, "
                f"frame {frame[at]}"
            )
    if problem:
        raise InputError(
            f"people.npz: {problem}; restore the file or reconstruct the recording again"
        )


def _rows_of(rows: Reconstruction, own: range, segment: range, overlap_s: float) -> Index:
    """Rows in a window's `own` frames, and in those within `overlap_s` of its borders, not beyond
    cuts.
    """
    frame, time_s = rows.frame, rows.time_s
    known, first = np.unique(frame, return_index=True)
    # The time of a border frame without rows is interpolated.
    begin_s, end_s = np.interp([own.start, own.stop], known, time_s[first])
    before = near_border(time_s, begin_s, overlap_s) & (frame < own.start)
    after = near_border(time_s, end_s, overlap_s) & (frame >= own.stop)
    return np.flatnonzero((_inside(frame, own) | before | after) & _inside(frame, segment))


def _windows(rows: Reconstruction, config: PipelineConfig) -> list[tuple[range, range]]:
    """Windows with any of `rows`: their own frames, and the segment between cuts that contains
    them.

    Windows are those in which the recording was solved; single frames are windows of their own.
    """
    if not config.temporal:
        return [
            (frames, frames) for frames in (range(t, t + 1) for t in np.unique(rows.frame).tolist())
        ]
    first, last = (int(rows.frame.min()), int(rows.frame.max()) + 1) if len(rows) > 0 else (0, 0)
    cuts: Sequence[int] = rows.run.get("cuts", ())
    windows = []
    for span in covered_frames(rows.run) or [range(first, last)]:
        for segment in segments(span, cuts):
            start = segment.start
            while start < segment.stop:
                stop = window_stop(start, segment.stop, config.batch_frames)
                windows.append((range(start, stop), segment))
                start = stop
    return [(own, segment) for own, segment in windows if _inside(rows.frame, own).any()]


def _inside(frame: Whole, span: range) -> Mask:
    """(N,) mask of frames in `span`."""
    return (frame >= span.start) & (frame < span.stop)
