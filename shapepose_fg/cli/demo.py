"""The command `demo`: reconstructs the built-in scene and compares the result with the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table

from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.metrics import (
    CORRECT_M,
    covariance_calibration,
    joint_metrics,
    match_people,
)
from shapepose_fg.io.solved_setup import CAMERAS
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.viz.report.writing import REPORT, write_report


@dataclass(frozen=True)
class Demo:
    """The scene, and its reconstruction from simulated detections."""

    scene: Scene
    """People with known truth."""
    people: Reconstruction
    """The reconstruction."""

    def tables(self) -> RenderableType:
        """The comparison with the truth, as tables for a terminal."""
        people, truth = self.people, self.scene.keypoints
        metrics, matches = (
            joint_metrics(people, truth),
            match_people(people.frame, people.joints, truth),
        )
        error_m = people.joints[matches.row] - truth[matches.frame, matches.person]
        distance_mm = 1e3 * np.linalg.norm(error_m, axis=-1)
        median_mm = float(np.nanmedian(distance_mm)) if distance_mm.size else float("nan")
        accuracy = {
            "people found": (
                f"{metrics.people_found} of {metrics.people_true}",
                "in all frames together",
            ),
            "duplicates": (str(metrics.people_duplicated), ""),
            "false positives": (str(metrics.people_invented), ""),
            "precision": (
                _percent(metrics.precision),
                f"estimated joints within {CORRECT_M} m of the truth",
            ),
            "recall": (
                _percent(metrics.recall),
                f"true joints with an estimate within {CORRECT_M} m",
            ),
            "F1": (_percent(metrics.f1), ""),
            "MPJPE": (
                f"{metrics.mpjpe_mm:.1f} mm",
                "mean distance between estimated and true joints",
            ),
            "median": (f"{median_mm:.1f} mm", "median of the same distance"),
        }
        calibration = covariance_calibration(error_m, people.covariance[matches.row])
        covariances = {
            f"inside the {100 * level:.0f} % ellipsoid": (
                _percent(share),
                f"nominal: {100 * level:.0f} %; higher: underconfident",
            )
            for level, share in calibration.coverage.items()
        }
        covariances["mean NEES"] = (
            f"{calibration.mean_nees:.2f}",
            "nominal: 3; higher: overconfident",
        )
        frames = max(len(self.scene), 1)
        spent = {stage: s for stage, s in people.run["seconds"].items() if stage != "load"}
        time = {stage: (f"{1e3 * each / frames:.1f}", "") for stage, each in spent.items()}
        time["all"] = (
            f"{1e3 * sum(spent.values()) / frames:.1f}",
            "bodies are cheaper in longer recordings",
        )
        tables = {
            "Comparison with the truth": accuracy,
            "Calibration of the covariances": covariances,
            "Time per frame, ms": time,
        }
        return Group(
            *(Padding(_table(title, rows), (1, 0, 0, 2)) for title, rows in tables.items())
        )

    def save(self, folder: Path, *, report: bool = True) -> list[str]:
        """Write all files of the result, and the report; returns notes for the user."""
        self.people.save(folder)
        told = [
            f"{folder / 'people.npz'}  joints, covariances and bodies",
            f"{folder / 'run.json'}  settings and times",
            f"{folder / 'observations.npz'}  detections assigned to each joint",
            f"{folder / CAMERAS}  the cameras",
        ]
        if report:
            told.append(
                f"{write_report(folder, self.people, self.scene.rig)}  open it in a browser"
            )
        else:
            (folder / REPORT).unlink(missing_ok=True)
        return told


def run_demo(progress: Callable[[int, int], None] | None = None) -> Demo:
    """Simulate detections of the built-in scene, and reconstruct it."""
    scene = built_in_scene()
    detections = simulate(scene)
    times = FrameTimes.from_fps(scene.fps, len(scene))
    people = reconstruct(detections, scene.rig, times=times, execution=Execution(progress=progress))
    return Demo(scene, people)


def _table(title: str, rows: dict[str, tuple[str, str]]) -> Table:
    """A table of names, values, and their meanings."""
    table = Table(
        title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0)
    )
    table.show_header = False
    table.add_column()
    table.add_column(justify="right")
    table.add_column(style="dim")
    for name, (figure, meaning) in rows.items():
        table.add_row(name, figure, meaning)
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %" if np.isfinite(share) else "-"
