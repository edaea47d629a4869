"""Who is found, with few cameras and few frames a second; and whether covariances are honest, by the number of
views that saw a joint.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.files import cuts_of
from shapepose_fg.simulation.sequences import SEQUENCES
from shapepose_fg.simulation.truth import truth_of

SEEDS = range(6101, 6106)
"""Of sequence and detector."""
SECONDS = 4.0
RATES = (10, 15, 20, 30, 60)
CAMERAS = (2, 3, 4, 6)
_RATE = 30
"""At which eight cameras and two people are measured, and every frame by itself: a frame alone knows no rate."""
_CLASSES = {"seen": "two views", "one_view": "one", "no_view": "none", "unseen": "none for ten frames"}


def experiment(scale: Scale) -> Experiment | None:
    """Crowds of eight and crossings of seven before 2 to 8 cameras, at 10 to 60 frames a second; two people."""
    if not scale.has_scenes:
        return None
    two = Stretch("demo", range(6 if scale.quick else round(SECONDS * _RATE)), cameras=2, people=2, fps=_RATE)
    kinds = {_label("two people", 2, _RATE): two}
    if not scale.quick:
        both = [(cameras, rate) for cameras in CAMERAS for rate in RATES]
        kinds = {
            _label(name, cameras, rate): _stretch(name, cameras, rate, scale)
            for name in ("crowd", "crossing")
            for cameras, rate in (*both, (8, _RATE))
        } | kinds
    cases = [
        Case(f"{label}, {seed}", partial(_measure, _drawn(stretch, seed)))
        for label, stretch in kinds.items()
        for seed in (SEEDS[:1] if scale.quick else SEEDS)
    ]
    return Experiment("who is there", cases, partial(_table, {name: each.cameras for name, each in kinds.items()}))


def _label(name: str, cameras: int, rate: int) -> str:
    return f"{name}, {cameras} cameras, {rate} Hz"


def _stretch(name: str, cameras: int, rate: int, scale: Scale) -> Stretch:
    frames = range(round(SECONDS * rate))
    return Stretch(name, frames, scale.split, cameras, made=SEQUENCES[name], fps=rate, mocap=scale.mocap)


def _drawn(stretch: Stretch, seed: int) -> Stretch:
    """The same with people, places and errors of another seed."""
    return replace(stretch, seed=seed, made=None if stretch.made is None else replace(stretch.made, seed=seed))


def _measure(stretch: Stretch) -> Figures:
    truth, scene, detections = _by_segment(stretch), stretch.scene, stretch.detections
    began = time.process_time()
    people = stretch.reconstruct()
    cpu_ms = 1e3 * (time.process_time() - began) / len(detections)
    scored = score_tracks(people, truth, scene.fps, model=scene.body)
    alone = None
    if scene.fps == _RATE:
        config = replace(PipelineConfig(), temporal=False)
        by_frame = score_tracks(stretch.reconstruct(config), truth, scene.fps, identities=False, model=scene.body)
        alone = by_frame.as_dict()["f1"]
    return scored.as_dict() | {"cpu_ms": cpu_ms, "f1_alone": alone, "people": len(truth)}


def _by_segment(stretch: Stretch) -> Reconstruction:
    """The truth, in which everybody is somebody else after a cut."""
    truth = truth_of(stretch.scene)
    segment = np.searchsorted(cuts_of(stretch.scene), truth.frame, side="right")
    return replace(truth, person=truth.person + segment * (int(truth.person.max(initial=0)) + 1))


def _table(cameras: Mapping[str, int], found: Mapping[str, Figures]) -> list[str]:
    """A row for each kind of recording, over its seeds, and for each number of cameras, over all recordings."""
    head = ["F1, mean", "least", "alone", "IDF1, mean", "least", "missed", "false", "longest", "ms"]
    head += _CLASSES.values()
    rows = dict[str, list[Figures]]()
    for name, figures in found.items():
        rows.setdefault(name.rpartition(", ")[0], []).append(figures)
    for count in sorted({cameras[label] for label in rows}):
        of_count = [figures for label, each in rows.items() if cameras.get(label) == count for figures in each]
        rows[f"**all, {count} cameras**"] = of_count
    lines = [f"| {label} | {' | '.join(_cells(figures))} |" for label, figures in rows.items()]
    return [f"| | {' | '.join(head)} |", rule(1 + len(head)), *lines]


def _cells(figures: Sequence[Figures]) -> list[str]:
    """Of recordings that differ by their seeds; regions as inside 50 % / inside 95 % / log score (joints)."""
    f1, idf1, alone = ([each[name] or 0.0 for each in figures] for name in ("f1", "idf1", "f1_alone"))
    measured = all(each["f1_alone"] is not None for each in figures)
    return [
        f"{np.mean(f1):.2f}",
        f"{min(f1):.2f}",
        f"{np.mean(alone):.1f}" if measured else "-",
        f"{np.mean(idf1):.2f}",
        f"{min(idf1):.2f}",
        f"{sum(each['people_missed'] for each in figures)} of {sum(each['people'] for each in figures)}",
        str(sum(each["rows_of_nobody"] for each in figures)),
        str(max(each["longest_of_nobody"] for each in figures)),
        f"{np.mean([each['cpu_ms'] for each in figures]):.0f}",
        *(_region(figures, name) for name in _CLASSES),
    ]


def _region(figures: Iterable[Figures], name: str) -> str:
    """All recordings' joints of a class together."""
    those = [each for each in figures if each[f"joints_{name}"] > 0]
    count = [each[f"joints_{name}"] for each in those]
    if len(those) == 0:
        return "-"
    half, most, score = (
        np.average([each[f"{name}_{figure}"] for each in those], weights=count)
        for figure in ("inside_50", "inside_95", "log_score")
    )
    return f"{half:.0f} / {most:.0f} / {score:.2f} ({sum(count)})"
