"""The pictures of docs/evaluation.md, into docs/images: python scripts/draw_examples.py [--only NAME ...].

Every frame is picked by a rule (`shapepose_fg/evaluation/pictures/choice.py`), none by hand.
`bodies` and `bodies_shelf` are frames of middling error, or in the middle; `before_after` initial and final poses,
`methods` the closest contact of each sequence by each method, `failures` the largest errors over time,
`lost_limbs` the limb of each of Shelf's actors that is lost for longest. `--others FOLDER` has the results of
other systems for `methods` (scripts/run_pose2sim.py).
Needs the recordings (`--data FOLDER`, or SHAPEPOSE_DATA) and matplotlib. Takes about five minutes.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from marked_tables import IMAGES, ROOT

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.evaluation.experiments.interactions import contacts
from shapepose_fg.evaluation.experiments.others import folder_name, read_others
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.footage import shelf_footage
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.opponent.opponent import find_everybody
from shapepose_fg.evaluation.opponent.over_time import over_time
from shapepose_fg.evaluation.pictures.choice import Beside, before_and_after, closest_contact, found, mean_error
from shapepose_fg.evaluation.pictures.pages import draw_before_after, draw_failures, draw_lost_limbs, draw_methods
from shapepose_fg.evaluation.shelf import ACTORS, match_actors
from shapepose_fg.evaluation.shelf_events import lost_limbs
from shapepose_fg.evaluation.shelf_ground_truth import read_shelf_ground_truth
from shapepose_fg.evaluation.smpl_only import SamePeople
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.viz.viewer import demo_picture

FRAMES = 150
"""Of each stretch that examples are picked from."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each stretch")
    parser.add_argument("--output", type=Path, default=IMAGES, help="folder")
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES), help="names of pictures")
    parser.add_argument("--others", type=Path, help="folder of results by scripts/run_pose2sim.py")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scale = Scale(data=arguments.data)
    for name in arguments.only:
        file = arguments.output / f"{name}.jpg"
        if name in OF_SHELF:
            OF_SHELF[name](file, arguments.data / "data" / "shelf")
        elif name == METHODS:
            methods(file, contacts(scale)[::2], arguments.others)
        else:
            OF_STRETCHES[name](file, [shorter(stretch, arguments.frames) for stretch in scale.one_each])
        print(f"{file}  {file.stat().st_size / 1e3:.0f} kB", flush=True)


def bodies(file: Path, stretches: list[Stretch]) -> None:
    """The last stretch's frame of middling error, over time."""
    stretch = stretches[-1]
    people = stretch.reconstruct()
    rows = found(stretch, people)
    count = np.bincount(rows.frame, minlength=len(stretch.span))
    error = np.bincount(rows.frame, mean_error(rows), minlength=len(count)) / np.maximum(count, 1)
    order = np.argsort(np.where(count == count.max(), error, np.inf), kind="stable")
    frame = int(order[(count == count.max()).sum() // 2])
    demo_picture(
        file,
        stretch.scene.rig,
        people,
        frame,
        detections=stretch.detections[frame],
        truth=stretch.scene.vertices_at(frame),
        title=f"The frame of middling error of {stretch.label}",
        width_px=1600,
    )


def before_after(file: Path, stretches: list[Stretch]) -> None:
    """Initial and final poses of each stretch, every frame by itself."""
    config = replace(PipelineConfig(), temporal=False)
    draw_before_after(file, [before_and_after(stretch, config) for stretch in stretches])


def methods(file: Path, stretches: list[Stretch], others: Path | None) -> None:
    """The closest contact of each stretch: others and ours over time, SMPL-only and the paper frame by frame."""
    parts = []
    for stretch in stretches:
        rig, alone = stretch.scene.rig, replace(PipelineConfig(), temporal=False)
        theirs = {} if others is None else read_others(others, folder_name(stretch))
        people: dict[str, People] = {name: theirs[name] for name in (POSE2SIM,) if name in theirs}
        people["opponent, over time"] = over_time(find_everybody(stretch.detections, rig), stretch.scene.fps)
        people["paper's settings"] = stretch.reconstruct(PipelineConfig.paper())
        people["SMPL-only"] = SamePeople.of(stretch.reconstruct(alone), rig, alone).smpl_only(rig)[0]
        people["ours, over time"] = stretch.reconstruct()
        frame, pair = closest_contact(stretch)
        parts.append(Beside(stretch, frame, pair, people))
    draw_methods(file, parts)


def failures(file: Path, stretches: list[Stretch]) -> None:
    """The largest errors of each stretch, over time."""
    draw_failures(file, [found(stretch, stretch.reconstruct()) for stretch in stretches])


def bodies_shelf(file: Path, folder: Path) -> None:
    """Shelf's middle frame of those with most people."""
    recording = shelf_footage(folder)
    rig, detections = recording.rig, recording.detections
    people = recording.reconstruct()
    count = np.bincount(people.frame, minlength=len(detections))
    full = np.flatnonzero(count == count.max())
    frame = int(full[len(full) // 2])
    demo_picture(
        file, rig, people, frame, detections=detections[frame], body=BodyModel.default(),
        title="Shelf: the middle frame of those with most people", width_px=1600,
    )  # fmt: skip


def lost(file: Path, folder: Path) -> None:
    """The limb of each actor on Shelf that is lost for longest."""
    recording = shelf_footage(folder)
    rig, detections = recording.rig, recording.detections
    people = recording.reconstruct()
    truth = read_shelf_ground_truth(folder / "gt_dev.txt")
    matched = match_actors(people, truth)
    longest = {}
    for event in sorted(lost_limbs(matched), key=lambda each: each.first - each.last):
        longest.setdefault(event.actor, event)
    events, rows = list(longest.values()), []
    for event in events:
        own = np.flatnonzero(
            (matched.actor == ACTORS[event.actor - 1])
            & (matched.frame >= event.first)
            & (matched.frame <= event.last)
        )
        rows.append(int(matched.row[own[len(own) // 2]]))
    draw_lost_limbs(file, people, rig, detections, truth, events, rows)


OF_STRETCHES: dict[str, Callable[[Path, list[Stretch]], None]] = {
    "bodies": bodies,
    "before_after": before_after,
    "failures": failures,
}
OF_SHELF: dict[str, Callable[[Path, Path], None]] = {"bodies_shelf": bodies_shelf, "lost_limbs": lost}
METHODS, POSE2SIM = "methods", "Pose2Sim, over time"
PICTURES = (*OF_STRETCHES, METHODS, *OF_SHELF)


if __name__ == "__main__":
    main()
