"""Pages of close-ups: initial and final poses, failures over time, limbs that Shelf's annotation has elsewhere."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.pictures.choice import (
    ODD_SHARE,
    WRONG_M,
    Beside,
    Rows,
    farthest,
    mean_error,
    missing,
    most,
    odd_limbs,
    oddest,
)
from shapepose_fg.evaluation.pictures.close_up import (
    MISSING,
    ODD,
    WRONG,
    Circle,
    clear_views,
    draw_close_up,
    greyed,
)
from shapepose_fg.evaluation.shelf import LIMB_NAMES, LIMBS
from shapepose_fg.evaluation.shelf_events import LostLimb
from shapepose_fg.evaluation.shelf_ground_truth import ShelfGroundTruth
from shapepose_fg.evaluation.trajectories import LIMB_ENDS
from shapepose_fg.simulation import Scene
from shapepose_fg.viz.viewer.drawing import INK, QUIET, panel, tag
from shapepose_fg.viz.viewer.figures import Figures, Mesh, floor_under, framed
from shapepose_fg.viz.viewer.floor import Floor
from shapepose_fg.viz.viewer.palette import PALETTE

Array = NDArray[np.float64]

_WIDTH, _HEIGHT, _GAP, _TOP, _LABEL = 270, 300, 8, 58, 24
"""Of a close-up, between them, of the page's head, of the line above each row, pixels."""
_RULES = {
    "most joints missing": missing,
    "joint farthest off": farthest,
    "most abnormal limb": oddest,
}
_ANNOTATED = "#d0342c"
_UNLIKE_RINGS = (PALETTE[2], PALETTE[3], PALETTE[7], PALETTE[6])
"""Colours of people that are none of those of rings."""
_DOTS_PER_INCH = 100


def draw_before_after(file: Path, parts: Sequence[Rows]) -> None:
    """For each stretch the frame that each rule picks: the pose before stage II, and after it."""
    page = _Page(columns=2 * len(parts), rows=len(_RULES))
    page.head("Initial poses, and final ones", "each frame by itself; grey: the truth")
    page.legend({MISSING: "missing joint", WRONG: "joint more than 0.2 m off", ODD: "limb 30 % too long or short"})
    shown: list[list[int]] = [[] for _ in parts]
    for line, (name, rule) in enumerate(_RULES.items()):
        for place, rows in enumerate(parts):
            row = most(rows, rule, without=shown[place])[0]
            shown[place].append(row)
            page.label(line, 2 * place, f"{name}: {_where(rows, row)}")
            for step, joints in enumerate(rows.joints.values()):
                axes = page.panel(line, 2 * place + step)
                _draw_row(axes, page.size, rows, row, joints[row], view=0, marked=True)
                tag(axes, ("initial", "final")[step])
    page.save(file)


def draw_failures(file: Path, parts: Sequence[Rows], each: int = 2) -> None:
    """For each stretch the people with the largest mean error over time, in two views, with the detections."""
    page = _Page(columns=each * len(parts), rows=2)
    page.head("Where it fails: the largest mean errors of a person", "over time, all defaults; grey: the truth")
    page.legend({MISSING: "missing joint", WRONG: "joint more than 0.2 m off", INK: "2D candidates"})
    for place, rows in enumerate(parts):
        for number, row in enumerate(most(rows, mean_error, each)):
            column = each * place + number
            error = np.linalg.norm(rows.first[row] - rows.truth[row], axis=-1)
            worst = BODY_25.joints[int(np.nanargmax(error))]
            page.label(0, column, f"{_where(rows, row)}")
            page.label(
                1, column, f"mean {1e3 * np.nanmean(error):.0f} mm, {worst} {1e3 * np.nanmax(error):.0f} mm"
            )
            for line in (0, 1):
                axes = page.panel(line, column)
                name = _draw_row(axes, page.size, rows, row, rows.first[row], view=line, marked=False, dots=True)
                tag(axes, name)
    page.save(file)


def draw_methods(file: Path, parts: Sequence[Beside], around_m: float = 1.0) -> None:
    """For each stretch its frame of closest contact, as each method has it: a row of the page a stretch.

    Drawn is everybody whom a method finds with a joint within `around_m` of the pair's middle; rings are around
    what is wrong with the two.
    """
    names = list(parts[0].people)
    page = _Page(columns=len(names), rows=len(parts))
    page.head(
        "The closest contact of each sequence, by each method",
        "the same detections for all; of the 50 joints of the two; grey: the truth",
    )
    page.legend({MISSING: "missing joint", WRONG: "joint more than 0.2 m off"})
    for line, part in enumerate(parts):
        scene, pair = part.stretch.scene, list(part.pair)
        bodies, truth = scene.vertices_at(part.frame), scene.keypoints[part.frame]
        camera = scene.rig.cameras[clear_views(scene.rig, bodies, scene.body.faces, pair)[0]]
        ghosts, floor = greyed(bodies, scene.body.faces, pair), _floor(scene, bodies)
        focus = truth[pair].reshape(-1, 3)
        for column, name in enumerate(names):
            here = part.here(name)
            distance = np.linalg.norm(here - focus.mean(axis=0), axis=-1)
            near = np.nan_to_num(distance, nan=np.inf).min(axis=1) < around_m
            found = part.of_the_pair(name)
            circles = [each for joints, true in zip(found, truth[pair], strict=True)
                       for each in _circles(joints, true, limbs=False)]  # fmt: skip
            wrong = sum(each.colour == WRONG for each in circles)
            page.label(line, column, f"{name}: {len(circles) - wrong} missing, {wrong} wrong")
            axes = page.panel(line, column)
            colours = [_UNLIKE_RINGS[number % len(_UNLIKE_RINGS)] for number in range(int(near.sum()))]
            draw_close_up(
                axes, camera, page.size, ghosts, floor, here[near], colours, focus=focus, circles=tuple(circles)
            )
            if column == 0:
                tag(axes, f"{part.stretch.name}, frame {part.stretch.span[part.frame]}")
    page.save(file)


def draw_lost_limbs(
    file: Path,
    people: Reconstruction,
    rig: Rig,
    detections: DetectionSequence,
    truth: ShelfGroundTruth,
    events: Sequence[LostLimb],
    rows: Sequence[int],
) -> None:
    """The middle frame of each event on Shelf, in two views: our skeleton, and in red the annotated one.

    `rows` are the people that the events' actors take in those frames; bodies are ours, for there are no others.
    """
    page = _Page(columns=len(events), rows=2)
    page.head("Shelf: limbs that are lost for longest", "grey: our bodies")
    page.legend({_ANNOTATED: "annotated limbs, the lost one thick", INK: "2D candidates"})
    body = BodyModel.default()
    for column, (event, row) in enumerate(zip(events, rows, strict=True)):
        frame = int(people.frame[row])
        here = people.at(frame)
        figures = Figures.of(here, body)
        order = np.argsort(here.person, kind="stable")
        person = int(np.flatnonzero(here.person[order] == people.person[row])[0])
        bodies = figures.mesh.vertices.reshape(-1, body.num_vertices, 3)
        those = (truth.frame == frame) & (truth.actor == event.actor - 1)
        annotated = truth.joints[those][0]
        page.label(0, column, f"actor {event.actor}: {event.limb}")
        page.label(1, column, f"frames {event.first} to {event.last}; this one: {frame}")
        ghosts = greyed(bodies, body.faces, [person])
        floor = floor_under(rig, figures, Mesh.clay(None, body.faces))
        for line, view in enumerate(clear_views(rig, bodies, body.faces, [person])):
            axes = page.panel(line, column)
            focus = np.concatenate([people.joints[row], annotated])
            focus = focus[np.isfinite(focus).all(axis=1)]
            seen = detections[frame]
            draw_close_up(
                axes, rig.cameras[view], page.size, ghosts, floor, people.joints[[row]], PALETTE[:1],
                focus=focus, candidates=seen.xy[seen.view == view],
            )  # fmt: skip
            xy, _ = framed(rig.cameras[view], focus, page.size).project(annotated)
            for limb, ends in enumerate(LIMBS):
                lost = LIMB_NAMES[limb] == event.limb
                axes.plot(*xy[list(ends)].T, color=_ANNOTATED, lw=3.0 if lost else 1.0, zorder=4)
            tag(axes, f"camera {rig.cameras[view].name}")
    page.save(file)


def _draw_row(
    axes: Any,
    size: tuple[int, int],
    rows: Rows,
    row: int,
    joints: Array,
    *,
    view: int,
    marked: bool,
    dots: bool = False,
) -> str:
    """A person of a simulated stretch in the first or second of the clear views; returns the camera's name."""
    scene, frame, person = rows.stretch.scene, int(rows.frame[row]), int(rows.person[row])
    bodies, faces = scene.vertices_at(frame), scene.body.faces
    chosen = clear_views(scene.rig, bodies, faces, [person])[view]
    truth = rows.truth[row]
    seen = rows.stretch.detections[frame]
    focus = np.concatenate([truth, *(each[row] for each in rows.joints.values())])
    near = np.linalg.norm(focus - truth.mean(axis=0), axis=-1) < 1.5  # what is lost in the room is not framed
    draw_close_up(
        axes,
        scene.rig.cameras[chosen],
        size,
        greyed(bodies, faces, [person]),
        _floor(scene, bodies),
        joints[None],
        PALETTE[:1],
        focus=focus[near],
        circles=tuple(_circles(joints, truth, limbs=marked)),
        candidates=seen.xy[seen.view == chosen] if dots else None,
    )
    return scene.rig.cameras[chosen].name


def _floor(scene: Scene, bodies: NDArray[np.floating]) -> Floor:
    """Under the true bodies."""
    faces = scene.body.faces
    nobody = Figures(np.zeros((0, 25, 3)), np.zeros(0, dtype=bool), np.zeros((0, 3)), (), Mesh.clay(None, faces))
    return floor_under(scene.rig, nobody, Mesh.clay(bodies, faces))


def _circles(joints: Array, truth: Array, *, limbs: bool) -> list[Circle]:
    """What is wrong with a pose."""
    error = np.linalg.norm(joints - truth, axis=-1)
    circles = [Circle(place, MISSING) for place in truth[np.isnan(error)]]
    circles += [Circle(place, WRONG) for place in joints[error > WRONG_M]]
    if limbs:
        odd = np.abs(odd_limbs(joints, truth)) > ODD_SHARE
        circles += [Circle(joints[list(LIMB_ENDS[limb])].mean(axis=0), ODD) for limb in np.flatnonzero(odd)]
    return circles


def _where(rows: Rows, row: int) -> str:
    """Stretch and frame, as the sequence counts it."""
    return f"{rows.stretch.name}, frame {rows.stretch.span[int(rows.frame[row])]}"


class _Page:
    """A grid of close-ups with a head, and a line of text above each row."""

    def __init__(self, columns: int, rows: int):
        from matplotlib.figure import Figure

        self.size = _WIDTH, _HEIGHT
        self._across = columns * (_WIDTH + _GAP) + _GAP
        self._down = _TOP + rows * (_HEIGHT + _LABEL + _GAP) + _GAP
        inches = self._across / _DOTS_PER_INCH, self._down / _DOTS_PER_INCH
        self._page = Figure(figsize=inches, dpi=_DOTS_PER_INCH, facecolor="white")

    def head(self, title: str, note: str) -> None:
        """Title on the left, remark on the right."""
        y = 1 - 16 / self._down
        self._page.text(_GAP / self._across, y, title, va="center", fontsize=12, fontweight="bold", color=INK)
        self._page.text(1 - _GAP / self._across, y, note, va="center", ha="right", fontsize=8.5, color=QUIET)

    def legend(self, signs: dict[str, str]) -> None:
        """What the colours mean: rings, but for detections, which are dots, and the annotation, which is lines."""
        from matplotlib.lines import Line2D

        handles = []
        for colour, text in signs.items():
            if colour == _ANNOTATED:
                handles.append(Line2D([], [], lw=2.5, color=colour, label=text))
                continue
            dot = colour == INK
            fill, size = (colour, 3) if dot else ("none", 8)
            handles.append(Line2D([], [], lw=0, marker="o", ms=size, mec=colour, mfc=fill, mew=1.8, label=text))
        self._page.legend(
            handles=handles,
            loc="center left",
            bbox_to_anchor=(0, 1 - 42 / self._down),
            ncols=len(handles),
            frameon=False,
            fontsize=8.5,
            labelcolor=INK,
            handletextpad=0.4,
        )

    def label(self, row: int, column: int, text: str) -> None:
        """Write above a close-up."""
        x = _GAP + column * (_WIDTH + _GAP)
        y = _TOP + row * (_HEIGHT + _LABEL + _GAP) + _LABEL / 2
        self._page.text(x / self._across, 1 - y / self._down, text, va="center", fontsize=8.5, color=INK)

    def panel(self, row: int, column: int) -> Any:
        """The axes of a close-up."""
        box = _GAP + column * (_WIDTH + _GAP), _TOP + _LABEL + row * (_HEIGHT + _LABEL + _GAP), _WIDTH, _HEIGHT
        return panel(self._page, box, (self._across, self._down))

    def save(self, file: Path) -> None:
        """Write it; a .jpg small enough for a page on the web."""
        self._page.savefig(file, dpi=_DOTS_PER_INCH, pil_kwargs={"quality": 75} if file.suffix == ".jpg" else None)
