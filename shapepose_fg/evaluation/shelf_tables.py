"""The Shelf recording as Markdown tables: the score, lost limbs, contradictions, sigmas of detections."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.body_step import disagreement, joint_targets
from shapepose_fg.estimation.linearisation import linearise, observation_sigmas, triangulate
from shapepose_fg.evaluation.alternation import before_refinement
from shapepose_fg.evaluation.bodies import body_joints
from shapepose_fg.evaluation.footage import shelf_footage
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.shelf import LIMB_NAMES, ShelfScore, evaluate_shelf, read_shelf_ground_truth
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people

CONFIG = replace(PipelineConfig(), temporal=False)
"""Every frame by itself."""
OTHERS = (
    ("Zhang et al. 2020, with time", "99.47", "99.47", "96.45", "98.46"),
    ("triangulation script, no body, no solver", "", "", "", "96.14"),
    ("Zhang et al. 2020, without time", "96.34", "92.11", "96.13", "94.86"),
)
"""Other methods on the same frames and detections, by the same protocol."""


@cache
def shelf_steps(folder: Path) -> dict[str, ShelfScore]:
    """Scores on the Shelf recording: after stage I, of the bodies' joints, of the result without time and with."""
    truth = read_shelf_ground_truth(folder / "gt_dev.txt")
    recording = shelf_footage(folder)
    people = recording.reconstruct(CONFIG)
    before = before_refinement(recording.detections, recording.rig, CONFIG)
    bodies = replace(people, joints=body_joints(people))
    steps = {"stage I alone": before, "bodies' joints": bodies, "**shapepose-fg, without time**": people}
    steps["**shapepose-fg, with time**"] = recording.reconstruct(replace(CONFIG, temporal=True))
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
        rule(5),
        others[0],
        ours[3],
        ours[2],
        *others[1:],
        *(row.replace("| ", "| (ours) ", 1) for row in ours[:2]),
        "",
        f"Ours, with time: {final.pcp_pooled:.2f} % of all {final.limbs_all.sum()} limbs, "
        f"MPJPE {final.mpjpe_mm:.1f} mm, recall at 0.2 m {100 * final.recall:.2f} %, "
        f"{final.people_found} of {final.people} people found.",
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
    return ["| limbs that are right | actor 1 | actor 2 | actor 3 | lost |", rule(5), *rows]


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
    return [f"| views that agree | joints | median, sigma | 99 %, sigma | {limit} |", rule(5), *rows]


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
    return [head, rule(5), *rows]


@cache
def shelf_observations(folder: Path) -> tuple[Rig, Observations, NDArray[np.float64], NDArray[np.float64]]:
    """Everybody on Shelf after stage I: rig, observations, their sigmas (P, J, V) and X_0 (P, J, 3)."""
    recording = shelf_footage(folder)
    rig, detections = recording.rig, recording.detections
    found = [find_people(detections[t], rig, detections.skeleton, CONFIG) for t in range(len(detections))]
    observations = Observations.concatenate(found)
    views = Views.of(rig)
    points = triangulate(observations, views, CONFIG.observations)
    return (
        rig,
        observations,
        observation_sigmas(observations, points, views, CONFIG.observations, BODY_25.joints),
        points,
    )
