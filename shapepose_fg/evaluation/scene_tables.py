"""Built-in scenes, every frame by itself, as Markdown tables: accuracy, cameras, stage II, covariances."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.alternation import BeforeRefinement, alternation_errors, before_refinement
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import JointMetrics, covariance_calibration, joint_metrics
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

SEEDS = (2000, 2001, 2002, 2003, 2004)
"""Scenes that were never looked at while the pipeline was made: change them once they have been."""
DEMO = 0
"""The scene of `shapepose-fg demo`."""
CAMERAS = (2, 3, 4, 6, 8, 10)
"""Numbers of cameras that are compared."""
CONFIG = replace(PipelineConfig(), temporal=False)
"""Every frame by itself."""
DOUBTFUL = 0.25
"""A joint whose mean confidence over all views is less is seen badly (the paper's rho_3D)."""


@dataclass(frozen=True)
class Trial:
    """A scene, simulated and reconstructed."""

    seed: int
    """Of the scene and of the detector."""
    cameras: int = 6
    """Views."""
    frames: int = 60
    """Of the scene."""

    @cached_property
    def scene(self):
        """The people and cameras."""
        return built_in_scene(self.seed, cameras=self.cameras, frames=self.frames)

    @cached_property
    def detections(self):
        """What the simulated detector saw."""
        return simulate(self.scene, seed=self.seed)

    @cached_property
    def before(self) -> BeforeRefinement:
        """After stage I."""
        return before_refinement(self.detections, self.scene.rig, CONFIG)

    def run(self, config: PipelineConfig) -> Reconstruction:
        """Reconstructed with other settings."""
        return reconstruct(self.detections, self.scene.rig, config)

    @cached_property
    def people(self) -> Reconstruction:
        """Reconstructed with the default settings."""
        return self.run(CONFIG)

    @cached_property
    def metrics(self) -> JointMetrics:
        """Against the truth."""
        return joint_metrics(self.people, self.scene.keypoints)

    @cached_property
    def error(self) -> tuple[NDArray, NDArray]:
        """Errors (M, 3) and covariances (M, 3, 3) of the joints of matched people."""
        matches = match_people(self.people.frame, self.people.joints, self.scene.keypoints)
        error = self.people.joints[matches.row] - self.scene.keypoints[matches.frame, matches.person]
        return error.reshape(-1, 3), self.people.covariance[matches.row].reshape(-1, 3, 3)


def scene_table(trials: list[Trial]) -> list[str]:
    """Precision, recall and people on simulated scenes."""
    rows = []
    for trial in trials:
        m = trial.metrics
        median = 1e3 * np.median(np.linalg.norm(trial.error[0], axis=1))
        people = f"{m.people_found} of {m.people_true} | {m.people_duplicated} | {m.people_invented}"
        shares = " | ".join(f"{100 * share:.2f}" for share in (m.precision, m.recall, m.f1))
        name = f"{trial.seed} (the demo)" if trial.seed == DEMO else str(trial.seed)
        rows.append(f"| {name} | {shares} | {m.mpjpe_mm:.1f} | {median:.1f} | {people} |")
    head = "| seed | precision, % | recall, % | F1, % | MPJPE, mm | median, mm | people found | twice | invented |"
    return [head, rule(9), *rows]


def camera_table(trial: Trial) -> list[str]:
    """What more cameras bring to the scene of `trial`."""
    rows = []
    for count in CAMERAS:
        m = replace(trial, cameras=count).metrics
        people = f"{m.people_found} of {m.people_true} | {m.people_duplicated} | {m.people_invented}"
        rows.append(f"| {count} | {100 * m.precision:.1f} | {100 * m.recall:.1f} | {m.mpjpe_mm:.0f} | {people} |")
    head = "| cameras | precision, % | recall, % | MPJPE, mm | people found | twice | invented |"
    return [head, rule(7), *rows]


def alternation_table(trials: list[Trial]) -> list[str]:
    """Mean and median error of the same joints before and after stage II, by confidence before it."""
    rho = DOUBTFUL
    settings = {
        "views, body where they leave it open": replace(
            CONFIG, window_graph=replace(CONFIG.window_graph, rho_3d=0.0)
        ),
        "1 alternation": replace(CONFIG, refine=replace(CONFIG.refine, alternations=1)),
        f"**{CONFIG.refine.alternations} alternations**": CONFIG,
        "10 alternations": replace(CONFIG, refine=replace(CONFIG.refine, alternations=10)),
    }
    rows = []
    for label, some in (("demo", trials[:1]), (f"{len(trials) - 1} scenes", trials[1:])):
        after = {name: [_errors(trial, config) for trial in some] for name, config in settings.items()}
        first = after[f"**{CONFIG.refine.alternations} alternations**"]
        for group in first[0].groups(rho):
            masks = [errors.groups(rho)[group] for errors in first]
            before = np.concatenate([e.before_mm[mask] for e, mask in zip(first, masks, strict=True)])
            cells = [_mean_median(before)]
            for found in after.values():
                cells.append(
                    _mean_median(np.concatenate([e.after_mm[mask] for e, mask in zip(found, masks, strict=True)]))
                )
            rows.append(f"| {label}: {group} | {len(before)} | {' | '.join(cells)} |")
    head = f"| joints, mean (median) error in mm | count | before | {' | '.join(settings)} |"
    return [head, rule(3 + len(settings)), *rows]


def covariance_table(trials: list[Trial]) -> list[str]:
    """Whether the truth lies where the covariances say."""
    rows = []
    for label, some in (("demo", trials[:1]), (f"{len(trials) - 1} scenes", trials[1:])):
        error = np.concatenate([trial.error[0] for trial in some])
        found = covariance_calibration(error, np.concatenate([trial.error[1] for trial in some]))
        shares = " | ".join(f"{100 * share:.1f}" for share in found.coverage.values())
        rows.append(f"| {label} | {shares} | {found.median_nees:.2f} | {found.mean_nees:.2f} |")
    head = "| | inside the 50 % ellipsoid, % | 90 % | 95 % | median NEES | mean NEES |"
    return [head, rule(6), "| if true | 50 | 90 | 95 | 2.37 | 3 |", *rows]


def _errors(trial: Trial, config: PipelineConfig):
    people = trial.people if config == CONFIG else trial.run(config)
    return alternation_errors(trial.before, people, trial.scene.keypoints)


def _mean_median(errors: NDArray[np.float64]) -> str:
    known = errors[np.isfinite(errors)]
    return f"{known.mean():.1f} ({np.median(known):.1f})" if known.size else "-"
