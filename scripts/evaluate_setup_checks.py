"""Recordings spoiled on purpose, and what the check of the set-up says: python scripts/evaluate_setup_checks.py.

Every silent mistake (`evaluation/spoiled_setups.py`) is made on every camera of each recording; it counts as named
where kind and camera are right, and frames within one. `shelf` and `single` are real recordings (`--data
FOLDER`, or SHAPEPOSE_DATA), `simulated` the built-in scene with one to four people before four to seven cameras,
and `clean` many simulated recordings without any mistake, of which nothing should be said.

    python scripts/evaluate_setup_checks.py shelf single
    python scripts/evaluate_setup_checks.py simulated clean --recordings 20
"""

import argparse
import os
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.evaluation.spoiled_setups import spoiled
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.setup_check.diagnosis import diagnose
from shapepose_fg.simulation import built_in_scene, simulate

SHARED = Path(os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared"))
REAL = {
    "shelf": ("shelf/calibration.json", "shelf"),
    "single": ("pose2sim_single/Calib.qca.txt", "pose2sim_single/openpose"),
}


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = (*REAL, "simulated", "clean")
    parser.add_argument("parts", nargs="*", choices=parts, metavar="PART", help=f"{', '.join(parts)}; or all")
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("--recordings", type=int, default=6, help="simulated recordings; ten times as many clean")
    parser.add_argument("--seed", type=int, default=0, help="fixes the axes of turns, and the simulated people")
    arguments = parser.parse_args()
    count, seed = arguments.recordings, arguments.seed
    for part in arguments.parts or parts:
        if part in REAL:
            rig = read_rig(arguments.data / "data" / REAL[part][0])
            confusion(part, [(read_detections(arguments.data / "data" / REAL[part][1], rig), rig)], seed)
        elif part == "simulated":
            confusion(part, map(simulated, range(seed, seed + count)), seed)
        else:
            seeds = range(seed + 100, seed + 100 + 10 * count)
            said = Counter(str(finding.kind) for each in seeds for finding in diagnose(*simulated(each)).findings)
            print(f"\nclean: {len(seeds)} recordings, {said.total()} findings {dict(said)}")


def simulated(seed: int) -> tuple[DetectionSequence, Rig]:
    """A recording of people and cameras that `seed` draws, with the built-in detector's errors."""
    rng = np.random.default_rng(1000 + seed)
    cameras, people = int(rng.integers(4, 8)), int(rng.integers(1, 5))
    frames, fps = int(rng.choice([60, 90, 120])), float(rng.choice([25, 30, 50, 60]))
    scene = built_in_scene(seed, people=people, cameras=cameras, frames=frames, fps=fps)
    return simulate(scene, seed=seed), scene.rig


def confusion(part: str, recordings: Iterable[tuple[DetectionSequence, Rig]], seed: int) -> None:
    """Print how often each mistake was named, and as what otherwise."""
    named, count, said = Counter[str](), Counter[str](), defaultdict(Counter[str])
    for detections, rig in recordings:
        for each in spoiled(detections, rig, seed):
            findings = diagnose(each.detections, each.rig).findings
            count[each.what] += 1
            if each.named_by(findings):
                named[each.what] += 1
            else:
                said[each.what]["; ".join(str(finding.kind) for finding in findings) or "nothing"] += 1
    print(f"\n{part}{'mistake':>20}{'named':>12}   instead")
    for what in count:
        instead = ", ".join(f"{words} ({times})" for words, times in said[what].items())
        print(f"{what:<26}{f'{named[what]} of {count[what]}':>12}   {instead}")
    print(f"{'all':<26}{f'{named.total()} of {count.total()}':>12}")


if __name__ == "__main__":
    main()
