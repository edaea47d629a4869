"""Stage I: the people of one frame, by evidence or, as in the paper, from their hips."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.bounds import Count, Settings, Share
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs
from shapepose_fg.proposal.hips import people_by_hips
from shapepose_fg.proposal.people_2d import without_repeats
from shapepose_fg.proposal.possible_people import Frame
from shapepose_fg.proposal.selection import choose
from shapepose_fg.proposal.thinning import thinned_points


@dataclass(frozen=True)
class ProposalConfig(Settings):
    """Settings for people from points."""

    evidence: bool = True
    """Whether people are hypotheses from pairs of 2D people, scored by evidence (`selection.py`).
    In the paper, hips of three votes anchor people (`hips.py`)."""
    min_probability: Share = 0.3
    """Minimum existence probability of a new person; later frames, or a body, decide."""
    most_people: Count = 64
    """Maximum number of people in a frame; the most probable are kept."""

    @classmethod
    def paper(cls) -> "ProposalConfig":
        """The search of section 3.1."""
        return cls(evidence=False)


@dataclass(frozen=True)
class StageOne:
    """Finds people in single frames: their 2D observations and initial joints."""

    skeleton: Skeleton
    """The detector's joints."""
    candidates: CandidateConfig
    """Settings for points from pairs of detections."""
    proposals: ProposalConfig
    """Settings for people from points."""
    book: Notebook
    """Collects notes and timings."""

    def __call__(self, detections: Detections, rig: Rig) -> Observations:
        """Find the people of a frame."""
        once, index = without_repeats(detections)
        with self.book.stage("triangulate"):
            every = triangulate_pairs(once, rig, self.candidates)
            points = thinned_points(every, self.candidates)
            self.book.thin("points", len(points.xyz) < len(every.xyz))
        with self.book.stage("propose"):
            frame = Frame(once, rig, self.skeleton, longest_bones(self.skeleton))
            if self.proposals.evidence:
                people, _ = choose(points, frame, self.proposals.min_probability)
            else:
                people = people_by_hips(points, frame)
            most = self.proposals.most_people
            self.book.thin("people", len(people) > most)
            people = people.rows(np.arange(min(len(people), most)))  # most probable first
        chosen = np.where(people.chosen >= 0, np.append(index, -1)[people.chosen], -1)
        return Observations.of(chosen, detections, people.places)
