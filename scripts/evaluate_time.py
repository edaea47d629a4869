"""A reconstruction over time, scored on stretches of the named sequences: python scripts/evaluate_time.py.

    python scripts/evaluate_time.py                                  # six stretches, split report
    python scripts/evaluate_time.py --split tune --only crowd --frames 0:100
    python scripts/evaluate_time.py --no-temporal --json without.json

Needs the recorded motions (`--data FOLDER`, or SHAPEPOSE_DATA). Choose on `tune`, report on `report`. From Python:

    from shapepose_fg.evaluation.tracking import score_tracks
    score_tracks(people, truth_of(scene), scene.fps).as_dict()       # identities=False for a result without time
"""

import argparse
import json
import os
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene, simulate
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
    "u 50 %": ("unseen_inside_50", 1),
    "u 95 %": ("unseen_inside_95", 1),
    "ms": ("cpu_ms", 0),
}
"""Heading, figure, decimals. mm, m/s², cm; `u`: joints unseen for ten frames; ms: the processor's, a frame."""


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
    parser.add_argument("--data", type=Path, help="folder that holds data/cmu_mocap; default SHAPEPOSE_DATA")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    if arguments.data is not None:
        os.environ["SHAPEPOSE_DATA"] = str(arguments.data)
    torch.set_num_threads(1)
    config = with_time(PipelineConfig(), arguments.temporal)
    print(" " * 18 + " ".join(f"{heading:>8}" for heading in COLUMNS))
    scores: dict[str, dict[str, Any]] = {}
    for name in arguments.only:
        for span in spans(name, arguments):
            scene = stretch(name, span, arguments.split, arguments.cameras)
            label = f"{name} {span.start}:{span.stop}"
            scores[label] = score(scene, config, arguments.seed, arguments.stride)
            print(line(label, scores[label]), flush=True)
    print(line("mean", mean(list(scores.values()))))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(scores, indent=2) + "\n", encoding="utf-8")


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
    if temporal is None:
        return config
    return replace(config, temporal=temporal)  # type: ignore[call-arg]


def uses_time(config: PipelineConfig) -> bool:
    """Whether `person` of a result is an identity."""
    return any(field.name == "temporal" for field in fields(config)) and bool(config.temporal)  # type: ignore[attr-defined]


def score(scene: Scene, config: PipelineConfig, seed: int, stride: int) -> dict[str, Any]:
    """Simulate, reconstruct and score a scene: `TrackingScore.as_dict`, and `cpu_ms` a frame."""
    detections = simulate(scene, seed=seed)
    start = time.process_time()
    people = reconstruct(detections, scene.rig, config)
    cpu_ms = 1e3 * (time.process_time() - start) / len(scene)
    scored = score_tracks(
        people,
        truth_of(scene),
        scene.fps,
        identities=uses_time(config),
        frames=range(0, len(scene), stride),
        some_joints=WITHOUT_FEET,
        model=scene.body,
    )
    return scored.as_dict() | {"cpu_ms": cpu_ms}


def mean(scores: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean of every figure that some stretch has."""
    found = {name: [s[name] for s in scores if s.get(name) is not None] for name in scores[0]} if scores else {}
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def line(label: str, figures: dict[str, Any]) -> str:
    """A row of the table."""
    cells = [(figures.get(name), decimals) for name, decimals in COLUMNS.values()]
    return f"{label:<18}" + " ".join(f"{'-' if v is None else f'{v:.{d}f}':>8}" for v, d in cells)


if __name__ == "__main__":
    main()
