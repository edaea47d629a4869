"""The settings of the whole way, and the paper's."""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Interval

from shapepose_fg.body.fitting.fitters import BodyConfig
from shapepose_fg.core.bounds import Settings
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.estimation.estimator_config import RefineConfig
from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.estimation.motion_model import MotionConfig
from shapepose_fg.estimation.window_graph import WindowGraphConfig
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.proposal.association import AssociationConfig
from shapepose_fg.proposal.candidates import CandidateConfig
from shapepose_fg.proposal.proposals import ProposalConfig
from shapepose_fg.tracking.following import FollowingConfig
from shapepose_fg.tracking.stitching import StitchingConfig
from shapepose_fg.tracking.tracker import TrackingConfig


@dataclass(frozen=True)
class PipelineConfig(Settings):
    """The settings of every step, and how the work is cut."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    """Stage I (b, c): pairs of views to 3D joint candidates."""
    proposals: ProposalConfig = field(default_factory=ProposalConfig)
    """Stage I (d): candidates to people."""
    association: AssociationConfig = field(default_factory=AssociationConfig)
    """Stage I (e): people to their 2D observations."""
    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """How far a 2D observation is trusted."""
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    """People over time: how they are followed from frame to frame."""
    following: FollowingConfig = field(default_factory=FollowingConfig)
    """People over time: what becomes of tracks."""
    stitching: StitchingConfig = field(default_factory=StitchingConfig)
    """People over time: who comes back after a longer time out of sight."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """People over time: how frames are cut into windows, and how often detections are given out again."""
    window_graph: WindowGraphConfig = field(default_factory=WindowGraphConfig)
    """Stage II: the factor graph of a person."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """Stage II: how frames hang together."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Stage II: how bodies are fitted."""
    offsets: OffsetConfig = field(default_factory=OffsetConfig)
    """Stage II: where the detector puts its joints on the body."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Stage II: the alternation."""
    temporal: bool = True
    """People over time: identities, motion, one shape a person. Without it every frame stands alone."""
    batch_frames: Annotated[int, Interval(ge=1, le=10000)] = 96
    """Frames that are solved together and returned: bodies are fitted fastest by the hundred."""
    threads: Annotated[int, Interval(ge=1, le=256)] = 1
    """Threads of torch while bodies are fitted: the matrices are small, and where cores are busy a second thread
    costs more than it brings."""

    @classmethod
    def paper(cls) -> "PipelineConfig":
        """The method as the paper has it written in section 3, without what we settled differently."""
        return cls(
            candidates=CandidateConfig.paper(),
            proposals=ProposalConfig.paper(),
            association=AssociationConfig.paper(),
            observations=ObservationConfig.paper(),
            tracking=TrackingConfig(min_new_joints=1),
            windows=WindowConfig(again_alone=0),
            window_graph=WindowGraphConfig.paper(),
            body=BodyConfig.paper(),
            offsets=OffsetConfig(source="none"),
            refine=RefineConfig.paper(),
            temporal=False,
        )
