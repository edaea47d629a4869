"""Settings of which more is varied than a user turns: what experiments switch one by one."""
# ruff: noqa: RUF009  (values of the class itself: they cover properties of its base)

from dataclasses import dataclass, fields

from shapepose_fg.estimation.estimator_config import RefineConfig, WindowGraphConfig
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.proposal.association import AssociationConfig
from shapepose_fg.proposal.candidates import CandidateConfig
from shapepose_fg.proposal.proposals import ProposalConfig
from shapepose_fg.tracking.tracker import TrackingConfig


@dataclass(frozen=True)
class Varied(PipelineConfig):
    """`PipelineConfig` whose steps' own numbers, which `method` chooses there, are fields."""

    candidates: CandidateConfig = CandidateConfig()
    proposals: ProposalConfig = ProposalConfig()
    association: AssociationConfig = AssociationConfig()
    tracking: TrackingConfig = TrackingConfig()
    window_graph: WindowGraphConfig = WindowGraphConfig()
    refine: RefineConfig = RefineConfig()


def varied(config: PipelineConfig) -> Varied:
    """The same settings, of which all can be replaced; those that only choose the steps' numbers say nothing."""
    chosen = ("method", "people", "solving")
    return Varied(**{each.name: getattr(config, each.name) for each in fields(Varied) if each.name not in chosen})
