"""A reconstruction over time, scored on stretches of the named sequences: python scripts/evaluate_time.py.

    python scripts/evaluate_time.py                                  # six stretches, split report
    python scripts/evaluate_time.py --split tune --only crowd --frames 0:100
    python scripts/evaluate_time.py --no-temporal --json without.json
    python scripts/evaluate_time.py --crowd 2 3 4                    # the built-in crowd before so many cameras

Needs the recorded motions (`--data FOLDER`, or SHAPEPOSE_DATA). Choose on `tune`, report on `report`. From Python:

    from shapepose_fg.evaluation.tracking import score_tracks
    score_tracks(people, truth_of(scene), scene.fps).as_dict()       # identities=False for a result without time
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from marked_tables import EVALUATION, write_table

from shapepose_fg.detections import DetectionSequence
from shapepose_fg.evaluation.tracking import score_tracks, stature_by_person
from shapepose_fg.frame_times import FrameTimes
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.reconstruction import Reconstruction
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import cut, named_scene
from shapepose_fg.simulation.truth import truth_of

STRETCHES = {
    "report": {
        "salsa": (range(108, 408), range(618, 918)),
        "crossing": (range(0, 300), range(726, 1026)),
        "crowd": (range(0, 300), range(826, 1126)),
    },
    "tune": {
        "salsa": (range(0, 300), range(564, 864)),
        "crossing": (range(0, 300), range(564, 864)),
        "crowd": (range(241, 541), range(900, 1200)),
    },
}
"""Stretches of each split without a cut, 300 frames each."""
NAMES = ("salsa", "crossing", "crowd")
CROWD_SEED = 2000
"""The scene of docs/evaluation.md's table of cameras."""
WITHOUT_FEET = tuple(range(19))
"""The joints that the C++ system of Zhang et al. 2020 has too."""
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
    "50 %": ("seen_inside_50", 1),
    "95 %": ("seen_inside_95", 1),
    "u": ("joints_long_unseen", 0),
    "u 50 %": ("unseen_inside_50", 1),
    "u 95 %": ("unseen_inside_95", 1),
    "v": ("velocity_error", 2),
    "v 95 %": ("velocity_inside_95", 1),
    "halves": ("halves_apart_cm", 1),
    "ms": ("cpu_ms", 0),
}
"""Heading, figure, decimals. mm, m/s², cm, m/s; `u`: joints unseen for ten frames; `halves`: how far a person's
stature in one half of the stretch is from that in the other (`--halves`); ms: the processor's, a frame."""


def main() -> None:
    """Score every stretch and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("tune", "report"), default="report")
    parser.add_argument("--only", nargs="*", choices=NAMES, default=NAMES, help="sequences")
    parser.add_argument("--first", action="store_true", help="the first stretch of each sequence only")
    parser.add_argument("--frames", metavar="A:B", help="these frames in place of the stretches")
    parser.add_argument(
        "--temporal", action=argparse.BooleanOptionalAction, help="with time or without; else as configured"
    )
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0, help="of the detector's errors")
    parser.add_argument("--stride", type=int, default=1, help="score every so-many-th frame")
    parser.add_argument("--halves", action="store_true", help="both halves alone, too: do statures agree?")
    parser.add_argument("--crowd", nargs="+", type=int, metavar="V", help="the crowd of seed 2000, V cameras")
    parser.add_argument("--data", type=Path, help="folder that holds data/cmu_mocap; default SHAPEPOSE_DATA")
    parser.add_argument("--update", action="store_true", help="write the table into docs/evaluation.md")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    if arguments.data is not None:
        os.environ["SHAPEPOSE_DATA"] = str(arguments.data)
    torch.set_num_threads(1)
    config = with_time(PipelineConfig(), arguments.temporal)
    if arguments.crowd is not None:
        return crowd(arguments.crowd, config)
    print(" " * 18 + " ".join(f"{heading:>8}" for heading in COLUMNS))
    scores: dict[str, dict[str, Any]] = {}
    for name in arguments.only:
        for span in spans(name, arguments):
            scene = stretch(name, span, arguments.split, arguments.cameras)
            label = f"{name} {span.start}:{span.stop}"
            detections = simulate(scene, seed=arguments.seed)
            scores[label] = score(scene, detections, config, arguments.stride)
            if arguments.halves:
                scores[label]["halves_apart_cm"] = halves_apart_cm(scene, detections, config)
            print(line(label, scores[label]), flush=True)
    scores["mean"] = mean(list(scores.values()))
    print(line("mean", scores["mean"]))
    if arguments.update:
        write_table("time" if config.temporal else "time off", "\n".join(markdown(scores)), EVALUATION)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(scores, indent=2) + "\n", encoding="utf-8")


def crowd(cameras: list[int], config: PipelineConfig) -> None:
    """Four people who hide each other, before few cameras."""
    for count in cameras:
        scene = built_in_scene(CROWD_SEED, cameras=count)
        people = solve(simulate(scene, seed=CROWD_SEED), scene, config)
        found = score_tracks(people, truth_of(scene), scene.fps, identities=config.temporal, model=scene.body)
        joints, who = found.joints, found.identities
        print(
            f"{count} cameras: {100 * joints.people_found / joints.people_true:.1f} % of people found,"
            f" {100 * joints.people_invented / max(len(people), 1):.1f} % of {len(people)} rows nobody,"
            f" {joints.people_duplicated} doubles; F1 {100 * joints.f1:.1f} %, MPJPE {joints.mpjpe_mm:.1f} mm"
            + ("" if who is None else f", IDF1 {100 * who.idf1:.1f} %, {who.tracks} tracks"),
            flush=True,
        )


def spans(name: str, arguments: argparse.Namespace) -> tuple[range, ...]:
    """The stretches of a sequence that are asked for."""
    if arguments.frames is not None:
        return (range(*(int(end) for end in arguments.frames.split(":"))),)
    stretches = STRETCHES[arguments.split][name]
    return stretches[:1] if arguments.first else stretches


def stretch(name: str, span: range, split: str, cameras: int) -> Scene:
    """Some frames of a sequence, as `shapepose-fg simulate --frames` cuts them."""
    return cut(named_scene(name, split=split, cameras=cameras, frames=span.stop), span)


def with_time(config: PipelineConfig, temporal: bool | None) -> PipelineConfig:
    """The settings with time switched on or off; as they are where nothing is asked for."""
    return config if temporal is None else replace(config, temporal=temporal)


def solve(
    detections: DetectionSequence, scene: Scene, config: PipelineConfig, frames: range | None = None
) -> Reconstruction:
    """Reconstruct what was simulated, at the scene's rate."""
    times = FrameTimes.from_fps(scene.fps, len(detections))
    return reconstruct(detections, scene.rig, config, frames=frames, times=times)


def score(scene: Scene, detections: DetectionSequence, config: PipelineConfig, stride: int) -> dict[str, Any]:
    """Reconstruct and score a scene: `TrackingScore.as_dict`, and `cpu_ms` a frame."""
    start = time.process_time()
    people = solve(detections, scene, config)
    cpu_ms = 1e3 * (time.process_time() - start) / len(scene)
    scored = score_tracks(
        people,
        truth_of(scene),
        scene.fps,
        identities=config.temporal,
        frames=range(0, len(scene), stride),
        some_joints=WITHOUT_FEET,
        model=scene.body,
    )
    return scored.as_dict() | {"cpu_ms": cpu_ms}


def halves_apart_cm(scene: Scene, detections: DetectionSequence, config: PipelineConfig) -> float:
    """The largest difference of a person's stature between two halves reconstructed apart, centimetres."""
    middle = len(scene) // 2
    halves = [solve(detections, scene, config, frames) for frames in (range(middle), range(middle, len(scene)))]
    truth = truth_of(scene)
    first, second = (stature_by_person(half, truth, scene.body) for half in halves)
    return float(100 * np.nanmax(np.abs(first - second)))


def mean(scores: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean of every figure that some stretch has."""
    found = {name: [s[name] for s in scores if s.get(name) is not None] for name in scores[0]} if scores else {}
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def markdown(scores: dict[str, dict[str, Any]]) -> list[str]:
    """The table for the documents: columns for which there is something to tell."""
    told = {h: (n, d) for h, (n, d) in COLUMNS.items() if any(each.get(n) is not None for each in scores.values())}
    rows = []
    for label, figures in scores.items():
        cells = ["-" if figures.get(n) is None else f"{figures[n]:.{d}f}" for n, d in told.values()]
        rows.append(f"| {label} | {' | '.join(cells)} |")
    return [f"| | {' | '.join(told)} |", "|---" * (1 + len(told)) + "|", *rows]


def line(label: str, figures: dict[str, Any]) -> str:
    """A row of the table."""
    cells = [(figures.get(name), decimals) for name, decimals in COLUMNS.values()]
    return f"{label:<18}" + " ".join(f"{'-' if v is None else f'{v:.{d}f}':>8}" for v, d in cells)


if __name__ == "__main__":
    main()
