"""Reconstructions over time, and frame by frame, scored on the stretches of the named sequences."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.others import COMMON
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.tracking import score_tracks, stature_by_person
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.truth import truth_of

_UNSEEN = "joints_unseen"
COLUMNS = {
    "F1": ("f1", 1),
    "F1 19": ("f1_some_joints", 1),
    "recall": ("recall", 1),
    "IDF1": ("idf1", 1),
    "MPJPE": ("mpjpe_mm", 1),
    "accel": ("acceleration_error", 1),
    "nobody": ("rows_of_nobody", 0),
    "missed": ("people_missed", 0),
    "tracks": ("tracks", 0),
    "switches": ("switches", 0),
    "wrist": ("fast_wrist_error_mm", 1),
    "body": ("body_mpjpe_mm", 1),
    "b accel": ("body_acceleration_error", 1),
    "twists": ("twist_jumps", 0),
    "stature": ("stature_spread_cm", 1),
    "halves": ("halves_apart_cm", 1),
    "50 %": ("seen_inside_50", 1),
    "95 %": ("seen_inside_95", 1),
    "u": (_UNSEEN, 0),
    "u 50 %": ("unseen_inside_50", 1),
    "u 95 %": ("unseen_inside_95", 1),
    "v": ("velocity_error", 2),
    "v 95 %": ("velocity_inside_95", 1),
    "ms": ("cpu_ms", 0),
}
"""Heading, figure, decimals. mm, m/s², cm, m/s; `u`: joints unseen for ten frames; `halves`: how far a person's
stature in one half of the stretch is from that in the other; ms: the processor's, a frame."""


def experiment(scale: Scale, *, temporal: bool) -> Experiment:
    """All stretches, with time (and each half alone, for the statures) or without."""
    config = replace(PipelineConfig(), temporal=temporal)
    cases = [
        Case(stretch.label, partial(measure, stretch, config, halves=temporal)) for stretch in scale.stretches
    ]
    return Experiment("time" if temporal else "time off", cases, table)


def measure(stretch: Stretch, config: PipelineConfig, *, halves: bool = False, stride: int = 1) -> Figures:
    """`TrackingScore.as_dict` of a stretch, `cpu_ms` a frame, and with `halves` the `halves_apart_cm`."""
    scene, detections = stretch.scene, stretch.detections
    start = time.process_time()
    people = stretch.reconstruct(config)
    cpu_ms = 1e3 * (time.process_time() - start) / len(detections)
    scored = score_tracks(
        people,
        truth_of(scene),
        scene.fps,
        identities=config.temporal,
        frames=range(0, len(scene), stride),
        some_joints=COMMON,
        model=scene.body,
    )
    apart = {"halves_apart_cm": halves_apart_cm(stretch, config)} if halves else {}
    return scored.as_dict() | {"cpu_ms": cpu_ms} | apart


def halves_apart_cm(stretch: Stretch, config: PipelineConfig) -> float | None:
    """The largest difference of a person's stature between two halves reconstructed apart, centimetres.

    Of the people who are found in both. Where the detector puts its joints is learnt from all frames.
    """
    scene, middle = stretch.scene, len(stretch.span) // 2
    halves = [stretch.reconstruct(config, part) for part in (range(middle), range(middle, len(scene)))]
    first, second = (stature_by_person(half, truth_of(scene), scene.body) for half in halves)
    apart = 100 * np.abs(first - second)
    return float(np.nanmax(apart)) if np.isfinite(apart).any() else None


def with_mean(scores: Mapping[str, Figures]) -> dict[str, Figures]:
    """The scores, and the mean of every figure over those that have it, for joints unseen a pooled one."""
    names = dict.fromkeys(name for figures in scores.values() for name in figures)
    mean = {}
    for name in names:
        those = [figures for figures in scores.values() if figures.get(name) is not None]
        if len(those) > 0:
            weights = [each[_UNSEEN] for each in those] if name.startswith("unseen_inside") else None
            mean[name] = float(np.average([each[name] for each in those], weights=weights))
    return dict(scores) | ({"mean": mean} if len(scores) > 1 else {})


def table(scores: Mapping[str, Figures]) -> list[str]:
    """A row for each stretch and the mean, with the columns for which there is something to tell."""
    every = with_mean(scores)
    told = {h: (n, d) for h, (n, d) in COLUMNS.items() if any(each.get(n) is not None for each in every.values())}
    rows = [f"| {label} | {' | '.join(cells(figures, told.values()))} |" for label, figures in every.items()]
    return [f"| | {' | '.join(told)} |", rule(1 + len(told)), *rows]


def cells(figures: Figures, columns: Iterable[tuple[str, int]] | None = None) -> list[str]:
    """Figures as words; a dash where there is none."""
    wanted = COLUMNS.values() if columns is None else columns
    return ["-" if figures.get(name) is None else f"{figures[name]:.{decimals}f}" for name, decimals in wanted]
