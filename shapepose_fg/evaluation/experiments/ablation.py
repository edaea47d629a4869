"""What each thing is worth that we do differently from the paper: added to its method, and taken from ours."""
# ruff: noqa: RUF009  (values of the class `Varied` itself: they cover properties of its base)

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any

from shapepose_fg.estimation.estimator_config import RefineConfig, WindowGraphConfig
from shapepose_fg.evaluation.experiments.experiment import Experiment, columns
from shapepose_fg.evaluation.experiments.scenes import FRAME_BY_FRAME, OVER_TIME, Scale, case
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.proposal.candidates import CandidateConfig
from shapepose_fg.proposal.proposals import ProposalConfig
from shapepose_fg.tracking.tracker import TrackingConfig

FRAMES = 30
"""Of each segment."""
COLUMNS = columns(
    *(("F1, %", "f1"), ("MPJPE, mm", "mpjpe_mm"), ("FP", "false_positives", 0, "sum")),
    ("missed", "people_missed", 0, "sum"),
)


@dataclass(frozen=True)
class Varied(PipelineConfig):
    """`PipelineConfig` whose steps' own numbers, which `method` chooses there, are fields."""

    candidates: CandidateConfig = CandidateConfig()
    proposals: ProposalConfig = ProposalConfig()
    tracking: TrackingConfig = TrackingConfig()
    window_graph: WindowGraphConfig = WindowGraphConfig()
    refine: RefineConfig = RefineConfig()


def varied(config: PipelineConfig) -> Varied:
    """The same settings, of which all can be replaced; those that only choose the steps' numbers say nothing."""
    chosen = ("method", "people", "solving")
    return Varied(**{each.name: getattr(config, each.name) for each in fields(Varied) if each.name not in chosen})


OURS = varied(FRAME_BY_FRAME)
PAPER = varied(PipelineConfig.paper())
"""What each is added to; what each is taken from is ours frame by frame, as time stands in a row of its own."""

SWITCHES: dict[str, tuple[str, ...]] = {
    "pairs whose rays pass each other": ("candidates.gate_m", "candidates.min_angle_deg"),
    "rho 12 cm, hips 20 cm apart": ("candidates.vote_radius_m", "proposals.separation_m"),
    "centres weighted by confidence": ("candidates.weighted_centre",),
    "what two views see is kept": ("candidates.weak", "candidates.min_view_fraction", "proposals.weak_anchors"),
    "people from pairs of 2D people, by evidence": ("proposals.evidence",),
    "60 % of the parts": ("proposals.min_parts",),
    "false positives end early": (
        "proposals.min_grown_parts",
        "proposals.split_m",
        "proposals.min_observed_parts",
        "tracking.min_new_joints",
    ),
    "gaps are bridged": ("proposals.growth.bridge_m",),
    "reassociation": ("windows.again_alone",),
    "X_0 is made complete": ("refine.complete_start",),
    "sigma as measured": (
        "observations.confidence_power",
        "observations.least_weight",
        "observations.by_joint",
        "observations.sigma_m",
        "observations.floor_rad",
    ),
    "lengths at the joint, not pixels": ("observations.fixed_depth_m",),
    "robust kernel": ("observations.kernel",),
    "the body pulls with its covariance": ("window_graph.shape_sigma_m",),
    "the body pulls every joint": ("window_graph.rho_3d",),
    "the body is fitted to the views, leaving one out": ("refine.body_from_views",),
    "and pulls every joint with its covariance": (
        "refine.body_from_views",
        "window_graph.shape_sigma_m",
        "window_graph.rho_3d",
    ),
    "3 alternations, until settled": ("refine.alternations", "refine.settled_m"),
    "a Gauss-Newton step after the network": ("body.polish_steps", "body.unfinished"),
    "views that contradict the body": ("refine.disagreement",),
    "offsets of the detector's joints": ("offsets.source",),
}
"""What is switched, and the settings that do it."""


def ablation(scale: Scale) -> Experiment:
    """A row for each configuration, over one segment of each sequence."""
    rows = {
        name: [case(f"{name} {each.label}", each, config) for each in scale.one_each(FRAMES)]
        for name, config in configurations(("robust kernel",) if scale.quick else tuple(SWITCHES))
    }
    return Experiment("ablation", rows, COLUMNS)


def configurations(switches: Sequence[str]) -> Iterator[tuple[str, PipelineConfig]]:
    """Everything that is measured, by name."""
    yield "the paper", PAPER
    yield "the paper + time", replace(PAPER, temporal=True)
    for name in switches:
        yield f"the paper + {name}", with_settings_of(PAPER, OURS, SWITCHES[name])
    yield "ours, frame by frame", FRAME_BY_FRAME
    yield "ours, over time", OVER_TIME
    for name in switches:
        yield f"ours - {name}", with_settings_of(OURS, PAPER, SWITCHES[name])
    without_limbs = replace(OVER_TIME, motion=replace(OVER_TIME.motion, keep_limbs=False))
    yield "ours, over time - limbs are kept", without_limbs


def with_settings_of(config: PipelineConfig, other: PipelineConfig, names: Sequence[str]) -> PipelineConfig:
    """`config` with some settings, `table.name`, of another."""
    for name in names:
        config = _with(config, name, attrgetter(name)(other))
    return config


def _with(config: Any, name: str, value: Any) -> Any:
    first, _, rest = name.partition(".")
    return replace(config, **{first: _with(getattr(config, first), rest, value) if rest else value})
