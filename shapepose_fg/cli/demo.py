"""The demo: the built-in scene reconstructed, compared with the truth, and drawn."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.alternation import JointErrors, alternation_errors, before_refinement
from shapepose_fg.evaluation.matching import Matches, match_people
from shapepose_fg.evaluation.metrics import CORRECT_M, covariance_calibration, joint_metrics
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.solved_setup import CAMERAS
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.viz.report.writing import REPORT, write_report
from shapepose_fg.viz.viewer.picture import demo_picture

_STAGES = {
    "triangulate": "pairs of views to 3D points",
    "vote": "points to 3D joint candidates",
    "propose": "candidates to new people",
    "associate": "new people to their 2D observations",
    "follow": "people from frame to frame",
    "associate again": "detections reassociated",
    "offsets": "where the detector puts joints on the body",
    "solve": "bodies and factor graphs, covariances",
    "bodies over time": "one shape a person, poses linked in time",
}
"""The stages that are worth a line, and what each does."""
SEEN_BADLY = 0.25
"""Mean confidence over all views under which the paper gives a joint to the body (its rho_3D)."""


@dataclass(frozen=True)
class Demo:
    """The scene, what the simulated detector saw of it, and what was made of that."""

    scene: Scene
    """People with known truth."""
    detections: Recording
    """What the reconstruction was given."""
    people: Reconstruction
    """What it made of it."""
    errors: JointErrors
    """How far joints are off before and after stage II."""

    @cached_property
    def matches(self) -> Matches:
        """Which row is which true person."""
        return match_people(self.people.frame, self.people.joints, self.scene.keypoints)

    @cached_property
    def typical_frame(self) -> int:
        """The frame whose error is the median of all frames: the picture shows no lucky one."""
        matches, T = self.matches, len(self.scene)
        true = self.scene.keypoints[matches.frame, matches.person]
        error = np.nanmean(np.linalg.norm(self.people.joints[matches.row] - true, axis=-1), axis=-1)
        count = np.bincount(matches.frame, minlength=T)
        mean = np.bincount(matches.frame, error, minlength=T) / np.maximum(count, 1)
        # People who were missed have no error: rank their frames last.
        return int(np.argsort(np.where(count == count.max(), mean, np.inf), kind="stable")[T // 2])

    def tables(self) -> RenderableType:
        """The comparison with the truth, for a terminal."""
        parts = (_accuracy(self), _alternation(self), _covariances(self), _time(self))
        return Group(*(Padding(part, (1, 0, 0, 2)) for part in parts))

    def draw(self, path: Path) -> None:
        """Write the picture of a typical frame."""
        frame = self.typical_frame
        seen, truth = self.detections[frame], self.scene.vertices_at(frame)
        demo_picture(path, self.scene.rig, self.people, frame, seen, truth)

    def save(self, folder: Path, *, report: bool = True) -> list[str]:
        """Write people.npz and what belongs to it, the report and the picture; returns what to tell the user."""
        self.people.save(folder)
        write_rig(self.scene.rig, folder / CAMERAS)
        told = [
            f"{folder / 'people.npz'}  joints, covariances and bodies",
            f"{folder / 'run.json'}  settings, times",
            f"{folder / 'observations.npz'}  which detections the joints are made of",
            f"{folder / CAMERAS}  the cameras",
        ]
        if report:
            told.append(f"{write_report(folder, self.people, self.scene.rig)}  to look at, in a browser")
        else:
            (folder / REPORT).unlink(missing_ok=True)
        picture = folder / "picture.png"
        self.draw(picture)
        return [*told, f"{picture}  frame {self.typical_frame}, one of middling error; grey: the truth"]


def run_demo(progress: Callable[[int, int], None] | None = None, scene: Scene | None = None) -> Demo:
    """Simulate what a detector sees of the scene (by default the built-in one), and reconstruct it."""
    scene = built_in_scene() if scene is None else scene
    detections = simulate(scene)
    config = PipelineConfig()
    before = before_refinement(detections, scene.rig, config)
    times = FrameTimes.from_fps(scene.fps, len(scene))
    people = reconstruct(detections, scene.rig, config, times=times, execution=Execution(progress=progress))
    return Demo(scene, detections, people, alternation_errors(before, people, scene.keypoints))


def _accuracy(demo: Demo) -> Table:
    """How many people and joints are right."""
    metrics = joint_metrics(demo.people, demo.scene.keypoints)
    median_mm = float(np.nanmedian(demo.errors.after_mm)) if demo.errors.after_mm.size else float("nan")
    rows = (
        ("people found", f"{metrics.people_found} of {metrics.people_true}", "in all frames together"),
        ("found twice", str(metrics.people_duplicated), ""),
        ("invented", str(metrics.people_invented), ""),
        ("precision", _percent(metrics.precision), f"joints within {CORRECT_M} m, of those placed"),
        ("recall", _percent(metrics.recall), f"joints within {CORRECT_M} m, of all true ones"),
        ("F1", _percent(metrics.f1), ""),
        ("MPJPE", f"{metrics.mpjpe_mm:.1f} mm", "mean distance of a joint to the true one"),
        ("median", f"{median_mm:.1f} mm", "half of the joints are nearer than this"),
    )
    return _table("Against the truth", rows)


def _alternation(demo: Demo) -> Table:
    """What the factor graphs and the body make of what the views alone say."""
    notes = (f"mean confidence {SEEN_BADLY:g} or more", "less: body and motion help", "the body fills them in")
    rows = [
        (name, str(int(mask.sum())), _mm(demo.errors.before_mm[mask]), _mm(demo.errors.after_mm[mask]), note)
        for (name, mask), note in zip(demo.errors.groups(SEEN_BADLY).items(), notes, strict=True)
    ]
    title = "What comes after stage I: mean distance to the truth"
    return _table(title, rows, ("joints", "count", "before", "after", ""))


def _covariances(demo: Demo) -> Table:
    """Whether a joint lies where its covariance says."""
    matches, people = demo.matches, demo.people
    error = people.joints[matches.row] - demo.scene.keypoints[matches.frame, matches.person]
    calibration = covariance_calibration(error, people.covariance[matches.row])
    rows = [
        (
            f"inside the {100 * level:.0f} % ellipsoid",
            _percent(share),
            f"should be {100 * level:.0f} %; more is cautious",
        )
        for level, share in calibration.coverage.items()
    ]
    rows.append(("mean NEES", f"{calibration.mean_nees:.2f}", "should be 3; more is too sure"))
    return _table("Is the truth where the covariances say?", rows)


def _time(demo: Demo) -> Table:
    """Milliseconds a frame, stage by stage."""
    seconds, frames = demo.people.run["seconds"], max(len(demo.scene), 1)
    total = sum(spent for stage, spent in seconds.items() if stage != "load")
    stages = [(stage, f"{1e3 * seconds.get(stage, 0.0) / frames:.1f}", what) for stage, what in _STAGES.items()]
    whole = ("all", f"{1e3 * total / frames:.1f}", "bodies are cheaper in longer recordings")
    return _table("Time, milliseconds a frame", [*stages, whole])


def _table(title: str, rows: Iterable[tuple[str, ...]], heads: Sequence[str] = ("", "", "")) -> Table:
    """Names, figures, and in the last column what they mean."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    table.show_header = any(heads)
    for n, head in enumerate(heads):
        inner = 0 < n < len(heads) - 1
        table.add_column(
            head,
            "",
            justify="right" if inner else "left",
            header_style="dim",
            style="dim" if n + 1 == len(heads) else "",
        )
    for row in rows:
        table.add_row(*row)
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %" if np.isfinite(share) else "-"


def _mm(errors: np.ndarray) -> str:
    """Mean of the errors that are known."""
    known = errors[np.isfinite(errors)]
    return f"{known.mean():.0f} mm" if known.size else "-"
