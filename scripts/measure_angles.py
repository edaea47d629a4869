"""Measure the table of docs/evaluation/angles.md: python scripts/measure_angles.py --mocap FILE.

People of the named sequences and of the built-in scene, 10 s at 15 frames a second, in front of
simulated cameras. Medians of the errors from 3 s on, and the share inside 95 % intervals: of the
angles, and of the angles relative to the first second. `--update` writes the table into the page
between the marks `<!-- angles -->` and `<!-- end -->`. About a minute per recording on one core.
"""

import argparse
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapepose_fg.biomechanics.joint_angles import NAMES, JointAngles, joint_angles
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.evaluation.tracking import joints_by_frame
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import sequence

PAGE = Path(__file__).parents[1] / "docs" / "evaluation" / "angles.md"
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


def measure(scene: Scene) -> tuple[Array, ...]:
    """Errors of the angles (N, A), and of those relative to the first second, and the sigmas of
    both, degrees.
    """
    times = FrameTimes.from_fps(FPS, len(scene))
    people, truth = reconstruct(simulate(scene), scene.rig, times=times), truth_of(scene)
    matches = match_people(people.frame, people.joints, joints_by_frame(truth))
    numbers = np.unique(truth.person)[matches.person]
    rows = [
        np.flatnonzero((truth.frame == frame) & (truth.person == person))[0]
        for frame, person in zip(matches.frame, numbers, strict=True)
    ]
    there = np.flatnonzero(np.isin(numbers, numbers[matches.frame < FPS]))
    people = people.rows(matches.row[there])
    people = replace(people, person=numbers[there], observations=None)
    truth = truth.rows(np.array(rows)[there])
    found, true = (joint_angles(each, scene.rig.up) for each in (people, truth))
    late, moved = people.frame >= 3 * FPS, from_start(found)
    errors = [found.degrees - true.degrees, moved.degrees - from_start(true).degrees]
    absolute, relative = ((each[late] + 180) % 360 - 180 for each in errors)
    return absolute, relative, found.sigma[late], moved.sigma[late]


def from_start(angles: JointAngles) -> JointAngles:
    """The angles relative to the first second."""
    rows = np.flatnonzero(angles.people.frame < FPS)
    return angles.relative_to(
        replace(
            angles,
            people=angles.people.rows(rows),
            degrees=angles.degrees[rows],
            covariance=angles.covariance[rows],
        )
    )


def table(measured: dict[str, tuple[Array, ...]]) -> str:
    """The table in Markdown: medians by recording, then over all of them."""
    heads = ["angle", *measured, "all", "90 %", "sigma", "50 %", "95 %", "relative", "95 %"]
    lines = [heads, ["---"] * len(heads)]
    both = [np.concatenate(each) for each in zip(*measured.values(), strict=True)]
    for row in ROWS:
        columns = [n for n, name in enumerate(NAMES) if name.endswith(row.replace(" ", "_"))]
        absolute, relative, sigma, wider = (np.abs(each[:, columns]).ravel() for each in both)
        cells = [np.nanmedian(np.abs(each[:, columns])) for each, *_ in measured.values()]
        cells += [np.nanmedian(absolute), np.nanquantile(absolute, 0.9), np.nanmedian(sigma)]
        inside = [absolute < 0.6745 * sigma, absolute < 1.96 * sigma, relative < 1.96 * wider]
        first, second, third = (f"{100 * each.mean():.0f}" for each in inside)
        lines.append(
            [row, *(f"{each:.1f}" for each in cells), first, second,
             f"{np.nanmedian(relative):.1f}", third]
        )  # fmt: skip
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
