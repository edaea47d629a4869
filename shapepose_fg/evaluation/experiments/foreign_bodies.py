"""No inverse crime: truths with other bodies than the one that is fitted, and a detector with another skeleton."""

from collections.abc import Mapping
from dataclasses import dataclass

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.experiments.scene_scores import mean_of, solve_and_score
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.simulation import DetectorConfig, simulate
from shapepose_fg.simulation.foreign import DETECTOR_S_OWN, PEOPLE, people_of, recast

FRAMES = 100
"""Of each stretch."""


@dataclass(frozen=True)
class Truth:
    """What the truth is made with."""

    label: str
    """What the table calls it."""
    people: str
    """One of `PEOPLE`."""
    own_skeleton: bool = False
    """Whether the detector's joints are not the body's."""


TRUTHS = (
    Truth("the body that is fitted", PEOPLE[0]),
    Truth("every bone of its own length, +-5 %", "own bones"),
    Truth("arms 15 % longer", "long arms"),
    Truth("children of 1.2 m", "children"),
    Truth("joints of the detector's own, 18 to 46 mm off", PEOPLE[0], own_skeleton=True),
    Truth("all of these", "all of these", own_skeleton=True),
)
"""Each alone, and all together."""


def foreign(scale: Scale) -> Experiment | None:
    """The figures of each of `TRUTHS`."""
    if not scale.has_scenes:
        return None
    truths = (TRUTHS[0], TRUTHS[-1]) if scale.quick else TRUTHS
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    cases = {(truth, stretch): f"{truth.label}, {stretch.label}" for truth in truths for stretch in stretches}

    def case(truth: Truth, stretch: Stretch, name: str) -> Case:
        return Case(name, lambda: measure(truth, stretch))

    def table(figures: Mapping[str, Figures]) -> list[str]:
        means = {
            truth: mean_of(figures[name] for (other, _), name in cases.items() if other is truth)
            for truth in truths
        }
        head = "| truth | F1, % | seen: MPJPE, mm | unseen: MPJPE, mm (share of joints, %) | body: MPJPE, mm |"
        rows = [f"{head} seen inside 95 %, % | unseen |", rule(7)]
        for truth, m in means.items():
            seen = f"{m['f1']:.1f} | {m['seen_mm']:.1f}"
            unseen = f"{m['unseen_mm']:.0f} ({m['unseen_share']:.1f})"
            inside = f"{m['inside_95']:.1f} | {m['unseen_inside_95']:.1f}"
            rows.append(f"| {truth.label} | {seen} | {unseen} | {m['body_mm']:.1f} | {inside} |")
        return rows

    return Experiment("foreign", [case(*key, name) for key, name in cases.items()], table)


def measure(truth: Truth, stretch: Stretch) -> Figures:
    """A stretch with that truth, reconstructed over time by default settings."""
    scene = recast(stretch.scene, people_of(truth.people, stretch.scene.people))
    offsets = DETECTOR_S_OWN if truth.own_skeleton else None
    detections = simulate(scene, DetectorConfig(offsets=offsets), stretch.seed)
    meant = scene if offsets is None else scene.with_keypoint_offsets(offsets)
    return solve_and_score(meant, detections)
