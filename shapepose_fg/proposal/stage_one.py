"""Stage I: the people of one frame, by evidence or from their hips."""

from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.association import associate
from shapepose_fg.proposal.candidates import CandidateConfig, PairPoints, triangulate_pairs, vote
from shapepose_fg.proposal.people_2d import without_repeats
from shapepose_fg.proposal.possible_people import Frame
from shapepose_fg.proposal.proposals import ProposalConfig, propose
from shapepose_fg.proposal.selection import choose
from shapepose_fg.proposal.thinning import thinned_candidates, thinned_points

_POINTS_OF_FEW, _CANDIDATES_OF_FEW = 1000, 50
"""Maximum number of points and of candidates per joint, if few people are expected."""


@dataclass(frozen=True)
class StageOne:
    """Finds people in single frames: their 2D observations and initial joints."""

    skeleton: Skeleton
    """The detector's joints."""
    candidates: CandidateConfig
    """Settings for 3D joint candidates."""
    proposals: ProposalConfig
    """Settings for people from candidates, and their 2D observations."""
    notebook: Notebook
    """Collects notes and timings."""

    def of_the_rest(self) -> "StageOne":
        """Return a variant for what evidence leaves unexplained: it grows people from hips that two
        views saw, as in the paper, and expects few, so that fewer points and candidates are kept.
        """
        limits = {"most_points": _POINTS_OF_FEW, "most_candidates": _CANDIDATES_OF_FEW}
        candidates = replace(self.candidates, min_votes=1, **limits)
        proposals = replace(self.proposals, evidence=False)
        return replace(self, candidates=candidates, proposals=proposals)

    def __call__(self, detections: Detections, rig: Rig) -> Observations:
        """Find the people of a frame."""
        if not self.proposals.evidence:
            return self._by_hips(detections, rig)
        once, index = without_repeats(detections)
        points = self._points(once, rig)
        with self.notebook.stage("propose"):
            frame = Frame(once, rig, self.skeleton, longest_bones(self.skeleton))
            people, _ = choose(points, frame, self.proposals.min_probability)
            most = self.proposals.most_people
            self.notebook.thin("people", len(people) > most)
            people = people.rows(np.arange(min(len(people), most)))  # most probable first
        chosen = np.where(people.chosen >= 0, np.append(index, -1)[people.chosen], -1)
        return Observations.of(chosen, detections, people.places)

    def _points(self, detections: Detections, rig: Rig) -> PairPoints:
        """Triangulated pairs of detections, thinned."""
        with self.notebook.stage("triangulate"):
            every = triangulate_pairs(detections, rig, self.candidates)
            points = thinned_points(every, self.candidates)
            self.notebook.thin("points", len(points.xyz) < len(every.xyz))
        return points

    def _by_hips(self, detections: Detections, rig: Rig) -> Observations:
        """The variant of the paper: votes, hips as anchors, and joints linked to them."""
        points, skeleton, notebook = self._points(detections, rig), self.skeleton, self.notebook
        if (
            not np.isin(points.joint, skeleton.root).any()
            and not np.isin(skeleton.hips, points.joint).all()
        ):
            return Observations.of(
                np.full((0, len(skeleton), len(rig)), -1),
                detections,
                np.zeros((0, len(skeleton), 3)),
            )
        with notebook.stage("vote"):
            every = vote(points, detections, len(rig), self.candidates)
            candidates = thinned_candidates(every, detections, self.candidates)
            notebook.thin("candidates", len(candidates) < len(every))
        with notebook.stage("propose"):
            proposals = propose(candidates, detections, skeleton, rig.up_vector, self.proposals)
        with notebook.stage("associate"):
            observations, phantoms = associate(
                proposals, candidates, detections, rig, skeleton, self.proposals
            )
        for reason, count in (
            *proposals.dropped.items(),
            ("hardly any joint seen by two views", phantoms),
        ):
            notebook.drop(reason, count)
        return observations
