"""Measure the table of docs/evaluation/angles.md: python scripts/measure_angles.py --mocap FILE.

People of the named sequences and of the built-in scene, 10 s at 15 frames a second, in front of
simulated cameras: errors from 3 s on, of people who are there in the first second. `--update`
writes the table into the page between the marks `<!-- angles -->` and `<!-- end -->`. About a
minute per recording on one core.
"""

import argparse
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from shapepose_fg.biomechanics.joint_angles import NAMES, joint_angles
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.evaluation.tracking import joints_by_frame
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import sequence

PAGE = Path(__file__).parent.parent / "docs" / "evaluation" / "angles.md"
FPS, SECONDS = 15.0, 10
RECORDINGS = {"salsa": (6, 3), "crossing": (4,), "crowd": (6, 4)}
"""Numbers of cameras in front of which each sequence is simulated."""
ROWS = (
    "hip flexion, hip adduction, hip rotation, knee flexion, ankle flexion, ankle inversion, "
    "shoulder elevation, shoulder plane, shoulder rotation, elbow flexion, trunk flexion, "
    "trunk bending, trunk rotation, pelvis tilt, pelvis obliquity, pelvis rotation"
).split(", ")


def scenes(mocap: Mocap) -> Iterator[tuple[str, Scene]]:
    """The recordings by name."""
    yield "demo, 6 cameras", built_in_scene(frames=int(FPS * SECONDS), fps=FPS)
    for name, counts in RECORDINGS.items():
        for cameras in counts:
            frames = int(FPS * SECONDS)
            made = sequence(name, "report", mocap, cameras=cameras, until=frames, fps=FPS)
            yield f"{name}, {cameras}", made.part(range(frames))


def measure(scene: Scene) -> tuple[Array, Array]:
    """Errors of the angles (N, A), and their sigmas, degrees."""
    times = FrameTimes.from_fps(FPS, len(scene))
    people, truth = reconstruct(simulate(scene), scene.rig, times=times), truth_of(scene)
    matches = match_people(people.frame, people.joints, joints_by_frame(truth))
    numbers = np.unique(truth.person)[matches.person]
    from_start = np.isin(numbers, numbers[matches.frame < FPS])
    there = np.flatnonzero(from_start & (matches.frame >= 3 * FPS))
    rows = [
        np.flatnonzero((truth.frame == frame) & (truth.person == person))[0]
        for frame, person in zip(matches.frame[there], numbers[there], strict=True)
    ]
    found = joint_angles(people.rows(matches.row[there]), scene.rig.up)
    true = joint_angles(truth.rows(np.array(rows)), scene.rig.up)
    return (found.degrees - true.degrees + 180) % 360 - 180, found.sigma


def table(measured: dict[str, tuple[Array, Array]]) -> str:
    """The table in Markdown: medians by recording, then over all of them."""
    heads = ["angle", *measured, "all", "90 %", "sigma", "50 %", "95 %"]
    lines = [heads, ["---"] * len(heads)]
    both = [np.concatenate(each) for each in zip(*measured.values(), strict=True)]
    for row in ROWS:
        columns = [n for n, name in enumerate(NAMES) if name.endswith(row.replace(" ", "_"))]
        error, sigma = (np.abs(each[:, columns]).ravel() for each in both)
        cells = [np.nanmedian(np.abs(each[:, columns])) for each, _ in measured.values()]
        cells += [np.nanmedian(error), np.nanquantile(error, 0.9), np.nanmedian(sigma)]
        inside = [100 * (error < width * sigma).mean() for width in (0.6745, 1.96)]
        lines.append([row, *(f"{each:.1f}" for each in cells), *(f"{each:.0f}" for each in inside)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and perhaps write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mocap", type=Path, required=True, help="file of recorded motions")
    parser.add_argument("--update", action="store_true", help="write the table into the page")
    given = parser.parse_args(arguments)
    measured = {name: measure(scene) for name, scene in scenes(Mocap.load(given.mocap))}
    text = f"<!-- angles -->\n\n{table(measured)}\n\n<!-- end -->"
    print(text)
    if given.update:
        page = PAGE.read_text(encoding="utf-8")
        marks = r"<!-- angles -->.*?<!-- end -->"
        PAGE.write_text(re.sub(marks, lambda _: text, page, flags=re.DOTALL), "utf-8")


if __name__ == "__main__":
    main()
