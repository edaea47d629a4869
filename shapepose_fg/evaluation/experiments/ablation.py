"""What each thing is worth that we do differently from the paper: added to its method, and taken from ours."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.experiments.scene_scores import mean_of, solve_and_score
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.varied import varied
from shapepose_fg.pipeline.pipeline import PipelineConfig

FRAMES = 30
"""Of each stretch."""

OURS = varied(replace(PipelineConfig(), temporal=False))
"""What each is taken from: time stands in a row of its own."""
PAPER = varied(PipelineConfig.paper())
"""What each is added to."""

SWITCHES: dict[str, tuple[str, ...]] = {
    "pairs whose rays pass each other": ("candidates.gate_m", "candidates.min_angle_deg"),
    "rho 12 cm, hips 20 cm apart": ("candidates.vote_radius_m", "proposals.separation_m"),
    "centres weighted by confidence": ("candidates.weighted_centre",),
    "what two views see is kept": ("candidates.weak", "candidates.min_view_fraction", "proposals.weak_anchors"),
    "people from pairs of 2D people, by evidence": ("proposals.evidence",),
    "60 % of the parts": ("proposals.min_parts",),
    "phantoms end early": (
        "proposals.min_grown_parts",
        "proposals.split_m",
        "association.min_observed_parts",
        "tracking.min_new_joints",
    ),
    "gaps are bridged": ("proposals.growth.bridge_m",),
    "detections are given out again": ("windows.again_alone", "refine.draft_reach_m"),
    "around bodies that others' limbs do not pull": ("refine.draft_reach_m",),
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
    "the body is fitted to the views": ("refine.body_from_views",),
    "leave-one-out": ("refine.leave_one_out",),
    "leave-one-out and the body's covariance, on every joint": (
        "refine.leave_one_out",
        "window_graph.shape_sigma_m",
        "window_graph.rho_3d",
        "refine.body_from_views",
    ),
    "3 alternations, until settled": ("refine.alternations", "refine.settled_m"),
    "a Gauss-Newton step after the network": ("body.learned.polish_steps", "body.learned.unfinished"),
    "views that contradict the body": ("refine.disagreement",),
    "offsets of the detector's joints": ("offsets.source",),
}
"""What is switched, and the settings that do it."""
QUICK = ("leave-one-out",)
"""The switches of a quick run."""


def ablation(scale: Scale) -> Experiment | None:
    """A row for each switch, the first two for none and for time."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    configs = dict(configurations(QUICK if scale.quick else tuple(SWITCHES)))
    cases = [
        Case(_case_name(name, stretch), partial(_measure, stretch, config))
        for stretch in stretches  # outside: it is simulated once
        for name, config in configs.items()
    ]

    def table(figures: Mapping[str, Figures]) -> list[str]:
        def cells(name: str) -> str:
            m = mean_of(figures[_case_name(name, stretch)] for stretch in stretches)
            return f"{m['f1']:.1f} | {m['error_mm']:.1f} | {m['nobody']:.0f} | {m['missed']:.0f}"

        head = "F1, % | MPJPE, mm | nobody | missed"
        rows = [f"| | the paper, with it: {head} | ours, without it: {head} |", rule(9)]
        rows.append(f"| **nothing switched** | {cells('paper')} | {cells('ours')} |")
        rows.append(f"| time (on the right: ours, with it) | {cells('paper + time')} | {cells('ours + time')} |")
        for switch in SWITCHES:
            if f"paper + {switch}" in configs:
                rows.append(f"| {switch} | {cells(f'paper + {switch}')} | {cells(f'ours - {switch}')} |")
        rows.append(f"| limbs are kept (over time) | - | - | - | - | {cells('ours + time - limbs')} |")
        return rows

    return Experiment("ablation", cases, table)


def configurations(switches: Sequence[str]) -> Iterator[tuple[str, PipelineConfig]]:
    """Everything that is measured, by name."""
    yield "paper", PAPER
    yield "ours", OURS
    yield "paper + time", replace(PAPER, temporal=True)
    over_time = PipelineConfig()
    yield "ours + time", over_time
    yield "ours + time - limbs", replace(over_time, motion=replace(over_time.motion, keep_limbs=False))
    for name in switches:
        yield f"paper + {name}", with_settings_of(PAPER, OURS, SWITCHES[name])
        yield f"ours - {name}", with_settings_of(OURS, PAPER, SWITCHES[name])


def with_settings_of(config: PipelineConfig, other: PipelineConfig, names: Sequence[str]) -> PipelineConfig:
    """`config` with some settings, `table.name`, of another."""
    for name in names:
        config = _with(config, name, attrgetter(name)(other))
    return config


def differing(one: Any, other: Any, prefix: str = "") -> list[str]:
    """The names of all settings in which two configurations differ, as `table.name`."""
    found = []
    for field in fields(one):
        a, b, name = getattr(one, field.name), getattr(other, field.name), f"{prefix}{field.name}"
        if is_dataclass(a):
            found += differing(a, b, f"{name}.")
        elif a != b:
            found.append(name)
    return found


def _with(config: Any, name: str, value: Any) -> Any:
    first, _, rest = name.partition(".")
    return replace(config, **{first: _with(getattr(config, first), rest, value) if rest else value})


def _case_name(name: str, stretch: Stretch) -> str:
    return f"{name}, {stretch.label}"


def _measure(stretch: Stretch, config: PipelineConfig) -> Figures:
    return solve_and_score(stretch.scene, stretch.detections, config)
