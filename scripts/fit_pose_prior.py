"""Learn the pose prior from motion capture: python scripts/fit_pose_prior.py cmu_smpl24.npz.

Reads recordings of the CMU Graphics Lab Motion Capture Database in SMPL's pose structure, fits a full
Gaussian over the 69 joint angles, writes shapepose_fg/body/data/pose_prior.npz and prints how well it does
on subjects that it never saw.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.pose_prior import PosePrior
from shapepose_fg.skeleton import SMPL_24

Array = NDArray[np.float64]

EXCLUDED_SUBJECTS = ("60", "61")
"""Salsa: test only, for everything that is learnt from motion."""
HELD_OUT_SUBJECTS = ("02", "08", "16", "43", "94", "139")
"""Sports and chores, walks, runs and jumps, a bar, Indian dance, getting up: never in the prior."""
SEGMENT_CAP = 300
"""Frames' worth of weight that one recording may have (10 s)."""
SUBJECT_CAP = 1500
"""Frames' worth of weight that one subject may have: 13,000 frames of one climber are one person's habit."""
WALK_CAP = 0.25
"""Share of the weight that all walking together may have. Against 0.15, held-out walks gain 1.6 nats a frame and
everything else loses 0.1; without a cap they gain 0.6 more and the rest loses 0.1 more."""
SLACK_RAD = 0.08
"""Sigma added (in squares) to every angle: the play between a recording's skeleton and another body.

The sources agree with their own limb directions within 1 to 5 degrees (0.09 rad) and turn hinges about one
axis exactly. Held-out recordings share those hinges, so their likelihood alone would ask for no play."""
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)

# Not recorded, so from anatomy. The shoulder girdle follows the arm at about one degree in three
# (scapulohumeral rhythm): the clavicle rises up to 0.5 rad and moves to the front or back by 0.35, rarely.
# About its own axis it hardly turns. Fingers as one block: the hand is bent or spread by 0.2 rad.
ASSUMED_SIGMA_RAD = {"collar": (0.06, 0.12, 0.15), "hand": (0.2, 0.2, 0.2)}
# Degrees of play past straight; SMPL's knee flexes about +x, the left elbow about -y, the right about +y.
STRAIGHT_RAD = 0.12
FLEXION = {"left_knee": (0, 1), "right_knee": (0, 1), "left_elbow": (1, -1), "right_elbow": (1, 1)}


def main() -> None:
    """Fit, evaluate, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motions", type=Path, help="cmu_smpl24.npz")
    parser.add_argument("--output", type=Path, default=Path("shapepose_fg/body/data/pose_prior.npz"))
    arguments = parser.parse_args()
    data = dict(np.load(arguments.motions, allow_pickle=False))
    poses = data["poses"][:, 1:].reshape(-1, 69).astype(np.float64)
    held_out = np.repeat(np.isin(data["subject"], HELD_OUT_SUBJECTS), data["seq_len"])
    weight, seen = frame_weights(data), observed_angles(data)
    train = (weight > 0) & ~held_out
    for slack in (0.02, 0.05, SLACK_RAD, 0.12):
        prior = fit(poses[train], seen[train], weight[train], slack)
        value = held_out_log_likelihood(prior, poses, seen, weight * held_out)
        print(f"slack {slack:.2f} rad: held-out log likelihood {value:.2f} nats a frame")
    prior = fit(poses[train], seen[train], weight[train], SLACK_RAD)
    report_hidden_joints(prior, data["check_offsets"], poses, weight * held_out * seen.all(axis=1))
    prior.save(arguments.output)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1024:.0f} KiB, {int(train.sum())} frames")


def frame_weights(data: dict[str, NDArray]) -> Array:
    """Weight of every frame (N,): recordings, subjects and walking are capped, the excluded get 0."""
    length = data["seq_len"].astype(np.float64)
    total = np.minimum(length, SEGMENT_CAP) * ~np.isin(data["subject"], EXCLUDED_SUBJECTS)
    for subject in np.unique(data["subject"]):
        rows = data["subject"] == subject
        total[rows] *= min(1.0, SUBJECT_CAP / max(total[rows].sum(), 1.0))
    walking = np.char.find(np.char.lower(data["action"]), "walk") >= 0
    rest = total[~walking].sum()
    total[walking] *= min(1.0, rest * WALK_CAP / (1 - WALK_CAP) / total[walking].sum())
    return np.repeat(total / length, data["seq_len"])


def observed_angles(data: dict[str, NDArray]) -> NDArray[np.bool_]:
    """Which of the 69 angles of every frame were recorded (N, 69); collars and hands never were."""
    seen = np.ones((len(data["seq_len"]), 23), dtype=bool)
    for part, valid in (("wrist", data["wrist_valid"]), ("foot", data["toe_valid"])):
        seen[np.ix_(~valid, np.array(_joints(part)))] = False
    return np.repeat(np.repeat(seen, 3, axis=1), data["seq_len"], axis=0)


def fit(poses: Array, seen: NDArray[np.bool_], weight: Array, slack_rad: float) -> PosePrior:
    """The Gaussian of the poses and their mirror images, with what was not recorded filled in."""
    recorded = np.setdiff1d(np.arange(69), _angles(_joints("collar") + _joints("hand")))
    permutation, sign = mirror()
    both = np.concatenate([poses, poses[:, permutation] * sign])[:, recorded]
    both_seen = np.concatenate([seen, seen[:, permutation]])[:, recorded]
    mean, covariance = np.zeros(69), np.zeros((69, 69))
    mean[recorded], covariance[np.ix_(recorded, recorded)] = gaussian_with_gaps(
        both, both_seen, np.concatenate([weight, weight])
    )
    covariance += np.eye(69) * slack_rad**2
    for part, sigma in ASSUMED_SIGMA_RAD.items():
        for joint in _joints(part):
            angles = _angles([joint])
            covariance[angles, angles] = np.square(sigma)
    lower, upper = np.full(69, -np.inf), np.full(69, np.inf)
    for name, (axis, direction) in FLEXION.items():
        angle = _angles([SMPL_24.index(name) - 1])[axis]
        (lower if direction > 0 else upper)[angle] = -direction * STRAIGHT_RAD
    text = (
        f"{ACKNOWLEDGEMENT} Fitted by scripts/fit_pose_prior.py to {len(poses)} frames and their mirror "
        f"images. Subjects {' '.join(EXCLUDED_SUBJECTS)} (salsa) and {' '.join(HELD_OUT_SUBJECTS)} "
        "(held out) were not used. Collars and hands were not recorded: their sigmas are assumed."
    )
    return PosePrior(mean, covariance, lower, upper, text)


def gaussian_with_gaps(
    values: Array, seen: NDArray[np.bool_], weight: Array, iterations: int = 30
) -> tuple[Array, Array]:
    """Weighted mean (K,) and covariance (K, K) of rows (N, K) with gaps, by expectation maximisation."""
    weight = weight / weight.sum()
    count = np.maximum(weight @ seen, 1e-12)
    mean = (weight @ (values * seen)) / count
    covariance = np.diag((weight @ (np.square(values - mean) * seen)) / count + 1e-4)
    patterns, pattern = np.unique(seen, axis=0, return_inverse=True)
    for _ in range(iterations):
        first, second = np.zeros_like(mean), np.zeros_like(covariance)
        for index, known in enumerate(patterns):
            rows = pattern == index
            filled, gap = np.array(values[rows]), ~known
            if gap.any():
                S = covariance
                gain = np.linalg.solve(S[np.ix_(known, known)], S[np.ix_(known, gap)]).T
                filled[:, gap] = mean[gap] + (filled[:, known] - mean[known]) @ gain.T
                left = S[np.ix_(gap, gap)] - gain @ S[np.ix_(known, gap)]
                second[np.ix_(gap, gap)] += weight[rows].sum() * left
            first += weight[rows] @ filled
            second += (filled * weight[rows, None]).T @ filled
        mean = first
        covariance = second - np.outer(mean, mean) + 1e-8 * np.eye(len(mean))
    return mean, (covariance + covariance.T) / 2


def mirror() -> tuple[NDArray[np.intp], Array]:
    """Permutation (69,) and signs (69,) of the pose seen in a mirror that swaps left and right.

    A rotation vector mirrored in the plane x = 0 keeps x and changes the sign of y and z.
    """
    names = SMPL_24[1:]
    swap = {"left": "right", "right": "left"}
    other = []
    for name in names:
        side, _, part = name.partition("_")
        other.append(names.index(f"{swap[side]}_{part}" if side in swap else name))
    return _angles(other), np.tile([1.0, -1.0, -1.0], 23)


def held_out_log_likelihood(prior: PosePrior, poses: Array, seen: NDArray[np.bool_], weight: Array) -> float:
    """Weighted mean log likelihood of the fully recorded held-out frames, nats, recorded angles only."""
    recorded = np.setdiff1d(np.arange(69), _angles(_joints("collar") + _joints("hand")))
    rows = (weight > 0) & seen.all(axis=1)
    error = poses[rows][:, recorded] - prior.mean[recorded]
    S = prior.covariance[np.ix_(recorded, recorded)]
    squared = np.einsum("ni,in->n", error, np.linalg.solve(S, error.T))
    value = -0.5 * (squared + np.linalg.slogdet(2 * np.pi * S)[1])
    return float(np.average(value, weights=weight[rows]))


def report_hidden_joints(prior: PosePrior, offsets: Array, poses: Array, weight: Array) -> None:
    """Hide the rotations of a limb, guess them from all other joints, print how far its end lands."""
    rows = np.flatnonzero(weight > 0)[::5]
    everything = np.arange(69)
    print("hidden limb: mean error of its end in cm by (the mean pose, this prior)")
    for end, chain in (
        ("left_wrist", ("left_shoulder", "left_elbow")),
        ("left_wrist", ("left_elbow",)),
        ("left_ankle", ("left_hip", "left_knee")),
        ("left_ankle", ("left_knee",)),
    ):
        asked = _angles([SMPL_24.index(name) - 1 for name in chain])
        given = np.setdiff1d(everything, asked)
        mean_pose, guess = poses[rows].copy(), poses[rows].copy()
        mean_pose[:, asked] = prior.mean[asked]
        gain = prior.regression(given, asked)
        guess[:, asked] = prior.mean[asked] + (poses[rows][:, given] - prior.mean[given]) @ gain.T
        truth = limb_end(offsets, poses[rows], end)
        error = [
            100 * np.average(np.linalg.norm(limb_end(offsets, p, end) - truth, axis=1), weights=weight[rows])
            for p in (mean_pose, guess)
        ]
        print(f"  {end}, hidden {' '.join(chain)}: {error[0]:.1f} {error[1]:.1f}")


def limb_end(offsets: Array, poses: Array, end: str) -> Array:
    """Where the joint called `end` is (N, 3), metres, with the pelvis at the origin."""
    from scipy.spatial.transform import Rotation

    parents = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
    joint, xyz = SMPL_24.index(end), np.zeros((len(poses), 3))
    while parents[joint] >= 0:
        xyz = xyz + offsets[joint]
        joint = parents[joint]
        if joint > 0:
            xyz = Rotation.from_rotvec(poses[:, 3 * (joint - 1) : 3 * joint]).apply(xyz)
    return xyz


def _joints(part: str) -> list[int]:
    """Rows of `body_pose` whose joint name ends with `part`."""
    return [index for index, name in enumerate(SMPL_24[1:]) if name.endswith(part)]


def _angles(joints: list[int]) -> NDArray[np.intp]:
    """Places of the joints' three angles each in the 69."""
    return (np.array(joints)[:, None] * 3 + np.arange(3)).ravel()


if __name__ == "__main__":
    main()
