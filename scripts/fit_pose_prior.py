"""Learn the pose prior from motion capture: python scripts/fit_pose_prior.py cmu_smpl24.npz.

Reads recordings (CMU's, or a folder of AMASS files), fits a Gaussian mixture over the 69 joint angles to the
training subjects and prints how well it does on validation and test subjects; then fits it to training and
validation subjects and writes shapepose_fg/body/data/pose_prior.npz. With --compare it only prints how other
numbers of components do on validation subjects.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.training.mixture import MixtureConfig
from shapepose_fg.body.training.motions import Motions, load_motions
from shapepose_fg.body.training.prior import (
    PriorConfig,
    angles_of,
    expected_angles,
    learn_pose_prior,
    log_likelihood,
)
from shapepose_fg.body.training.split import TEST_SUBJECTS, VALIDATION_SUBJECTS
from shapepose_fg.core.skeleton import SMPL_24

Array = NDArray[np.float64]

COMPARED = (1, 4, 8, 16, 32)
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)
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
    parser.add_argument("--compare", action="store_true", help="print figures for several numbers of components")
    parser.add_argument("--output", type=Path, default=Path("shapepose_fg/body/data/pose_prior.npz"))
    arguments = parser.parse_args()
    motions = load_motions(arguments.motions)
    train, validation = motions.of("train"), motions.of("validation")
    print(f"learning from {len(train)} frames and their mirror images")
    if arguments.compare:
        for components in COMPARED:
            prior = learn_pose_prior(train, PriorConfig(MixtureConfig(components)), "")
            report(f"{components:2d} components, validation", prior, validation)
        return
    prior = learn_pose_prior(train, PriorConfig(), "")
    report("validation", prior, validation)
    report("test", prior, motions.of("test"))
    # What ships learns from the validation subjects too: they have chosen, and poses are few.
    both = motions.rows(~np.isin(motions.subject, motions.of("test").subject))
    prior = learn_pose_prior(both, PriorConfig(), provenance(both, PriorConfig()))
    report("test, validation subjects learnt from too", prior, motions.of("test"))
    prior.save(arguments.output)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1024:.0f} KiB, {len(both)} frames")


def provenance(learnt: Motions, config: PriorConfig) -> str:
    """What the file says about itself."""
    return (
        f"{ACKNOWLEDGEMENT} Fitted by scripts/fit_pose_prior.py, {config.mixture.components} component(s), to "
        f"{len(learnt)} frames and their mirror images: all subjects but {' '.join(TEST_SUBJECTS)} (test; 60 61: "
        f"salsa), which were not used. Subjects {' '.join(VALIDATION_SUBJECTS)} (validation) chose the settings "
        "and were learnt from in the end. Collars and hands were not recorded: their sigmas are assumed."
    )


def report(title: str, prior: PosePrior, motions: Motions) -> None:
    """Print log likelihood and errors at the ends of hidden limbs (weighted means)."""
    motions = motions.rows(np.arange(0, len(motions), 3))
    likelihood = float(np.average(log_likelihood(prior, motions), weights=motions.weight))
    poses = motions.poses[:, 1:].reshape(len(motions), -1).astype(np.float64)
    parts = []
    for name, (end, chain) in HIDDEN.items():
        asked = angles_of([SMPL_24.index(joint) - 1 for joint in chain])
        guess = poses.copy()
        guess[:, asked] = expected_angles(prior, poses, asked)
        error = np.linalg.norm(limb_end(guess, end) - limb_end(poses, end), axis=1)
        parts.append(f"{name} {100 * np.average(error, weights=motions.weight):.1f} cm")
    print(f"{title}: {likelihood:.2f} nats a frame; {', '.join(parts)}")


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
