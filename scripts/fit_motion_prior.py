"""Learn the motion prior from motion capture: python scripts/fit_motion_prior.py cmu_smpl24.npz.

Reads CMU's recordings in SMPL's structure, takes the training subjects, and writes
shapepose_fg/body/data/motion_prior.npz. Recordings, subjects and walking are capped as for the pose prior.
"""

import argparse
from pathlib import Path

import numpy as np

from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.training.motion_prior import STEP_S, learn_motion_prior
from shapepose_fg.simulation.training.motions import ACKNOWLEDGEMENT, frame_weights
from shapepose_fg.simulation.training.split import TEST_SUBJECTS, VALIDATION_SUBJECTS, split_of


def main() -> None:
    """Fit, report, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motions", type=Path, help="cmu_smpl24.npz")
    parser.add_argument("--output", type=Path, default=Path("shapepose_fg/body/data/motion_prior.npz"))
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.motions)
    clips = [mocap.clip(index) for index in range(len(mocap))]
    subject = np.array([clip.subject for clip in clips])
    walking = np.array(["walk" in clip.action.lower() for clip in clips])
    weights = frame_weights(np.array([len(clip) for clip in clips]), subject, walking)
    train = [index for index, clip in enumerate(clips) if split_of(clip.subject) == "train"]
    frames = sum(len(clips[index]) for index in train)
    provenance = (
        f"{ACKNOWLEDGEMENT} Fitted by scripts/fit_motion_prior.py to {frames} frames of the training subjects "
        f" (not {' '.join(TEST_SUBJECTS + VALIDATION_SUBJECTS)}): accelerations from frame to frame, "
        f"velocities over {STEP_S:g} s. Collars follow the arms; hands were not recorded and move as wrists."
    )
    prior = learn_motion_prior((clips[index] for index in train), weights[train], provenance)
    prior.save(arguments.output)
    print(f"{arguments.output}: {frames} frames; root densities of acceleration and velocity, rad (place: m)")
    for row, name in enumerate((*SMPL_24, "place")):
        part = slice(3 * row, 3 * row + 3)
        print(f"{name:15s}", np.sqrt(prior.acceleration[part]).round(2), np.sqrt(prior.velocity[part]).round(2))


if __name__ == "__main__":
    main()
