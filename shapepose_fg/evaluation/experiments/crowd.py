"""Four people who hide each other, before few cameras, over time."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.simulation.truth import truth_of

SEED = 2000
"""A built-in scene that was not looked at while the pipeline was made."""
FRAMES = 60


def experiment(scale: Scale) -> Experiment:
    """The scene before 2, 3, 4 and 6 cameras."""
    first = Stretch("demo", range(10 if scale.quick else FRAMES), seed=SEED)
    stretches = {f"{count}": replace(first, cameras=count) for count in (2, 3, 4, 6)}
    return Experiment("crowd", [Case(name, partial(_measure, each)) for name, each in stretches.items()], _table)


def _measure(stretch: Stretch) -> Figures:
    people = stretch.reconstruct()
    scene = stretch.scene
    found = score_tracks(people, truth_of(scene), scene.fps, model=scene.body)
    joints = found.joints
    return {
        "found": 100 * joints.people_found / joints.people_true,
        "nobody": 100 * joints.people_invented / max(len(people), 1),
        "twice": joints.people_duplicated,
        "rows": len(people),
        **{name: found.as_dict()[name] for name in ("f1", "mpjpe_mm", "idf1", "seen_inside_50", "seen_inside_95")},
    }


def _table(found: Mapping[str, Figures]) -> list[str]:
    rows = []
    for count, f in found.items():
        cells = [f"{f['found']:.1f}", f"{f['nobody']:.1f}", str(f["twice"])]
        for name in ("f1", "idf1", "mpjpe_mm", "seen_inside_50", "seen_inside_95"):
            cells.append("-" if f[name] is None else f"{f[name]:.1f}")
        rows.append(f"| {count} | {' | '.join(cells)} |")
    head = "| cameras | people found, % | invented, % | twice | F1, % | IDF1, % | MPJPE, mm | 50 % | 95 % |"
    return [head, rule(9), *rows]
