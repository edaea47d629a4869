"""How hard the named sequences are: some frames, each alone, default settings."""

from collections.abc import Sequence as TypingSequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Sequence, Split, sequence

ALONE = replace(PipelineConfig(), temporal=False)
"""Every frame by itself."""
HIP = BODY_25.index("MidHip")
NEAR_M = 0.1
"""A candidate this near to the true hip, as a length at its depth, is a view that sees it."""


def table(motions: Path, splits: TypingSequence[Split], stride: int) -> list[str]:
    """All sequences of `splits`, every `stride`-th frame, as Markdown; `motions` is the recorded motions' file."""
    mocap = Mocap.load(motions)
    rows = [row(sequence(name, split, mocap), name, split, stride) for name in SEQUENCES for split in splits]
    return [
        "| sequence | people | frames | views that see the hip, of 6 | precision, % | recall, % | F1, % "
        "| MPJPE, mm | people found, % | twice or invented |",
        rule(10),
        *rows,
    ]


def row(scene: Sequence, name: str, split: Split, stride: int) -> str:
    """One sequence, scored."""
    some = simulate(scene, seed=0, frames=range(0, len(scene), stride))
    truth = scene.keypoints[::stride]
    m = joint_metrics(reconstruct(some, scene.rig, ALONE), truth)
    hips = views_that_see_the_hip(some, scene, truth)
    shares = " | ".join(f"{100 * share:.1f}" for share in (m.precision, m.recall, m.f1))
    found = f"{100 * m.people_found / m.people_true:.1f} | {m.people_duplicated + m.people_invented}"
    line = (
        f"| {name}, {split} | {scene.people} | {len(scene)} | {hips:.2f} | {shares} | {m.mpjpe_mm:.1f} | {found} |"
    )
    print(line, flush=True)
    return line


def views_that_see_the_hip(recording: Recording, scene: Sequence, truth: np.ndarray) -> float:
    """Views with a mid-hip candidate near the true one, mean over people and frames."""
    seen = 0
    for detections, people in zip(recording, truth, strict=True):
        hips = detections.only(detections.joint == HIP)
        xy, depth = scene.rig.project(people[:, HIP])
        gap_px = np.linalg.norm(xy[hips.view] - hips.xy[:, None], axis=-1)
        near = gap_px * depth[hips.view] / scene.rig.focal_px[hips.view, None] < NEAR_M
        person = np.nonzero(near)[1]
        seen += len(np.unique(np.stack([person, hips.view[np.nonzero(near)[0]]]), axis=1).T)
    return seen / (truth.shape[0] * truth.shape[1])
