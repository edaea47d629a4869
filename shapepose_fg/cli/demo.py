"""The demo: the built-in scene reconstructed, compared with the truth, and drawn."""

from collections.abc import Callable
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
from shapepose_fg.evaluation.metrics import CORRECT_M, Matches, covariance_calibration, joint_metrics, match_people
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.solved_setup import CAMERAS
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.viz.report.writing import REPORT, write_report
from shapepose_fg.viz.viewer.picture import demo_picture


@dataclass(frozen=True)
class Demo:
    """The scene, what the simulated detector saw of it, and what was made of that."""

    scene: Scene
    """People with known truth."""
    detections: Recording
    """What the reconstruction was given."""
    people: Reconstruction
    """What it made of it."""

    @cached_property
    def matches(self) -> Matches:
        """Which row is which true person."""
        return match_people(self.people.frame, self.people.joints, self.scene.keypoints)

    @cached_property
    def error_m(self) -> np.ndarray:
        """(M, J, 3) of the rows that are matched, metres."""
        matches = self.matches
        return self.people.joints[matches.row] - self.scene.keypoints[matches.frame, matches.person]

    @cached_property
    def typical_frame(self) -> int:
        """The frame whose error is the median of all frames: the picture shows no lucky one."""
        frame, T = self.matches.frame, len(self.scene)
        count = np.bincount(frame, minlength=T)
        error = np.nanmean(np.linalg.norm(self.error_m, axis=-1), axis=-1)
        mean = np.bincount(frame, error, minlength=T) / np.maximum(count, 1)
        # People who were missed have no error: rank their frames last.
        return int(np.argsort(np.where(count == count.max(), mean, np.inf), kind="stable")[T // 2])

    def tables(self) -> RenderableType:
        """The comparison with the truth, for a terminal."""
        metrics = joint_metrics(self.people, self.scene.keypoints)
        distance_mm = 1e3 * np.linalg.norm(self.error_m, axis=-1)
        median_mm = float(np.nanmedian(distance_mm)) if distance_mm.size else float("nan")
        accuracy = {
            "people found": (f"{metrics.people_found} of {metrics.people_true}", "in all frames together"),
            "found twice": (str(metrics.people_duplicated), ""),
            "invented": (str(metrics.people_invented), ""),
            "precision": (_percent(metrics.precision), f"joints within {CORRECT_M} m, of those placed"),
            "recall": (_percent(metrics.recall), f"joints within {CORRECT_M} m, of all true ones"),
            "F1": (_percent(metrics.f1), ""),
            "MPJPE": (f"{metrics.mpjpe_mm:.1f} mm", "mean distance of a joint to the true one"),
            "median": (f"{median_mm:.1f} mm", "half of the joints are nearer than this"),
        }
        calibration = covariance_calibration(self.error_m, self.people.covariance[self.matches.row])
        covariances = {
            f"inside the {100 * level:.0f} % ellipsoid": (
                _percent(share),
                f"should be {100 * level:.0f} %; more is cautious",
            )
            for level, share in calibration.coverage.items()
        }
        covariances["mean NEES"] = (f"{calibration.mean_nees:.2f}", "should be 3; more is too sure")
        frames = max(len(self.scene), 1)
        spent = {stage: s for stage, s in self.people.run["seconds"].items() if stage != "load"}
        time = {stage: (f"{1e3 * each / frames:.1f}", "") for stage, each in spent.items()}
        time["all"] = (f"{1e3 * sum(spent.values()) / frames:.1f}", "bodies are cheaper in longer recordings")
        tables = {
            "Against the truth": accuracy,
            "Is the truth where the covariances say?": covariances,
            "Time, milliseconds a frame": time,
        }
        return Group(*(Padding(_table(title, rows), (1, 0, 0, 2)) for title, rows in tables.items()))

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
        picture, frame = folder / "picture.png", self.typical_frame
        seen, truth = self.detections[frame], self.scene.vertices_at(frame)
        demo_picture(picture, self.scene.rig, self.people, frame, seen, truth)
        return [*told, f"{picture}  frame {frame}, one of middling error; grey: the truth"]


def run_demo(progress: Callable[[int, int], None] | None = None) -> Demo:
    """Simulate what a detector sees of the built-in scene, and reconstruct it."""
    scene = built_in_scene()
    detections = simulate(scene)
    times = FrameTimes.from_fps(scene.fps, len(scene))
    people = reconstruct(detections, scene.rig, times=times, execution=Execution(progress=progress))
    return Demo(scene, detections, people)


def _table(title: str, rows: dict[str, tuple[str, str]]) -> Table:
    """Names, figures, and what they mean."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    table.show_header = False
    table.add_column()
    table.add_column(justify="right")
    table.add_column(style="dim")
    for name, (figure, meaning) in rows.items():
        table.add_row(name, figure, meaning)
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %" if np.isfinite(share) else "-"
