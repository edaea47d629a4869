"""What the fitters promise, measured: a joint's prior without its own target, and bodies over time.

Poses and motions are of test subjects, whom nothing was learnt from or chosen on.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.fitting.learned import LearnedFitter
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.bodies import TWIST_JUMP, statures, twists
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.evaluation.fitting import SHAPE_LIMIT, true_bodies
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.simulation.mocap import Clip, Mocap
from shapepose_fg.simulation.training.motions import load_motions
from shapepose_fg.simulation.training.split import TEST_SUBJECTS

Array = NDArray[np.float64]
Fitter = LearnedFitter | LevenbergMarquardtFitter

FITTERS: dict[str, Callable[[], Fitter]] = {"learned": LearnedFitter, "plain": LevenbergMarquardtFitter}
"""Those that ship."""
BODIES, BODY_NOISE_M = 300, 0.03
"""Whose joints are left out, and the noise of their targets along each axis."""
JOINTS = {name: (f"L{name.capitalize()}", f"R{name.capitalize()}") for name in ("knee", "elbow", "ankle", "wrist")}
"""Which of BODY_25."""
SECONDS, FPS, NOISE_M = 10.0, 30.0, 0.015
"""Of each recording, at the most, its frames a second, and the noise of its targets along each axis."""


def left_out(scale: Scale) -> Experiment | None:
    """Where a joint's prior is, against a refit without the joint."""
    if scale.mocap is None or scale.quick:
        return None
    cases = [Case(name, partial(_left_out, scale.mocap, make)) for name, make in FITTERS.items()]
    return Experiment("fitter left out", cases, _left_out_table, "bodies")


def over_time(scale: Scale) -> Experiment | None:
    """Recordings whose joints are noisy, fitted one by one and over time."""
    if scale.mocap is None or scale.quick:
        return None
    cases = [Case(name, partial(_over_time, scale.mocap, make)) for name, make in FITTERS.items()]
    return Experiment("fitter over time", cases, _over_time_table, "bodies")


def _left_out(motions: Path, make: Callable[[], Fitter]) -> Figures:
    """Distances between the prior and a refit without this joint alone: median and 90 %, mm; and times."""
    fitter, rng = make(), np.random.default_rng(0)
    test = load_motions(motions).of("test")
    rows = np.linspace(0, len(test) - 1, BODIES).astype(np.intp)
    truth = true_bodies(test.poses[rows].astype(np.float64), BodyModel.default(), rng).keypoints
    targets = _targets(truth, BODY_NOISE_M, rng)
    with torch_threads(1):
        fit, ms = _timed(lambda: fitter.fit(targets), BODIES)
        _, grouped_ms = _timed(lambda: fitter.fit(targets, groups=np.arange(BODIES) // 10), BODIES)
        _, whole_ms = _timed(lambda: fitter.fit_whole(targets), BODIES)
        found: Figures = {
            "ms": ms,
            "grouped_ms": grouped_ms,
            "whole_ms": whole_ms,
            "apart_mm": {},
            "pushed_mm": {},
        }
        for name, sides in JOINTS.items():
            apart, pushed = [], []
            for joint in map(BODY_25.index, sides):
                information = targets.information.copy()
                information[:, joint] = 0
                refit = fitter.fit(JointTargets(targets.xyz, information))
                ok = refit.ok & fit.ok
                apart.append(np.linalg.norm(refit.joints[ok, joint] - fit.prior_xyz[ok, joint], axis=-1))
                moved = targets.xyz.copy()
                moved[:, joint] += (0.15, 0.0, 0.0)
                followed = fitter.fit(JointTargets(moved, targets.information))
                ok = followed.ok & fit.ok
                pushed.append(np.linalg.norm((followed.prior_xyz - fit.prior_xyz)[ok, joint], axis=-1))
            far = 1e3 * np.concatenate(apart)
            found["apart_mm"][name] = [float(np.median(far)), float(np.quantile(far, 0.9))]
            found["pushed_mm"][name] = float(1e3 * np.concatenate(pushed).max())
    return found


def _left_out_table(found: Mapping[str, Figures]) -> list[str]:
    who = f"{BODIES} bodies, {1e3 * BODY_NOISE_M:.0f} mm noise"
    head = f"{who}; prior against a refit without the joint, mm: median (90 %)"
    times = "ms a row | in groups of ten | without leaving out"
    rows = [f"| {head} | {' | '.join(JOINTS)} | pushed by 150 mm, the prior follows by at most, mm | {times} |"]
    rows.append(rule(5 + len(JOINTS)))
    for name, each in found.items():
        cells = [f"{median:.0f} ({most:.0f})" for median, most in each["apart_mm"].values()]
        cells += [f"{max(each['pushed_mm'].values()):.1f}"]
        cells += [f"{each[key]:.1f}" for key in ("ms", "grouped_ms", "whole_ms")]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return rows


def _over_time(motions: Path, make: Callable[[], Fitter]) -> Figures:
    """Errors, accelerations, twists and statures, one by one and over time."""
    fitter, model = make(), BodyModel.default()
    clips = list(longest_recordings(Mocap.load(motions)))
    bodies, truth = recorded_bodies(clips, model)
    targets = _targets(truth, NOISE_M, np.random.default_rng(1))
    lengths = np.array([len(clip) for clip in clips])
    groups, place = np.arange(len(clips)).repeat(lengths), np.concatenate([np.arange(each) for each in lengths])
    first = place < lengths[groups] // 2
    with torch_threads(1):
        alone = fitter.fit(targets)
        timed, ms = _timed(lambda: fitter.fit_sequence(targets, groups, place / FPS), len(truth))
        halves = [
            fitter.fit_sequence(JointTargets(targets.xyz[r], targets.information[r]), groups[r], place[r] / FPS)
            for r in (first, ~first)
        ]
    fit = timed.fit
    parts = (fit.betas, fit.global_orient, fit.body_pose, fit.transl)
    ours = BodyParameters(*(torch.from_numpy(np.asarray(each, dtype=np.float64)) for each in parts))
    follows = np.diff(groups) == 0
    turned, true = (twists(_bones(model, each)[:, None], model)[follows] for each in (ours, bodies))
    one, two = (statures(half.shapes.mean, model) for half in halves)
    return {
        "recordings": len(clips),
        "seconds": [float(lengths.min() / FPS), float(lengths.max() / FPS)],
        "alone_mm": _mean_mm(alone.joints - truth),
        "mm": _mean_mm(fit.joints - truth),
        "true_mps2": acceleration(truth, groups),
        "alone_mps2": acceleration(alone.joints, groups),
        "mps2": acceleration(fit.joints, groups),
        "twists": int(((np.abs(turned) > TWIST_JUMP) & (np.abs(turned - true) > TWIST_JUMP)).sum()),
        "halves_mm": float(1e3 * np.abs(one - two).max()),
        "ms": ms,
    }


def _over_time_table(found: Mapping[str, Figures]) -> list[str]:
    any_of = next(iter(found.values()))
    truth, (shortest, longest) = any_of["true_mps2"], any_of["seconds"]
    lines = {
        "joints, mm: one by one": lambda f: f"{f['alone_mm']:.1f}",
        "over time": lambda f: f"{f['mm']:.1f}",
        f"mean acceleration, m/s² (truth {truth:.1f}): one by one": lambda f: f"{f['alone_mps2']:.0f}",
        "accelerations over time": lambda f: f"{f['mps2']:.1f}",
        "limbs that turn 20 degrees more from frame to frame than in truth: over time": lambda f: str(f["twists"]),
        "stature from first and second half: largest difference, mm": lambda f: f"{f['halves_mm']:.0f}",
        "ms a row over time": lambda f: f"{f['ms']:.1f}",
    }
    who = f"{any_of['recordings']} test subjects, {shortest:.0f} to {longest:.0f} s of each"
    head = f"{who}, targets with {1e3 * NOISE_M:.0f} mm noise per axis"
    rows = [f"| {head} | {' | '.join(found)} |", rule(1 + len(found))]
    rows += [f"| {name} | {' | '.join(map(words, found.values()))} |" for name, words in lines.items()]
    return rows


def recorded_bodies(clips: list[Clip], model: BodyModel) -> tuple[BodyParameters, Array]:
    """Bodies of random shapes that move as recorded, clip after clip, z up; their joints (N, 25, 3), metres."""
    rng, model = np.random.default_rng(0), model.to(torch.float64)
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    parts = []
    for clip in clips:
        betas = np.tile(np.clip(rng.normal(size=(1, 10)), -SHAPE_LIMIT, SHAPE_LIMIT), (len(clip), 1))
        orient = (upright * Rotation.from_matrix(clip.rotations[:, 0])).as_rotvec()
        poses = Rotation.from_matrix(clip.rotations[:, 1:].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 23, 3)
        rest = replace(BodyParameters.zeros(1, torch.float64), betas=torch.from_numpy(betas[:1]))
        root = model.joints(rest)[0, 0].numpy()
        parts.append((betas, orient, poses, upright.apply(clip.pelvis) - root))
    bodies = BodyParameters(*(torch.from_numpy(np.concatenate(each)) for each in zip(*parts, strict=True)))
    with torch.no_grad():
        return bodies, model.keypoints(bodies).numpy()


def longest_recordings(mocap: Mocap) -> Iterator[Clip]:
    """The first ten seconds of the longest recording of each test subject, or all of it."""
    seconds = mocap.lengths / mocap.arrays["fps"]
    for subject in TEST_SUBJECTS:
        own = np.array([each == subject for each in mocap.subjects])
        clip = mocap.clip(int(np.where(own, seconds, -1.0).argmax())).resampled(FPS)
        if clip.subject != subject:
            raise ValueError(f"there is no recording of subject {subject}")
        yield clip.between(0, round(SECONDS * FPS))


def _targets(truth: Array, sigma_m: float, rng: np.random.Generator) -> JointTargets:
    information = np.broadcast_to(np.eye(3) / sigma_m**2, (*truth.shape, 3)).copy()
    return JointTargets(truth + rng.normal(0.0, sigma_m, truth.shape), information)


def _timed(work: Callable, rows: int) -> tuple:
    """What `work` gives, and the processor's milliseconds a row."""
    began = time.process_time()
    found = work()
    return found, 1e3 * (time.process_time() - began) / rows


def _bones(model: BodyModel, bodies: BodyParameters) -> Array:
    """(N, 24, 3, 3) world from bone."""
    with torch.no_grad():
        return model.to(torch.float64).bone_rotations(bodies).numpy()


def _mean_mm(errors: Array) -> float:
    return float(1e3 * np.linalg.norm(errors, axis=-1).mean())


def acceleration(joints: Array, groups: NDArray[np.intp]) -> float:
    """Mean length of the second differences of a group's joints (N, J, 3), m/s²."""
    second = np.linalg.norm(np.diff(joints, n=2, axis=0), axis=-1) * FPS**2
    return float(second[groups[2:] == groups[:-2]].mean())
