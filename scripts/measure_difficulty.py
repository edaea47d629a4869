"""How hard the named sequences are: python scripts/measure_difficulty.py [--update] [--stride 20] [--split tune].

Every `--stride`-th frame is reconstructed, by itself, at the default settings. Needs the recorded motions
(`--data FOLDER`, or SHAPEPOSE_DATA). `--update` writes the table between its marks in docs/simulation.md. Takes
about three minutes.
"""

import argparse
import os
import re
from pathlib import Path

import numpy as np

from shapepose_fg.detections import Recording
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Sequence, Split, sequence
from shapepose_fg.skeleton import BODY_25

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "simulation.md"
HIP = BODY_25.index("MidHip")
NEAR_M = 0.1
"""A candidate this near to the true hip, as a length at its depth, is a view that sees it."""


def main() -> None:
    """Print the table; with --update write it into the page too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--stride", type=int, default=20, help="reconstruct every so-many-th frame")
    parser.add_argument("--frames", type=int, help="shorten the sequences")
    parser.add_argument("--split", choices=("tune", "report"), action="append", help="both by default")
    parser.add_argument("--update", action="store_true", help="write the table into docs/simulation.md")
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.data / "data" / "cmu_mocap" / "cmu_smpl24.npz")
    lines = [
        "| sequence | people | frames | views that see the hip, of 6 | precision, % | recall, % | F1, % "
        "| MPJPE, mm | people found, % | twice or invented |",
        "|---" * 10 + "|",
    ]
    for name in SEQUENCES:
        for split in arguments.split or ("tune", "report"):
            lines.append(row(sequence(name, split, mocap, frames=arguments.frames), name, split, arguments.stride))
            print(lines[-1], flush=True)
    table = "\n".join(lines)
    print(f"\n{table}")
    if arguments.update:
        old = PAGE.read_text(encoding="utf-8")
        marked = re.compile(r"(<!-- difficulty -->\n).*?(<!-- end -->)", re.DOTALL)
        PAGE.write_text(marked.sub(lambda found: f"{found[1]}\n{table}\n\n{found[2]}", old), encoding="utf-8")


def row(scene: Sequence, name: str, split: Split, stride: int) -> str:
    """One sequence, scored."""
    some = simulate(scene, seed=0, frames=range(0, len(scene), stride))
    truth = scene.keypoints[::stride]
    m = joint_metrics(reconstruct(some, scene.rig, PipelineConfig()), truth)
    hips = views_that_see_the_hip(some, scene, truth)
    shares = " | ".join(f"{100 * share:.1f}" for share in (m.precision, m.recall, m.f1))
    found = f"{100 * m.people_found / m.people_true:.1f} | {m.people_duplicated + m.people_invented}"
    return (
        f"| {name}, {split} | {scene.people} | {len(scene)} | {hips:.2f} | {shares} | {m.mpjpe_mm:.1f} | {found} |"
    )


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


if __name__ == "__main__":
    main()
