"""Fit how joints of recorded people move: the entries of `estimation/data/motion.json`.

    python scripts/fit_motion.py --mocap cmu_smpl24.npz --output motion.json

Poses of CMU's training subjects on the mean body, 30 frames a second, up to 10 s of each clip.
Densities of accelerations are those of `estimation/motion_densities.py`; feet have the hidden
Markov model of `estimation/contact.py`, fitted by expectation maximisation to velocities over two
frames. A minute on one core.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.optimize import nnls
from typer import Option, Typer

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.hidden_markov import state_probabilities
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.contact import FootMotion, feet_of
from shapepose_fg.estimation.motion_densities import FORMAT
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.training.motions import pose_vectors, split_of

FPS = 30.0
"""Frame rate of the recordings, Hz; others are passed over."""
EDGES_M_S = (0.0, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Bounds between the ranges of speeds in which densities are averaged, m/s."""
AROUND_S = 0.1
"""Time before and after a step over which a speed is measured, s."""
GAP = 6
"""Half the duration of a gap that motion bridges, frames."""
LAG = 3
"""Frames between two velocities of a foot that have no position in common."""
START_M_S = (0.03, 0.15, 1.0)
"""Standard deviations of speeds in the three states before the first iteration, m/s."""
ROUNDS = 40
"""Number of iterations of expectation maximisation."""


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    mocap: Annotated[Path, Option(help="File of recorded motions.")],
    output: Annotated[Path, Option(help="JSON file to be written.")],
) -> None:
    """Fit both, and write the file."""
    clips = [each for each in recorded_joints(mocap) if len(each) > 2 * GAP + 3]
    content = {
        "format": FORMAT,
        "about": f"scripts/fit_motion.py: {len(clips)} clips of CMU motion capture, training "
        "subjects. joints: m2/s3 at rest, per (m/s)2 of speed, across gaps of 0.4 s; feet: "
        "estimation.contact.FootMotion",
        "joints": acceleration_densities(clips),
        "feet": foot_motion(clips),
    }
    output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def recorded_joints(path: Path) -> Iterator[Array]:
    """BODY_25's joints (T, 25, 3) of the training subjects on the mean body, metres."""
    mocap, body = Mocap.load(path), BodyModel.default()
    for index, subject in enumerate(mocap.subjects):
        clip = mocap.clip(index)
        if split_of(subject) == "train" and clip.fps == FPS:
            clip = clip.between(0, int(10 * FPS))
            vectors = pose_vectors(clip)
            shape = np.zeros((len(clip), body.num_betas))
            yield body.keypoints(BodyParameters(shape, vectors[:, 0], vectors[:, 1:], clip.pelvis))


def acceleration_densities(clips: list[Array]) -> dict[str, list[float]]:
    """Power spectral densities of each joint's acceleration, m²/s³ per axis: at rest, per (m/s)² of
    speed, and while the joint is lost. Left and right are taken together.

    Under white noise on the acceleration second differences have the variance 2/3 q dt³, and the
    middle of a gap of duration h between known states q h³ / 192.
    """
    turned, speed, bridged = (
        np.concatenate(each) for each in zip(*map(_steps, clips), strict=True)
    )
    found = {}
    for joint, name in enumerate(BODY_25.joints):
        both = [joint, BODY_25.mirror[joint]]
        numbers = *_by_speed(turned[:, both], speed[:, both]), bridged[:, both].mean()
        found[name] = [float(f"{number:.3g}") for number in numbers]
    return found


def _steps(joints: Array) -> tuple[Array, Array, Array]:
    """(N, J) densities of single steps, speeds over a quarter of a second, and densities
    that bridge gaps.
    """
    turned = 1.5 * np.square(np.diff(joints, 2, axis=0)).mean(axis=-1) * FPS**3
    times_s = np.arange(len(joints)) * (1 / FPS)
    first = np.searchsorted(times_s, times_s[1:-1] - AROUND_S)
    last = np.searchsorted(times_s, times_s[2:] + AROUND_S, side="right") - 1
    speed = np.linalg.norm(joints[last] - joints[first], axis=-1)
    speed /= (times_s[last] - times_s[first])[:, None]
    velocity, h = np.gradient(joints, 1 / FPS, axis=0), 2 * GAP / FPS
    start, end = slice(0, -2 * GAP), slice(2 * GAP, None)
    middle = (joints[start] + joints[end]) / 2 + h / 8 * (velocity[start] - velocity[end])
    bridged = 192 * np.square(joints[GAP:-GAP] - middle).mean(axis=-1) / h**3
    count = min(len(turned), len(bridged))
    return turned[:count], speed[:count], bridged[:count]


def _by_speed(density: Array, speed: Array) -> tuple[float, float]:
    """Density at rest, and its increase per (m/s)²: ranges of speeds have the same weight, by their
    relative errors.
    """
    which = np.digitize(speed, EDGES_M_S)
    parts = [which == n for n in range(1, len(EDGES_M_S)) if (which == n).sum() > 100]
    mean = np.array([density[part].mean() for part in parts])
    design = np.array([[1.0, np.square(speed[part]).mean()] for part in parts]) / mean[:, None]
    still, rising = nnls(design, np.ones(len(mean)))[0]
    return still, rising


def foot_motion(clips: list[Array]) -> dict[str, list]:
    """The fields of `FootMotion`, from clips of at least a second; each joint of a foot is a
    sequence of its own.
    """
    feet = feet_of(BODY_25.joints)
    long = (joints[:, feet] for joints in clips if len(joints) >= FPS)
    seen = [(joints[2:] - joints[:-2]) * FPS / 2 for joints in long]
    K, sigma = len(START_M_S), np.array(START_M_S)
    first, turns = np.full(K, 1 / K), 0.02 + (1 - 0.02 * K) * np.eye(K)
    correlation = np.zeros(K)
    for _ in range(ROUNDS):
        energy, count, both, pairs, together = (np.zeros(n) for n in (K, K, (K, K), K, K))
        for velocity in seen:
            squared = np.square(velocity).sum(axis=-1)[..., None]
            log = -3 * np.log(sigma) - 0.5 * squared / sigma**2
            share, step = _expected(log, first, turns)
            stays = share[:-LAG] * share[LAG:]
            product = (velocity[:-LAG] * velocity[LAG:]).sum(axis=-1)[..., None]
            energy += (share * squared).sum(axis=(0, 1)) / 3
            pairs += (stays * product).sum(axis=(0, 1)) / 3
            count, both, together = (
                count + share.sum(axis=(0, 1)), both + step, together + stays.sum(axis=(0, 1))
            )  # fmt: skip
        sigma, first = np.sqrt(energy / count), count / count.sum()
        turns = both / both.sum(axis=1, keepdims=True)
        correlation = np.clip(pairs / together / sigma**2, 1e-3, 0.999)
    leaves = 1 - np.diag(turns)
    found = FootMotion(
        speed_m_s=np.array([float(f"{each:.3g}") for each in sigma]),
        lasts_s=1 / (FPS * leaves),
        first=first,
        turns=np.where(np.eye(K), 0.0, turns) / leaves[:, None],
        correlation_s=-LAG / FPS / np.log(correlation),
    )
    digits = {"speed_m_s": 3}
    return {name: each.round(digits.get(name, 2)).tolist() for name, each in vars(found).items()}


def _expected(log: Array, first: Array, turns: Array) -> tuple[Array, Array]:
    """(T, C, K) probabilities of the states, and (K, K) numbers of transitions, of C sequences
    with log-densities `log` (T, C, K).
    """
    seen = np.exp(log - log.max(axis=-1, keepdims=True))
    share, forward, later = state_probabilities(
        seen, first, np.broadcast_to(turns, (len(seen) - 1, *turns.shape))
    )
    step = forward[:-1, :, :, None] * turns * (seen[1:] * later[1:])[:, :, None]
    step /= step.sum(axis=(2, 3), keepdims=True)
    return share, step.sum(axis=(0, 1))


if __name__ == "__main__":
    app()
