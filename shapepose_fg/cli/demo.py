"""The command `demo`: reconstructs the built-in scene and compares the result with the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.score import Score, score
from shapepose_fg.evaluation.truth import people_of
from shapepose_fg.io.solved_setup import CAMERAS
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.viz.report.writing import REPORT, write_report


@dataclass(frozen=True)
class Demo:
    """The scene, and its reconstruction from simulated detections."""

    scene: Scene
    """People with known truth."""
    people: Reconstruction
    """The reconstruction."""

    def score(self) -> Score:
        """The comparison with the truth."""
        return score(people_of(self.people), people_of(truth_of(self.scene)))

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
