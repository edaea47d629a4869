"""All steps from frames to rows, made of the settings: what every process that takes part needs."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.window_graph import ExtraFactors
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.runs.notes import Notebook
from shapepose_fg.pipeline.solve_window import Assigning, solve_window
from shapepose_fg.pipeline.windows import Engine, Span
from shapepose_fg.proposal.association import associate
from shapepose_fg.proposal.candidates import CandidateConfig, PairPoints, triangulate_pairs, vote
from shapepose_fg.proposal.people_2d import without_repeats
from shapepose_fg.proposal.possible_people import Frame
from shapepose_fg.proposal.proposals import ProposalConfig, propose
from shapepose_fg.proposal.selection import choose
from shapepose_fg.proposal.thinning import thinned_candidates, thinned_points
from shapepose_fg.tracking.tracker import BodyScale, Tracker

FAST_M_S = 3.0
"""The tracker predicts joints as if they moved so fast: a hand that is thrown up or strikes."""
UNSEEN_S = 0.3
"""Over such gaps it must."""
_ON_TRIAL = 0.5
"""Share of the probability asked for otherwise that is enough in frames that stand alone: a body will tell."""


@dataclass(frozen=True)
class Solved:
    """A window that is done: its own frames."""

    solution: WindowSolution
    """The rows."""
    frames: int
    """How many frames they are of."""
    false_positives: tuple[int, ...]
    """The frame of each row that was left with no detections of its own when they were reassociated."""


@dataclass(frozen=True)
class Setup:
    """What all processes share: plain data, but for factors of the user's own."""

    rig: Rig
    """The cameras."""
    skeleton: Skeleton
    """The detector's joints."""
    config: PipelineConfig
    """The settings."""
    fitter: BodyFitter
    """Fits bodies."""
    extra_factors: ExtraFactors | None = None
    """The user's own factors."""

    def solve(self, span: Span) -> Solved:
        """One window, in whatever process."""
        config, given = self.config, [frame for frame, _ in span.decided]
        rows = Observations.concatenate([part for _, part in span.decided])
        rounds = config.windows.again_alone if span.alone else config.windows.again_over_time
        assigning = Assigning(given, self.skeleton, rounds, over_time=not span.alone)
        solution = solve_window(
            rows,
            Views.of(self.rig),
            self.fitter,
            replace(config.estimator, joints=self.skeleton.joints),
            assigning=assigning,
            extra_factors=self.extra_factors,
        )
        own = {frame.frame for frame in given[span.start : span.stop]}
        left = Counter(rows.frame.tolist()) - Counter(solution.observations.frame.tolist())
        return Solved(
            solution.rows(np.flatnonzero(np.isin(solution.observations.frame, list(own)))),
            frames=span.stop - span.start,
            false_positives=tuple(sorted(frame for frame in left.elements() if frame in own)),
        )

    def engine(self, book: Notebook) -> Engine:
        """Follows people; what it has to say goes into `book`."""
        config, skeleton, sure = self.config, self.skeleton, StageOne.of(self.config)
        # What evidence leaves over may be people whose hips two views saw: whether they are, time tells.
        hips = replace(sure.by_hips(), candidates=replace(sure.candidates, min_votes=1))
        tracking = config.tracking
        if sure.proposals.evidence and not config.temporal:
            # In frames that stand alone evidence decides, when the detections are reassociated.
            likely = replace(sure.proposals, min_probability=_ON_TRIAL * sure.proposals.min_probability)
            sure, tracking = replace(sure, proposals=likely), replace(tracking, min_new_joints=3)

        def find(detections: Detections, rig: Rig, weak: bool) -> Observations:
            return (hips if weak else sure).people(detections, rig, skeleton, book)

        motion = MotionModel.load(skeleton.joints, config.motion, config.law)
        density = motion.density(np.full(len(skeleton), FAST_M_S), UNSEEN_S)
        scale = BodyScale(longest_bones(skeleton), density, config.law)
        tracker = Tracker(
            skeleton, scale, find, tracking, config.observations, weak_births=config.temporal, drop=book.drop_in
        )
        return Engine(tracker, config)


def find_people(
    detections: Detections, rig: Rig, skeleton: Skeleton, config: PipelineConfig, book: Notebook | None = None
) -> Observations:
    """Stage I, one frame: the people's 2D observations and where their joints are to begin with."""
    return StageOne.of(config).people(detections, rig, skeleton, Notebook() if book is None else book)


@dataclass(frozen=True)
class StageOne:
    """How people are found in one frame."""

    candidates: CandidateConfig
    """Pairs of views to 3D joint candidates."""
    proposals: ProposalConfig
    """Candidates to people, and people to their 2D observations."""

    @classmethod
    def of(cls, config: PipelineConfig) -> "StageOne":
        """As the settings have it."""
        return cls(config.candidates, config.proposals)

    def by_hips(self) -> "StageOne":
        """The same with people sought by their hips, as in the paper, and not judged by evidence."""
        return replace(self, proposals=replace(self.proposals, evidence=False))

    def people(self, detections: Detections, rig: Rig, skeleton: Skeleton, book: Notebook) -> Observations:
        """The people of a frame."""
        if not self.proposals.evidence:
            return self._by_hips(detections, rig, skeleton, book)
        once, index = without_repeats(detections)
        points = self._points(once, rig, book)
        with book.stage("propose"):
            frame = Frame(once, rig, skeleton, longest_bones(skeleton))
            people, _ = choose(points, frame, self.proposals.min_probability)
        chosen = np.where(people.chosen >= 0, np.append(index, -1)[people.chosen], -1)
        return Observations.of(chosen, detections, people.places)

    def _points(self, detections: Detections, rig: Rig, book: Notebook) -> PairPoints:
        """Pairs of detections, triangulated; not too many."""
        with book.stage("triangulate"):
            every = triangulate_pairs(detections, rig, self.candidates)
            points = thinned_points(every, self.candidates)
            book.thin("points", len(points.xyz) < len(every.xyz))
        return points

    def _by_hips(self, detections: Detections, rig: Rig, skeleton: Skeleton, book: Notebook) -> Observations:
        """As the paper has it: votes, hips that anchor people, and joints linked to them."""
        points = self._points(detections, rig, book)
        with book.stage("vote"):
            every = vote(points, detections, len(rig), self.candidates)
            candidates = thinned_candidates(every, detections, self.candidates)
            book.thin("candidates", len(candidates) < len(every))
        with book.stage("propose"):
            proposals = propose(candidates, detections, skeleton, rig.up_vector, self.proposals)
        with book.stage("associate"):
            observations, phantoms = associate(proposals, candidates, detections, rig, skeleton, self.proposals)
        for reason, count in (*proposals.dropped.items(), ("hardly any joint seen by two views", phantoms)):
            book.drop(reason, count)
        return observations
