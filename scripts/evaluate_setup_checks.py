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
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.evaluation.spoiled_setups import spoiled
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.setup_check.diagnosis import diagnose
from shapepose_fg.setup_check.words import sentence
from shapepose_fg.simulation import built_in_scene, simulate

ROOT = Path(__file__).parents[1]
PARTS = ("shelf", "single", "simulated", "clean")
REAL = {
    "shelf": ("shelf/calibration.json", "shelf"),
    "single": ("pose2sim_single/Calib.qca.txt", "pose2sim_single/openpose"),
}


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; all by default")
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--recordings", type=int, default=6, help="simulated recordings; ten times as many clean")
    parser.add_argument("--seed", type=int, default=0, help="fixes the axes of turns, and the simulated people")
    parser.add_argument("--verbose", action="store_true", help="print what was said of mistakes not named")
    arguments = parser.parse_args()
    if not set(arguments.parts) <= set(PARTS):
        parser.error(f"parts are {' '.join(PARTS)}")
    for part in arguments.parts or PARTS:
        if part == "clean":
            clean(10 * arguments.recordings, arguments.seed)
        else:
            confusion(part, recordings(part, arguments), arguments.seed, arguments.verbose)


def recordings(part: str, arguments: argparse.Namespace) -> Iterator[tuple[DetectionSequence, Rig]]:
    """The recordings of a part."""
    if part in REAL:
        cameras, folder = (arguments.data / "data" / each for each in REAL[part])
        rig = read_rig(cameras)
        yield read_detections(folder, rig), rig
        return
    for number in range(arguments.recordings):
        yield simulated(arguments.seed + number)


def simulated(seed: int) -> tuple[DetectionSequence, Rig]:
    """A recording of people and cameras that `seed` draws, with the built-in detector's errors."""
    rng = np.random.default_rng(1000 + seed)
    cameras, people = int(rng.integers(4, 8)), int(rng.integers(1, 5))
    frames, fps = int(rng.choice([60, 90, 120])), float(rng.choice([25, 30, 50, 60]))
    scene = built_in_scene(seed, people=people, cameras=cameras, frames=frames, fps=fps)
    return simulate(scene, seed=seed), scene.rig


def confusion(name: str, given: Iterator[tuple[DetectionSequence, Rig]], seed: int, verbose: bool) -> None:
    """How often each mistake was named, and as what otherwise."""
    named, count, said = Counter[str](), Counter[str](), defaultdict(Counter[str])
    alone, seconds = Counter[str](), list[float]()
    for detections, rig in given:
        before = {(each.kind, each.cameras) for each in diagnose(detections, rig).findings}
        for each in spoiled(detections, rig, seed):
            start = time.process_time()
            findings = diagnose(each.detections, each.rig).findings
            seconds.append(time.process_time() - start)
            right = each.named_by(findings)
            count[each.what] += 1
            named[each.what] += right
            alone[each.what] += right and all(
                finding.kind == each.kind or finding.kind in {kind for kind, _ in before} for finding in findings
            )
            if not right:
                said[each.what]["; ".join(str(finding.kind) for finding in findings) or "nothing"] += 1
                if verbose:
                    words = "; ".join(sentence(finding, each.rig) for finding in findings) or "nothing"
                    print(f"  {each.what}, camera {each.cameras}: {words}")
    print(f"\n{name}{'mistake':>20}{'named':>12}{'alone':>10}   instead")
    for what in count:
        instead = ", ".join(f"{words} ({times})" for words, times in said[what].items())
        print(f"{what:<26}{f'{named[what]} of {count[what]}':>12}{alone[what]:>8}   {instead}")
    total, right = sum(count.values()), sum(named.values())
    print(f"{'all':<26}{f'{right} of {total}':>12}   {100 * right / total:.1f} %")
    print(f"{np.median(seconds):.1f} s of processor a check, {max(seconds):.1f} s at most")


def clean(recordings: int, seed: int) -> None:
    """How often something is said of simulated recordings in which nothing is wrong."""
    said = Counter[str]()
    for number in range(recordings):
        detections, rig = simulated(seed + 100 + number)
        for finding in diagnose(detections, rig).findings:
            said[str(finding.kind)] += 1
    print(f"\nclean: {recordings} recordings, {sum(said.values())} findings {dict(said)}")


if __name__ == "__main__":
    main()
