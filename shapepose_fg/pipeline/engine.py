"""All steps from frames to rows, made of the settings: what every process that takes part needs."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapepose_fg.body.fitting.bone_reach import longest_bones
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.estimator import Estimator, ExtraFactors
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.runs.notes import Notebook
from shapepose_fg.pipeline.windows import Engine, WindowSolver
from shapepose_fg.proposal.association import associate
from shapepose_fg.proposal.candidates import PairPoints, triangulate_pairs, vote
from shapepose_fg.proposal.hypotheses import Frame
from shapepose_fg.proposal.people_2d import without_repeats
from shapepose_fg.proposal.proposals import propose
from shapepose_fg.proposal.selection import choose
from shapepose_fg.proposal.thinning import thinned_candidates, thinned_points
from shapepose_fg.tracking.tracker import BodyScale, Tracker

FAST_M_S = 3.0
"""The tracker predicts joints as if they moved so fast: a hand that is thrown up or strikes."""
_ON_TRIAL = 0.5
"""Share of the probability asked for otherwise that is enough in frames that stand alone: a body will tell."""


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

    @cached_property
    def solver(self) -> WindowSolver:
        """Solves windows."""
        config = self.config
        settings = EstimatorConfig(config.observations, config.window_graph, config.refine, config.motion)
        estimator = Estimator(self.rig, self.fitter, self.skeleton.joints, settings)
        return WindowSolver(
            estimator, self.skeleton, config.tracking.assignment, config.windows, self.extra_factors
        )

    def engine(self, book: Notebook) -> Engine:
        """Follows people and solves windows; what it has to say goes into `book`."""
        config, skeleton = self.config, self.skeleton
        # What evidence leaves over may be people whose hips two views saw: whether they are, time tells.
        candidates = replace(config.candidates, min_votes=1)
        hips = replace(config, candidates=candidates, proposals=replace(config.proposals, evidence=False))
        likely = replace(config.proposals, min_probability=_ON_TRIAL * config.proposals.min_probability)
        alone = config.proposals.evidence and not config.temporal
        sure = replace(config, proposals=likely) if alone else config

        def find(detections: Detections, rig: Rig, weak: bool) -> Observations:
            return find_people(detections, rig, skeleton, hips if weak else sure, book)

        # In frames that stand alone evidence decides, when the detections are given out again.
        tracking = replace(config.tracking, min_new_joints=3) if alone else config.tracking
        motion = MotionModel.load(skeleton.joints, config.motion)
        scale = BodyScale(longest_bones(skeleton), motion.psd(np.full(len(skeleton), FAST_M_S)))
        tracker = Tracker(
            skeleton, scale, find, tracking, config.observations, weak_births=config.temporal, drop=book.drop_in
        )
        return Engine(tracker, config.following, self.solver, frames=config.batch_frames)


def find_people(
    detections: Detections, rig: Rig, skeleton: Skeleton, config: PipelineConfig, book: Notebook | None = None
) -> Observations:
    """Stage I, one frame: the people's 2D observations and where their joints are to begin with."""
    book = Notebook() if book is None else book
    if not config.proposals.evidence:
        return _anchored_at_hips(detections, rig, skeleton, config, book)
    once, index = without_repeats(detections)
    points = _points(once, rig, config, book)
    with book.stage("propose"):
        frame = Frame(once, rig, skeleton, longest_bones(skeleton))
        people, _ = choose(points, frame, config.proposals.min_probability)
    chosen = np.where(people.chosen >= 0, np.append(index, -1)[people.chosen], -1)
    return Observations.of(chosen, detections, people.places)


def _points(detections: Detections, rig: Rig, config: PipelineConfig, book: Notebook) -> PairPoints:
    """Pairs of detections, triangulated; not too many."""
    with book.stage("triangulate"):
        every = triangulate_pairs(detections, rig, config.candidates)
        points = thinned_points(every, config.candidates)
        book.thin("points", len(points.xyz) < len(every.xyz))
    return points


def _anchored_at_hips(
    detections: Detections, rig: Rig, skeleton: Skeleton, config: PipelineConfig, book: Notebook
) -> Observations:
    """Stage I as the paper has it: votes, hips that anchor people, and joints linked to them."""
    points = _points(detections, rig, config, book)
    with book.stage("vote"):
        every = vote(points, detections, len(rig), config.candidates)
        candidates = thinned_candidates(every, detections, config.candidates)
        book.thin("candidates", len(candidates) < len(every))
    with book.stage("propose"):
        proposals = propose(candidates, detections, skeleton, rig.up_vector, config.proposals)
    with book.stage("associate"):
        observations, phantoms = associate(proposals, candidates, detections, rig, skeleton, config.association)
    for reason, count in (*proposals.dropped.items(), ("hardly any joint seen by two views", phantoms)):
        book.drop(reason, count)
    return observations
