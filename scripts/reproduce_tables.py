"""The figures of README.md and docs/evaluation.md, as Markdown: python scripts/reproduce_tables.py [--update].

Scenes come from fixed seeds. The Shelf tables need the recording (`--data FOLDER`, or SHAPEPOSE_DATA) and are
left out without it; so are those of body fitters (`fitter_comparison.py`) without the recorded motions.
`--only shelf` prints the tables whose names begin so. `--update` writes every table between its marks
`<!-- NAME -->` and `<!-- end -->` in the two files, and the figure into docs/images. Takes about two minutes, and
ten more for the fitters.
"""

import argparse
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path

import fitter_comparison
import numpy as np
import torch
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.camera import Rig, Views
from shapepose_fg.estimation.alternation import disagreement, joint_targets
from shapepose_fg.estimation.linearisation import linearise, observation_sigmas, triangulate
from shapepose_fg.evaluation.alternation import BeforeRefinement, alternation_errors, before_refinement
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import JointMetrics, covariance_calibration, joint_metrics
from shapepose_fg.evaluation.shelf import LIMB_NAMES, ShelfScore, evaluate_shelf, read_shelf_ground_truth
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.observations import Observations
from shapepose_fg.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.reconstruction import Reconstruction
from shapepose_fg.simulation import built_in_scene, simulate

ROOT = Path(__file__).parents[1]
DEMO = 0
"""The scene of `shapepose-fg demo`."""
SEEDS = (2000, 2001, 2002, 2003, 2004)
"""Scenes that were never looked at while the pipeline was made: change them once they have been."""
CAMERAS = (2, 3, 4, 6, 8, 10)
CONFIG = PipelineConfig()

OTHERS = (
    ("Zhang et al. 2020, with time", "99.47", "99.47", "96.45", "98.46"),
    ("triangulation script, no body, no solver", "", "", "", "96.14"),
    ("Zhang et al. 2020, without time", "96.34", "92.11", "96.13", "94.86"),
)
"""Other methods on the same frames and detections, by the same protocol."""


@dataclass(frozen=True)
class Trial:
    """A scene, simulated and reconstructed."""

    seed: int
    """Of the scene and of the detector."""
    cameras: int = 6
    """Views."""

    @cached_property
    def scene(self):
        """The people and cameras."""
        return built_in_scene(self.seed, cameras=self.cameras)

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


def main() -> None:
    """Print every table; with --update write them into the documents too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--only", nargs="*", help="names of tables, or their first words")
    parser.add_argument("--update", action="store_true", help="write the tables into the documents")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    demo, trials = Trial(DEMO), [Trial(seed) for seed in SEEDS]
    shelf = arguments.data / "data" / "shelf"
    tables: dict[str, Callable[[], list[str]]] = {
        "scenes": lambda: scene_table([demo, *trials]),
        "alternation": lambda: alternation_table([demo, *trials]),
        "covariances": lambda: covariance_table([demo, *trials]),
        "cameras": lambda: camera_table(),
    }
    if shelf.is_dir():
        steps = shelf_steps(shelf)
        tables |= {"shelf": lambda: shelf_table(steps), "shelf limbs": lambda: limb_table(steps)}
        tables |= {"contradictions": lambda: contradiction_table(shelf), "sigma": lambda: sigma_table(shelf)}
    else:
        print(f"(no Shelf recording in {shelf}: its tables are left out)\n")
    images = ROOT / "docs" / "images" if arguments.update else None
    tables |= fitter_comparison.tables(arguments.data, images)
    for name, table in tables.items():
        if arguments.only is None or any(f"{name} ".startswith(f"{only} ") for only in arguments.only):
            text = "\n".join(table())
            print(f"{name}\n\n{text}\n", flush=True)
            if arguments.update:
                update(name, text)


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
    return [head, _rule(9), *rows]


def camera_table() -> list[str]:
    """What more cameras bring, on the first of the seeds."""
    rows = []
    for count in CAMERAS:
        m = Trial(SEEDS[0], count).metrics
        people = f"{m.people_found} of {m.people_true} | {m.people_duplicated} | {m.people_invented}"
        rows.append(f"| {count} | {100 * m.precision:.1f} | {100 * m.recall:.1f} | {m.mpjpe_mm:.0f} | {people} |")
    head = "| cameras | precision, % | recall, % | MPJPE, mm | people found | twice | invented |"
    return [head, _rule(7), *rows]


def alternation_table(trials: list[Trial]) -> list[str]:
    """Mean and median error of the same joints before and after stage II, by confidence before it."""
    rho = CONFIG.window_graph.rho_3d
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
    return [head, _rule(3 + len(settings)), *rows]


def covariance_table(trials: list[Trial]) -> list[str]:
    """Whether the truth lies where the covariances say."""
    rows = []
    for label, some in (("demo", trials[:1]), (f"{len(trials) - 1} scenes", trials[1:])):
        error = np.concatenate([trial.error[0] for trial in some])
        found = covariance_calibration(error, np.concatenate([trial.error[1] for trial in some]))
        shares = " | ".join(f"{100 * share:.1f}" for share in found.coverage.values())
        rows.append(f"| {label} | {shares} | {found.median_nees:.2f} | {found.mean_nees:.2f} |")
    head = "| | inside the 50 % ellipsoid, % | 90 % | 95 % | median NEES | mean NEES |"
    return [head, _rule(6), "| if true | 50 | 90 | 95 | 2.37 | 3 |", *rows]


def shelf_steps(folder: Path) -> dict[str, ShelfScore]:
    """Scores on the Shelf recording after stage I, of the bodies' joints, and of the result."""
    truth = read_shelf_ground_truth(folder / "gt_dev.txt")
    rig = read_rig(folder / "calibration.json")
    detections = read_detections(folder, rig)
    people = reconstruct(detections, rig, CONFIG)
    before = replace(people, joints=before_refinement(detections, rig, CONFIG).joints)
    bodies = replace(people, joints=body_joints(people))
    steps = {"stage I alone": before, "bodies' joints": bodies, "**shapepose-fg, without time**": people}
    return {name: evaluate_shelf(each, truth) for name, each in steps.items()}


def shelf_table(steps: dict[str, ShelfScore]) -> list[str]:
    """Ours beside others."""
    ours = [
        f"| {name} | {' | '.join(f'{value:.2f}' for value in score.pcp)} | {score.pcp_average:.2f} |"
        for name, score in steps.items()
    ]
    final = list(steps.values())[-1]
    others = [f"| {' | '.join(row)} |" for row in OTHERS]
    return [
        "| PCP@0.5, % | actor 1 | actor 2 | actor 3 | Avg |",
        _rule(5),
        others[0],
        ours[2],
        *others[1:],
        *(row.replace("| ", "| (ours) ", 1) for row in ours[:2]),
        "",
        f"Ours: {final.pcp_pooled:.2f} % of all {final.limbs_all.sum()} limbs, MPJPE {final.mpjpe_mm:.1f} mm, "
        f"recall at 0.2 m {100 * final.recall:.2f} %, {final.people_found} of {final.people} people found.",
    ]


def limb_table(steps: dict[str, ShelfScore]) -> list[str]:
    """Limbs that are not always right."""
    final = list(steps.values())[-1]
    rows = []
    for i, limb in enumerate(LIMB_NAMES):
        right, count = final.limbs_right[:, i], final.limbs_all[:, i]
        if right.sum() < count.sum():
            cells = " | ".join(f"{a} of {b}" for a, b in zip(right, count, strict=True))
            rows.append(f"| {limb} | {cells} | {count.sum() - right.sum()} |")
    return ["| limbs that are right | actor 1 | actor 2 | actor 3 | lost |", _rule(5), *rows]


def contradiction_table(folder: Path) -> list[str]:
    """How often the views put a joint where the rest of the body cannot have it, by how many views agree."""
    rig, observations, sigmas, points = shelf_observations(folder)
    evidence = linearise(observations, sigmas, points, Views.of(rig), CONFIG.observations)
    fit = make_fitter(CONFIG.body).fit(joint_targets(evidence, np.ones(len(points), dtype=bool)), None)
    apart, views = disagreement(evidence, fit), evidence.inlier.sum(axis=-1)
    rows = []
    for count in range(2, len(rig) + 1):
        here = apart[views == count]
        over = 100 * (here > CONFIG.refine.disagreement).mean()
        typical = f"{np.median(here):.2f} | {np.percentile(here, 99):.1f}"
        rows.append(f"| {count} | {len(here)} | {typical} | {over:.2f} |")
    limit = f"over {CONFIG.refine.disagreement:g}, %"
    return [f"| views that agree | joints | median, sigma | 99 %, sigma | {limit} |", _rule(5), *rows]


def sigma_table(folder: Path) -> list[str]:
    """Error of a detection by confidence: each view against where at least three others see the joint."""
    rig, observations, sigmas, points = shelf_observations(folder)
    config = replace(CONFIG.observations, rho_2d_m=0.3, kernel="geman_mcclure")
    error, known, confidence, modelled = [], [], [], []
    for view in range(len(rig)):
        others = sigmas.copy()
        others[:, :, view] = 0.0
        unseen = replace(observations, confidence=np.where(others > 0, observations.confidence, 0.0))
        place = points
        for _ in range(6):
            place = linearise(unseen, others, place, Views.of(rig), config).target
        evidence = linearise(unseen, others, place, Views.of(rig), config)
        usable = (evidence.inlier.sum(axis=-1) >= 3) & observations.seen[:, :, view]
        xy, depth = rig.project(place)
        metres = (depth[view] / rig.focal_px[view])[usable]
        offset = (xy[view] - observations.xy[:, :, view])[usable] * metres[:, None]
        R = rig.cTw[view, :, :3]
        spread = (R @ np.linalg.inv(evidence.information[usable]) @ R.T)[:, :2, :2]
        error.append(np.linalg.norm(offset, axis=1))
        known.append(np.trace(spread, axis1=1, axis2=2) / 2)
        confidence.append(observations.confidence[:, :, view][usable])
        modelled.append(sigmas[:, :, view][usable] * metres)
    error, known, confidence, modelled = map(np.concatenate, (error, known, confidence, modelled))
    rows = []
    for low, high in pairwise((0.05, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 1.01)):
        here = (confidence >= low) & (confidence < high)
        # The median length of a two-dimensional Gaussian is 1.177 sigma; the others' own spread is taken out.
        sigma = np.sqrt(max((np.median(error[here]) / 1.1774) ** 2 - np.median(known[here]), 0.0))
        tail = np.percentile(error[here], 90) / np.median(error[here])
        rows.append(
            f"| {low:g} to {min(high, 1.0):g} | {here.sum()} | {1e3 * sigma:.0f} | "
            f"{1e3 * np.median(modelled[here]):.0f} | {tail:.2f} |"
        )
    head = "| confidence | detections | sigma, mm | sigma that we give it, mm | 90 % / 50 % (Gaussian: 1.82) |"
    return [head, _rule(5), *rows]


@cache
def shelf_observations(folder: Path) -> tuple[Rig, Observations, NDArray[np.float64], NDArray[np.float64]]:
    """Everybody on Shelf after stage I: rig, observations, their sigmas (P, J, V) and X_0 (P, J, 3)."""
    rig = read_rig(folder / "calibration.json")
    detections = read_detections(folder, rig)
    found = [find_people(detections[t], rig, detections.skeleton, CONFIG) for t in range(len(detections))]
    observations = Observations.concatenate(found)
    points = triangulate(observations, Views.of(rig), CONFIG.observations)
    return rig, observations, observation_sigmas(observations, points, Views.of(rig), CONFIG.observations), points


def body_joints(people: Reconstruction) -> NDArray[np.float64]:
    """(N, 25, 3) the joints of the fitted bodies; NaN where there is no body."""
    body, offsets = BodyModel.default(), people.run["keypoint_offsets"]
    if offsets is not None:
        body = body.with_keypoint_offsets(KeypointOffsets.from_dict(offsets))
    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    with torch.no_grad():
        return (
            body.keypoints(BodyParameters(*(torch.from_numpy(c).to(body.dtype) for c in columns))).double().numpy()
        )


def update(name: str, text: str) -> None:
    """Put a table between its marks in the documents."""
    for path in (ROOT / "README.md", ROOT / "docs" / "evaluation.md"):
        old = path.read_text(encoding="utf-8")
        marked = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        path.write_text(marked.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", old), encoding="utf-8")


def _errors(trial: Trial, config: PipelineConfig):
    people = trial.people if config == CONFIG else trial.run(config)
    return alternation_errors(trial.before, people, trial.scene.keypoints)


def _mean_median(errors: NDArray[np.float64]) -> str:
    known = errors[np.isfinite(errors)]
    return f"{known.mean():.1f} ({np.median(known):.1f})" if known.size else "-"


def _rule(columns: int) -> str:
    return "|---" * columns + "|"


if __name__ == "__main__":
    main()
