"""The data that every process needs to solve windows (`Setup`), and the tracker made from it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.notes import Notebook, Notes
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.estimation.user_factors import ExtraFactors
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.keyframes import with_rows_between
from shapepose_fg.pipeline.runs.parts import Part
from shapepose_fg.pipeline.solve_window import Assigning, solve_window
from shapepose_fg.pipeline.windows import Engine, Span, halved
from shapepose_fg.proposal.stage_one import StageOne
from shapepose_fg.tracking.tracker import BodyScale, Tracker

FAST_M_S = 3.0
"""Speed of the fastest joints covered by the tracker's predictions, m/s: a hand that is thrown up
or strikes."""
UNSEEN_S = 0.3
"""Longest gap without detections, s, over which predictions cover joints as fast as `FAST_M_S`."""
_ON_TRIAL = 0.5
"""Factor on the required probability in single frames before a body is fitted."""
_FALSE_POSITIVE = "hardly any detections of their own, or at the position of another person"
"""Reason for dropping people when detections are reassociated."""


@dataclass(frozen=True)
class Setup:
    """Data shared by all processes: plain data, except for the user's own factors."""

    rig: Rig
    """The cameras."""
    skeleton: Skeleton
    """The detector's joints."""
    config: PipelineConfig
    """The settings."""
    fitter: BodyFitter
    """Fitter of the bodies."""
    extra_factors: ExtraFactors | None = None
    """The user's own factors."""
    noise: NoiseLaw = field(default_factory=NoiseLaw.shipped)
    """The detector's noise law."""
    estimator: EstimatorConfig = field(init=False)
    """Settings of stage II, with the motion model itself, which other processes need not know by
    name."""

    def __post_init__(self) -> None:
        estimator = replace(self.config.estimator, joints=self.skeleton.joints, noise=self.noise)
        object.__setattr__(self, "estimator", estimator)

    def solve(self, span: Span) -> Part:
        """Solve one window, in any process; returns rows of its own frames, by frame and person,
        and notes.
        """
        given = [frame for frame, _ in span.decided if frame.key]
        rows = Observations.concatenate([part for _, part in span.decided])
        windows, rig = self.config.windows, self.rig if span.rig is None else span.rig
        rounds = windows.again_alone if span.isolated else windows.again_over_time
        whole = solve_window(
            rows,
            Views.of(rig, rows.time_s),
            self.fitter,
            self.estimator,
            assigning=Assigning(given, self.skeleton, rounds, over_time=not span.isolated),
            extra_factors=self.extra_factors,
        )
        doubted = {frame.frame: frame.rig.doubted for frame in given if len(frame.rig.doubted) > 0}
        if len(doubted) > 0:
            whole = replace(whole, status=_doubted(whole, doubted))
        solution = _of_frames(whole, span.own, numbered=not self.config.temporal)
        notes = _notes(solution, len(span.own), self.config.temporal)
        left = Counter(rows.frame.tolist()) - Counter(whole.observations.frame.tolist())
        if dropped := sorted(frame for frame in left.elements() if frame in span.own):
            notes.dropped[_FALSE_POSITIVE] = dropped
        if len(given) == len(span.decided):
            return Part(self._result(solution, given, rig), notes)
        return self._with_rows_between(span, whole, self._result(whole, given, rig), notes)

    def _with_rows_between(
        self, span: Span, whole: WindowSolution, solved: Reconstruction, notes: Notes
    ) -> Part:
        """The rows of a window's own frames: those of keyframes are `solved`, the others are
        interpolated. Frames in which people do not follow the motion model are solved, too.
        """
        every = [frame for frame, _ in span.decided]
        frame, key = (np.array([getattr(each, of) for each in every]) for of in ("frame", "key"))
        time_s = np.array([each.time_s.mean() for each in every])
        # The cubic between keyframes is that of white noise on acceleration, for any `law`.
        motion = MotionModel.load(self.skeleton.joints, self.config.motion)
        interpolated = with_rows_between(solved, frame, time_s, key, motion)
        for part in map(self.solve, halved(span, whole, interpolated, self.config)):
            solved_again = np.unique(part.rows.frame)
            others = interpolated.rows(~np.isin(interpolated.frame, solved_again))
            interpolated = Reconstruction.concatenate([others, part.rows])
            problems = [each for each in notes.problems if each.frame not in solved_again]
            notes.problems = problems + part.notes.problems
            notes.add(Notes(seconds=part.notes.seconds))
        interpolated = interpolated.rows(np.lexsort((interpolated.person, interpolated.frame)))
        return Part(interpolated.rows(np.isin(interpolated.frame, list(span.own))), notes)

    def _result(self, solution: WindowSolution, given: Sequence[Input], rig: Rig) -> Reconstruction:
        """The rows of a solution, with the indices of their detections in `given`."""
        frame, candidate = solution.observations.frame, solution.observations.candidate
        detections = {each.frame: each.detections for each in given}
        place = np.full(candidate.shape, -1, dtype=np.int32)
        for number in np.unique(frame).tolist():
            of_frame = frame == number
            place[of_frame] = np.append(detections[number].place, -1)[candidate[of_frame]]
        return solution.result(place, rig, self.skeleton.joints)

    def engine(self, notebook: Notebook) -> Engine:
        """The tracker with its windows; notes are written to `notebook`."""
        config, skeleton, tracking = self.config, self.skeleton, self.config.tracking
        by_evidence = StageOne(skeleton, config.candidates, config.proposals, notebook)
        # Unexplained detections may be people with hips seen by two views; later frames decide.
        from_hips = by_evidence.of_the_rest()
        if by_evidence.proposals.evidence and not config.temporal:
            # In single frames evidence decides during reassociation.
            likely = replace(
                by_evidence.proposals,
                min_probability=_ON_TRIAL * by_evidence.proposals.min_probability,
            )
            by_evidence, tracking = (
                replace(by_evidence, proposals=likely),
                replace(tracking, min_new_joints=3),
            )
        law = self.estimator.law
        motion = MotionModel.load(skeleton.joints, config.motion, law)
        scale = BodyScale(
            longest_bones(skeleton), motion.density(np.full(len(skeleton), FAST_M_S), UNSEEN_S), law
        )
        find = (by_evidence, from_hips) if config.temporal else (by_evidence,)
        options = {"fitter": self.fitter, "drop": notebook.drop_in, "search": notebook.search}
        return Engine(
            Tracker(skeleton, scale, find, tracking, config.observations, **options), config
        )


def _doubted(solution: WindowSolution, doubted: Mapping[int, tuple[int, ...]]) -> NDArray[np.str_]:
    """(N,) statuses, if cameras are `doubted` in some frames: `CONTRADICTED` for rows that do not
    have `LEAST_JOINTS` joints seen by two other views.
    """
    used = solution.inlier.copy()
    for row, frame in enumerate(solution.observations.frame.tolist()):
        used[row][:, list(doubted.get(frame, ()))] = False
    of_two = (used.sum(axis=-1) >= 2).sum(axis=1) >= LEAST_JOINTS
    contradicted = np.isin(solution.observations.frame, list(doubted)) & ~of_two
    contradicted &= np.isin(solution.status, (Status.OK, Status.BODY_UNDETERMINED))
    return np.where(contradicted, Status.CONTRADICTED, solution.status)


def _of_frames(whole: WindowSolution, frames: set[int], *, numbered: bool) -> WindowSolution:
    """The rows of some frames, sorted by frame and person; with `numbered`, people are numbered
    from 0 within each frame.
    """
    found = whole.observations
    by_person = np.lexsort((found.track, found.frame))
    solution = whole.rows(by_person[np.isin(found.frame[by_person], list(frames))])
    if not numbered:
        return solution
    rows = solution.observations
    number = np.arange(len(rows)) - np.searchsorted(rows.frame, rows.frame)
    problems = tuple(replace(each, track=int(number[each.row])) for each in solution.problems)
    return replace(solution, observations=replace(rows, track=number), problems=problems)


def _notes(solution: WindowSolution, frames: int, over_time: bool) -> Notes:
    """Notes about a window with this number of own `frames`."""
    content = {"problems": list(solution.problems), "factors": solution.factors}
    notes = Notes(frames, dict(solution.seconds), **content)
    rows = solution.observations
    known = np.isfinite(rows.evidence)
    if over_time:
        for track in np.unique(rows.track[known]).tolist():
            evidence = rows.evidence[known & (rows.track == track)]
            notes.evidence[track] = float(evidence.sum()), len(evidence)
    else:
        tenths = (f"{tenth / 10:.1f}" for tenth in np.floor(10 * rows.evidence[known]))
        notes.probable = dict(Counter(tenths))
    return notes


def find_people(
    detections: Detections, rig: Rig, skeleton: Skeleton, config: PipelineConfig
) -> Observations:
    """Stage I for one frame: people's 2D observations and initial joints."""
    return StageOne(skeleton, config.candidates, config.proposals, Notebook())(detections, rig)
