"""Shelf, PCP by actor and limb: ours and others, from the same detections and by the same protocol."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.others import OTHERS, read_others
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.evaluation.footage import SHELF_FPS, shelf_footage
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.opponent.opponent import find_everybody
from shapepose_fg.evaluation.opponent.over_time import over_time
from shapepose_fg.evaluation.shelf import ACTORS, LIMB_NAMES, evaluate_shelf, read_shelf_ground_truth
from shapepose_fg.evaluation.smpl_only import SamePeople
from shapepose_fg.pipeline.pipeline import PipelineConfig

METHODS = (
    "ours, over time",
    "ours, frame by frame",
    "SMPL-only",
    "opponent, over time",
    "opponent, frame by frame",
    *OTHERS,
)
"""The columns."""
PAPER = {
    "the paper": "99.1 / 93.5 / 98.1, 96.9",
    "Dong et al. 2019": "98.6 / 93.7 / 97.8, 96.7",
    "Zhang et al. 2020, without time": "96.5 / 86.8 / 97.0, 93.4",
}
"""What the paper's table has: actors 1 / 2 / 3, Avg."""


def shelf_others(scale: Scale, others: Path | None = None) -> Experiment | None:
    """All methods on the whole recording; results of other systems are read from `others`."""
    if scale.shelf is None or scale.quick:
        return None
    cases = [
        Case("with time", partial(_with_time, scale.shelf)),
        Case("without time", partial(_without_time, scale.shelf)),
        Case("opponent", partial(_opponent, scale.shelf)),
    ]
    if others is not None and (others / "shelf").is_dir():
        cases.append(Case("others", partial(_others, scale.shelf, others)))
    return Experiment("shelf others", cases, _table)


def _with_time(folder: Path) -> Figures:
    return {"ours, over time": _score(shelf_footage(folder).reconstruct(), folder)}


def _without_time(folder: Path) -> Figures:
    """Ours, and SMPL-only on the same people and detections."""
    recording, config = shelf_footage(folder), replace(PipelineConfig(), temporal=False)
    people = recording.reconstruct(config)
    bodies, _ = SamePeople.of(people, recording.rig, config).smpl_only(recording.rig)
    return {"ours, frame by frame": _score(people, folder), "SMPL-only": _score(bodies, folder)}


def _opponent(folder: Path) -> Figures:
    recording = shelf_footage(folder)
    people = find_everybody(recording.detections, recording.rig)
    return {
        "opponent, frame by frame": _score(people, folder),
        "opponent, over time": _score(over_time(people, SHELF_FPS), folder),
    }


def _others(folder: Path, others: Path) -> Figures:
    return {name: _score(people, folder) for name, people in read_others(others, "shelf").items()}


def _score(people: People, folder: Path) -> Figures:
    score = evaluate_shelf(people, read_shelf_ground_truth(folder / "gt_dev.txt"))
    return {
        "right": score.limbs_right.tolist(),
        "all": score.limbs_all.tolist(),
        "average": score.pcp_average,
        "mpjpe_mm": score.mpjpe_mm,
    }


def _table(found: Mapping[str, Figures]) -> list[str]:
    """A row for each limb and actor that somebody loses, and the sums."""
    scores = {name: figures for each in found.values() for name, figures in each.items()}
    methods = [name for name in METHODS if name in scores]
    right = {name: np.array(scores[name]["right"]) for name in methods}
    count = np.array(scores[methods[0]]["all"])
    rows = []
    for actor in ACTORS:
        for limb, limb_name in enumerate(LIMB_NAMES):
            cells = [int(right[name][actor, limb]) for name in methods]
            if min(cells) < count[actor, limb]:
                label = f"actor {actor + 1}, {limb_name}, of {count[actor, limb]}"
                rows.append(f"| {label} | {' | '.join(map(str, cells))} |")
    for actor in ACTORS:
        shares = [f"{100 * right[name][actor].sum() / count[actor].sum():.2f}" for name in methods]
        rows.append(f"| **actor {actor + 1}, %** | {' | '.join(shares)} |")
    for label, figure, decimals in (("**Avg, %**", "average", 2), ("MPJPE, mm", "mpjpe_mm", 1)):
        rows.append(f"| {label} | {' | '.join(f'{scores[name][figure]:.{decimals}f}' for name in methods)} |")
    told = "; ".join(f"{name} {figures}" for name, figures in PAPER.items())
    head = f"| limbs that are right | {' | '.join(methods)} |"
    return [
        head,
        rule(1 + len(methods)),
        *rows,
        "",
        f"The paper's table, on all annotated frames: {told}.",
    ]
