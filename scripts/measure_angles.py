"""Measure tables of docs/evaluation/angles.md: python scripts/measure_angles.py --mocap FILE.

People of the named sequences and of the built-in scene, 10 s at 15 frames a second, in front of
simulated cameras: errors from 3 s on, of people who are there in the first second. `--update`
writes the tables into the page between the marks `<!-- angles -->` and `<!-- end -->`, and
`<!-- elbows -->` and `<!-- end -->`. About a minute per recording on one core.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option, Typer

from shapepose_fg.biomechanics.joint_angles import NAMES, joint_angles
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.evaluation.tracking import joints_by_frame
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import sequence

PAGE = Path(__file__).parent.parent / "docs" / "evaluation" / "angles.md"
FPS, SECONDS = 15.0, 10
SIDES = ("right", "left")
RECORDINGS = {"salsa": (6, 3), "crossing": (4,), "crowd": (6, 4)}
"""Numbers of cameras in front of which each sequence is simulated."""
ROWS = (
    "hip flexion, hip adduction, hip rotation, knee flexion, ankle flexion, ankle inversion, "
    "shoulder elevation, shoulder plane, shoulder rotation, elbow flexion, trunk flexion, "
    "trunk bending, trunk rotation, pelvis tilt, pelvis obliquity, pelvis rotation"
).split(", ")


def scenes(mocap: Mocap) -> Iterator[tuple[str, Scene]]:
    """The recordings by name."""
    yield "demo, 6", built_in_scene(frames=int(FPS * SECONDS), fps=FPS)
    for name, counts in RECORDINGS.items():
        for cameras in counts:
            frames = int(FPS * SECONDS)
            made = sequence(name, "report", mocap, cameras=cameras, until=frames, fps=FPS)
            yield f"{name}, {cameras}", made.part(range(frames))


ELBOWS = (
    "the reconstruction",
    "the reconstruction, where two views see the three joints",
    "the body, turned until its joints have the angle of the estimated joints",
    "the angle between the three estimated joints",
    "the same with the true shoulder",
    "the same with the true elbow",
    "the same with the true wrist",
)
"""Sources of the flexion of elbows; the last four are compared with the angle of true joints."""


def measure(scene: Scene) -> tuple[Array, Array, Array]:
    """Errors of the angles (N, A), their sigmas, and errors of elbows (2 N, 7), degrees."""
    times = FrameTimes.from_fps(FPS, len(scene))
    people, truth = reconstruct(simulate(scene), scene.rig, times=times), truth_of(scene)
    matches = match_people(people.frame, people.joints, joints_by_frame(truth))
    numbers = np.unique(truth.person)[matches.person]
    from_start = np.isin(numbers, numbers[matches.frame < FPS])
    scored = np.flatnonzero(from_start & (matches.frame >= 3 * FPS))
    rows = [
        np.flatnonzero((truth.frame == frame) & (truth.person == person))[0]
        for frame, person in zip(matches.frame[scored], numbers[scored], strict=True)
    ]
    people, truth = people.rows(matches.row[scored]), truth.rows(np.array(rows))
    found, true = (joint_angles(each, scene.rig.up) for each in (people, truth))
    error = (found.degrees - true.degrees + 180) % 360 - 180
    sides = [elbows(people, truth, error[:, NAMES.index(f"{s}_elbow_flexion")], s) for s in SIDES]
    return error, found.sigma, np.concatenate(sides)


def elbows(people: Reconstruction, truth: Reconstruction, error: Array, side: str) -> Array:
    """Errors (N, 7) of a side's elbow from each source of `ELBOWS`; `error` (N,) is the first."""
    names = [f"{side[0].upper()}{each}" for each in ("Shoulder", "Elbow", "Wrist")]
    limb = [people.joint_names.tolist().index(name) for name in names]
    joints, true = people.joints[:, limb], truth.joints[:, limb]
    parts = (people.betas, people.global_orient, people.body_pose, people.transl)
    model = BodyModel.default().with_keypoints(tuple(people.joint_names.tolist()))
    body = model.keypoints(BodyParameters(*parts))[:, limb]
    assert people.observations is not None
    seen = ((people.observations.gate[:, limb] == 1).sum(axis=-1) >= 2).all(axis=-1)
    mixed = [np.where(np.arange(3)[:, None] == n, true, joints) for n in (-1, 0, 1, 2)]
    turned = error + flexion(joints) - flexion(body)
    columns = [error, np.where(seen, error, np.nan), turned]
    return np.stack(columns + [flexion(each) - flexion(true) for each in mixed], axis=-1)


def flexion(limb: Array) -> Array:
    """(N,) angle between the two segments of three joints (N, 3, 3), degrees."""
    first, second = np.diff(limb, axis=1).swapaxes(0, 1)
    lengths = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    return np.degrees(np.arccos(np.clip((first * second).sum(axis=-1) / lengths, -1, 1)))


def elbow_table(errors: Array) -> str:
    """The table of elbows in Markdown, from errors (N, 7)."""
    lines = ["| elbow flexion from | median error | 90 % |", "| --- | --- | --- |"]
    figures = np.nanquantile(np.abs(errors), (0.5, 0.9), axis=0).T
    rows = zip(ELBOWS, figures, strict=True)
    return "\n".join(lines + [f"| {row} | {a:.1f} | {b:.1f} |" for row, (a, b) in rows])


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


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    mocap: Annotated[Path, Option(help="File of recorded motions.")],
    update: Annotated[bool, Option("--update", help="Write the tables into the page.")] = False,
) -> None:
    """Measure, print and perhaps write the table."""
    measured = {name: measure(scene) for name, scene in scenes(Mocap.load(mocap))}
    page = PAGE.read_text(encoding="utf-8")
    for name, rows in (
        ("angles", table({name: each[:2] for name, each in measured.items()})),
        ("elbows", elbow_table(np.concatenate([each[2] for each in measured.values()]))),
    ):
        text = f"<!-- {name} -->\n\n{rows}\n\n<!-- end -->"
        print(text)
        page = re.sub(f"<!-- {name} -->.*?<!-- end -->", lambda _, t=text: t, page, flags=re.DOTALL)
    if update:
        PAGE.write_text(page, "utf-8")


if __name__ == "__main__":
    app()
