"""Reconstructions of real footage, measured: python scripts/evaluate_footage.py [shelf views single] [options].

`shelf` scores the Shelf recording against its annotation: Avg PCP with an interval over blocks of frames, every
lost limb as one event, identities that change. `views` leaves out each of its cameras and asks how much of what it
saw lies in the 95 % region of the rest. `single` measures Pose2Sim's demo recording, which has no truth. It
needs the recordings (`--data FOLDER`, or
SHAPEPOSE_DATA).

    python scripts/evaluate_footage.py shelf --no-temporal
"""

import argparse
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from evaluate_time import with_time

from shapepose_fg.camera import Rig
from shapepose_fg.detections import DetectionSequence
from shapepose_fg.evaluation.held_out_view import held_out
from shapepose_fg.evaluation.shelf import evaluate_shelf, match_actors, read_shelf_ground_truth
from shapepose_fg.evaluation.shelf_events import identity_switches, lost_limbs, pcp_interval
from shapepose_fg.evaluation.single_person import FPS, measure_single_person
from shapepose_fg.frame_times import FrameTimes
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.reconstruction import Reconstruction

ROOT = Path(__file__).parents[1]
PARTS = ("shelf", "views", "single")


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help="shelf, views, single; all by default")
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument(
        "--temporal", action=argparse.BooleanOptionalAction, help="with time or without; else as configured"
    )
    arguments = parser.parse_args()
    if not set(arguments.parts) <= set(PARTS):
        parser.error(f"parts are {' '.join(PARTS)}")
    torch.set_num_threads(1)
    config = with_time(PipelineConfig(), arguments.temporal)
    parts = arguments.parts or PARTS
    if "shelf" in parts or "views" in parts:
        shelf(arguments.data / "data" / "shelf", config, parts)
    if "single" in parts:
        single(arguments.data / "data" / "pose2sim_single", config)


def shelf(folder: Path, config: PipelineConfig, parts: Sequence[str]) -> None:
    """The Shelf recording: its score, and its cameras left out one after the other."""
    rig = read_rig(folder / "calibration.json")
    recording = read_detections(folder, rig)
    people = reconstruct(recording, rig, config)
    if "shelf" in parts:
        truth = read_shelf_ground_truth(folder / "gt_dev.txt")
        matched = match_actors(people, truth)
        low, high = pcp_interval(matched)
        print(f"Avg PCP {evaluate_shelf(people, truth).pcp_average:.2f} %, 95 % interval {low:.2f} to {high:.2f}")
        switches = identity_switches(matched, people.person) if config.temporal else "-"
        print(f"identity switches {switches}; lost limbs:")
        print("\n".join(f"  {event}" for event in lost_limbs(matched)))
    if "views" in parts:
        views(recording, rig, people, config)


def views(recording: DetectionSequence, rig: Rig, people: Reconstruction, config: PipelineConfig) -> None:
    """What each camera saw against where the others put it."""
    for camera in held_out(recording, rig, people, partial(reconstruct, config=config), config.observations):
        print(
            f"camera {camera.name}: {100 * camera.inside:.1f} % of {len(camera.squared)} candidates inside their"
            f" 95 % region; {camera.unmatched} of people or joints that the others do not find"
        )


def single(folder: Path, config: PipelineConfig) -> None:
    """Pose2Sim's recording."""
    rig = read_rig(folder / "rig.json")
    recording = read_detections(folder / "openpose", rig)
    people = reconstruct(recording, rig, config, times=FrameTimes.from_fps(FPS, len(recording)))
    for name, value in measure_single_person(people, recording, rig).as_dict().items():
        print(f"{name:<22}{value}")


if __name__ == "__main__":
    main()
