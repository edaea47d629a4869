"""Learn the pose prior from motion capture: python scripts/fit_pose_prior.py cmu_smpl24.npz.

Reads recordings (CMU's, or a folder of AMASS files), fits a Gaussian over the 69 joint angles to the training
subjects and prints how well it does on validation and test subjects; then fits it to training and validation
subjects and writes shapepose_fg/body/data/pose_prior.npz.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.training.motions import ACKNOWLEDGEMENT, Motions, load_motions
from shapepose_fg.simulation.training.pose_prior import (
    Gaussian,
    angles_of,
    expected_angles,
    learn_pose_prior,
    recorded_angles,
)
from shapepose_fg.simulation.training.split import TEST_SUBJECTS, VALIDATION_SUBJECTS

Array = NDArray[np.float64]

HIDDEN = {
    "wrist, arm hidden": ("left_wrist", ("left_collar", "left_shoulder", "left_elbow", "left_wrist")),
    "wrist, forearm hidden": ("left_wrist", ("left_elbow", "left_wrist")),
    "ankle, leg hidden": ("left_ankle", ("left_hip", "left_knee", "left_ankle", "left_foot")),
    "ankle, shin hidden": ("left_ankle", ("left_knee", "left_ankle", "left_foot")),
}


def main() -> None:
    """Fit, report, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motions", type=Path, help="cmu_smpl24.npz, or a folder of AMASS files")
    parser.add_argument("--output", type=Path, default=Path("shapepose_fg/body/data/pose_prior.npz"))
    arguments = parser.parse_args()
    motions = load_motions(arguments.motions)
    train, test = motions.of("train"), motions.of("test")
    print(f"learning from {len(train)} frames and their mirror images")
    prior = learn_pose_prior(train, "")
    report("validation", prior, motions.of("validation"))
    report("test", prior, test)
    # What ships learns from the validation subjects too: they have chosen, and poses are few.
    both = motions.rows(~np.isin(motions.subject, test.subject))
    prior = learn_pose_prior(both, provenance(both))
    report("test, validation subjects learnt from too", prior, test)
    prior.save(arguments.output)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1024:.0f} KiB, {len(both)} frames")


def provenance(learnt: Motions) -> str:
    """What the file says about itself."""
    return (
        f"{ACKNOWLEDGEMENT} Fitted by scripts/fit_pose_prior.py, 1 component(s), to "
        f"{len(learnt)} frames and their mirror images: all subjects but {' '.join(TEST_SUBJECTS)} (test; 60 61: "
        f"salsa), which were not used. Subjects {' '.join(VALIDATION_SUBJECTS)} (validation) chose the settings "
        "and were learnt from in the end. Collars and hands were not recorded: their sigmas are assumed."
    )


def report(title: str, prior: PosePrior, motions: Motions) -> None:
    """Print log likelihood and errors at the ends of hidden limbs (weighted means)."""
    motions = motions.rows(np.arange(0, len(motions), 3))
    density = Gaussian(prior.mean, prior.covariance).log_density(*recorded_angles(motions))
    poses = motions.poses[:, 1:].reshape(len(motions), -1).astype(np.float64)
    parts = []
    for name, (end, chain) in HIDDEN.items():
        asked = angles_of([SMPL_24.index(joint) - 1 for joint in chain])
        guess = poses.copy()
        guess[:, asked] = expected_angles(prior, poses, asked)
        error = np.linalg.norm(limb_end(guess, end) - limb_end(poses, end), axis=1)
        parts.append(f"{name} {100 * np.average(error, weights=motions.weight):.1f} cm")
    print(f"{title}: {np.average(density, weights=motions.weight):.2f} nats a frame; {', '.join(parts)}")


def limb_end(poses: Array, end: str) -> Array:
    """Where the joint called `end` of the mean body is (N, 3), metres, with the pelvis at the origin."""
    model = BodyModel.default()
    rest = model.arrays.joint_regressor @ model.arrays.template
    joint, xyz = SMPL_24.index(end), np.zeros((len(poses), 3))
    while (parent := model.parents[joint]) >= 0:
        xyz = xyz + rest[joint] - rest[parent]
        joint = parent
        if joint > 0:
            xyz = Rotation.from_rotvec(poses[:, 3 * (joint - 1) : 3 * joint]).apply(xyz)
    return xyz


if __name__ == "__main__":
    main()
