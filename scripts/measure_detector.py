"""How a real 2D detector errs, measured without any annotation: python scripts/measure_detector.py [--update].

Each view is judged by the others: where at least three other views agree on a joint, their triangulation, without
the view in question, says where the joint is in it. Bodies fitted to all views say who hides whom. The annotation
of the recording is not read. What the simulated detector draws is then calibrated: the same measurement on a
simulated recording of the same poses must find the same. `--update` writes what was found to
shapepose_fg/simulation/data/detector.json, from which the simulated detector draws. Takes about seven minutes.
"""

import argparse
import json
import os
import re
from pathlib import Path
from typing import Any

import torch

from shapepose_fg.simulation.measurement.calibration import SEEDS, calibrate
from shapepose_fg.simulation.measurement.people import CONFIG, FPS, shelf_people, twin
from shapepose_fg.simulation.measurement.sample import take_sample
from shapepose_fg.simulation.measurement.statistics import statistics

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "shapepose_fg" / "simulation" / "data" / "detector.json"


def main() -> None:
    """Measure, calibrate, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with data/shelf/ (default SHAPEPOSE_DATA, ../shared)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of calibration (default 5)")
    parser.add_argument("--afresh", action="store_true", help="begin with what was measured, not with the file's")
    parser.add_argument("--update", action="store_true", help=f"write {OUTPUT.relative_to(ROOT)}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    detections, rig, people = shelf_people(shelf_folder(arguments.data))
    sample = take_sample(detections, rig, people, CONFIG)
    measured = statistics(sample, rig, FPS)
    provenance = PROVENANCE | {
        "joints judged": len(sample.expected["hit"]),
        "rounds": arguments.rounds,
        "recordings a round": SEEDS,
    }
    begin = {} if arguments.afresh else json.loads(OUTPUT.read_text(encoding="utf-8"))["drawn"]
    drawn = calibrate(measured, twin(people, rig, FPS), arguments.rounds, begin)
    text = pretty({"provenance": provenance, "measured": measured, "drawn": drawn})
    print(text)
    if arguments.update:
        OUTPUT.parent.mkdir(exist_ok=True)
        OUTPUT.write_text(text + "\n", encoding="utf-8")


def shelf_folder(data: Path | None) -> Path:
    """Where the recording is."""
    root = data or Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    return root / "data" / "shelf"


PROVENANCE = {
    "recording": "Shelf (Belagiannis et al. 2014), 301 frames, 5 cameras, 25 frames a second",
    "detections": "OpenPose BODY_25 candidates of github.com/zhangyux15/4d_association (Zhang et al., CVPR 2020)",
    "method": "each view against the triangulation of at least 3 others; no annotation was read",
    "script": "scripts/measure_detector.py",
}


def pretty(value: dict[str, Any]) -> str:
    """JSON with one row of numbers a line."""
    text = json.dumps(value, indent=1)
    # Inner lists of numbers on one line each.
    return re.sub(r"\[\s+([-\d.,\s]+?)\s+\]", lambda row: "[" + " ".join(row[1].split()) + "]", text)


if __name__ == "__main__":
    main()
