"""Measure the set-up check: detected faults, and false findings on correct cameras with biased
detectors.

    python scripts/check_setups.py --rigs 0:20 --output checks.csv

Simulated rooms with 3 to 6 cameras and 1 to 8 people, 6 s each. In every room the same kinds of
faults are simulated with a detector of typical errors; detectors with persistent biases are
simulated without faults. Run it from a clone. It prints the tables of docs/evaluation/cameras.md,
with --read of files that it wrote. About a minute and a half per room on one core.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from typer import Option, Typer

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.check.report import check_setup
from shapepose_fg.core.detections import Recording
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from tests.cameras.check.spoiled_setups import (
    Spoiled,
    biased,
    delayed,
    exchanged,
    inverted,
    lasting,
    mirrored,
    moved,
    resized,
    shifted,
    turned,
    turning,
    zoomed,
)

FRAMES = 150


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    rigs: Annotated[str, Option(help="Which rooms, first:stop.")] = "0:20",
    output: Annotated[Path | None, Option(help="CSV file with a line for each check.")] = None,
    only: Literal["faults", "biases"] | None = None,
    read: Annotated[list[Path] | None, Option(help="Such a file, instead of rooms.")] = None,
) -> None:
    """Check the rooms, and print the tables."""
    rows = list[list[object]]()
    for file in read or ():
        lines = file.read_text(encoding="utf-8").splitlines()
        rows += [list[object](line) for line in csv.reader(lines)]
    for seed in () if rows else range(*map(int, rigs.split(":"))):
        rng = np.random.default_rng([seed, 20])
        people, cameras = int(rng.choice([1, 2, 3, 4, 6, 8])), int(rng.integers(3, 7))
        scene = built_in_scene(seed, people=people, cameras=cameras, frames=FRAMES)
        seen, room = simulate(scene, seed=seed), (seed, people, cameras)
        for each in _faults(seen, scene, rng) if only != "biases" else ():
            found = [
                f for f in check_setup(each.detections, each.rig).findings if not _of_several(f)
            ]
            possible = [*found, *(other for f in found[:1] for other in f.instead)]
            first_named, named = each.named_by(found[:1]), each.named_by(possible)
            rows.append(
                [*room, "fault", each.what, first_named and len(found) == 1, named, _words(found)]
            )
            print(*rows[-1], flush=True)
        for what, detections in _biased(seen, scene, rng) if only != "faults" else ():
            found = check_setup(detections, scene.rig).findings
            rows.append([*room, "sound", what, len(found) > 0, False, _words(found)])
            print(*rows[-1], flush=True)
    if output is not None:
        with output.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    for kind, titles in (("fault", "named first | named |"), ("sound", "accused |")):
        counts = defaultdict[str, list[list[bool]]](list)
        for *_, of, what, first_named, named, _said in rows:
            for name in (what, f"all {kind}") if of == kind else ():
                counts[str(name)].append([str(each) == "True" for each in (first_named, named)])
        print(f"\n| {kind} | checks | {titles}\n|---|{'---|' * titles.count('|')}---|")
        for name, each in counts.items():
            sums = np.sum(each, axis=0)[: titles.count("|")]
            print(f"| {name} | {len(each)} | {' | '.join(map(str, sums))} |")


def _of_several(finding: Finding) -> bool:
    return finding.kind == Kind.PRINCIPAL_POINT and len(finding.cameras) > 1


def _words(found: list[Finding] | tuple[Finding, ...]) -> str:
    return "; ".join(f"{f.kind} {f.cameras} {f.amount:.3g} p {f.probability:.2f}" for f in found)


def _faults(seen: Recording, scene: Scene, rng: np.random.Generator) -> Iterator[Spoiled]:
    """One fault of each kind, on a randomly drawn camera; all faults move joints by 2 cm or
    more.
    """
    rig = scene.rig

    def view() -> int:
        return int(rng.integers(len(rig)))

    def sign() -> int:
        return int(rng.choice([-1, 1]))

    for degrees in (1.0, 2.0, 5.0, 20.0):
        v = view()
        yield Spoiled(
            f"turned {degrees:g}",
            seen,
            turned(rig, v, degrees, rng.normal(size=3)),
            Kind.TURNED,
            (v,),
        )
    for metres in (0.1, 0.3):
        v = view()
        yield Spoiled(
            f"moved {metres:g}", seen, moved(rig, v, metres, rng.normal(size=3)), Kind.MOVED, (v,)
        )
    for factor in (1.08, 1.5):
        v, by = view(), factor ** sign()
        yield Spoiled(f"focal length {factor:g}", seen, zoomed(rig, v, by), Kind.FOCAL, (v,))
    for pixels in (25.0, 100.0):
        v, angle = view(), rng.uniform(0, 2 * np.pi)
        shifted_rig = shifted(rig, v, pixels * np.cos(angle), pixels * np.sin(angle))
        yield Spoiled(f"shifted {pixels:g}", seen, shifted_rig, Kind.PRINCIPAL_POINT, (v,))
    v, frames = view(), int(rng.integers(6, 11)) * sign()
    yield Spoiled("late", delayed(seen, v, frames), rig, Kind.LATE, (v,), frames)
    v, w = sorted(rng.choice(len(rig), 2, replace=False).tolist())
    yield Spoiled("exchanged", seen, exchanged(rig, v, w), Kind.EXCHANGED, (v, w))
    v = view()
    yield Spoiled("inverse pose", seen, inverted(rig, (v,)), Kind.INVERTED, (v,))
    yield Spoiled("mirrored", mirrored(seen, rig, v := view()), rig, Kind.MIRRORED, (v,))
    yield Spoiled("picture size", resized(seen, (v := view(),), 0.5), rig, Kind.RESIZED, (v,))
    v, half = view(), FRAMES // 2
    yield Spoiled(
        "bumped 3", turning(seen, rig, v, lambda t: 3.0 * (t >= half)), rig, Kind.BUMPED, (v,)
    )
    yield Spoiled(
        "drifting 8",
        turning(seen, rig, v := view(), lambda t: 8 * t / FRAMES),
        rig,
        Kind.DRIFTING,
        (v,),
    )


def _biased(
    seen: Recording, scene: Scene, rng: np.random.Generator
) -> Iterator[tuple[str, Recording]]:
    """The recording as detected by detectors with persistent biases."""
    shape = scene.people, 25, len(scene.rig)
    people = np.array([scene.truth_at(frame) for frame in range(len(seen))])
    yield "no bias", seen
    # Minimum and maximum bias of a joint in a view, as shares of the person's size.
    for low, high in ((0.02, 0.04), (0.02, 0.12), (0.06, 0.12)):
        one_view, one_person = np.zeros((*shape, 2)), np.zeros((*shape, 2))
        one_view[:, :, rng.integers(shape[2])] = lasting(rng, low, high, shape[1])
        one_person[rng.integers(shape[0]), :, rng.integers(shape[2])] = lasting(rng, low, high)
        for what, bias in (
            ("by person, joint and view", lasting(rng, low, high, *shape)),
            ("by joint and view", np.zeros((*shape, 2)) + lasting(rng, low, high, *shape[1:])),
            ("by joint, one view", one_view),
            ("one person in one view", one_person),
        ):
            yield (
                f"{what}, {100 * low:g} to {100 * high:g} %",
                biased(seen, scene.rig, people, bias),
            )
    sizes = rng.uniform(-0.08, 0.08, (shape[0], 1, shape[2], 1))
    yield (
        "size by person and view, up to 8 %",
        biased(seen, scene.rig, people, np.zeros((*shape, 2)), sizes),
    )


if __name__ == "__main__":
    app()
