"""Learn the body's priors from motion capture: python scripts/fit_priors.py cmu_smpl24.npz --output FOLDER.

Writes pose_prior.npz, from all subjects but those for testing, and motion_prior.npz, from those for training. A
folder of AMASS files gives a pose prior only. How well the shipped one guesses hidden limbs: measured at 9bafd50.
"""

import argparse
from pathlib import Path

import numpy as np

from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.training.motions import (
    ACKNOWLEDGEMENT,
    TEST_SUBJECTS,
    VALIDATION_SUBJECTS,
    clip_weights,
    load_motions,
    split_of,
)
from shapepose_fg.simulation.training.priors import learn_motion_prior, learn_pose_prior


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", type=Path, help="cmu_smpl24.npz, or a folder of AMASS files")
    parser.add_argument("--output", type=Path, default=Path("shapepose_fg/body/data"))
    arguments = parser.parse_args()
    motions, tested = load_motions(arguments.motions), " ".join(TEST_SUBJECTS)
    about = f"{ACKNOWLEDGEMENT} Fitted by scripts/fit_priors.py to {{}} frames: all subjects but {{}}, not used."
    learnt = motions.rows(np.array([split_of(str(name)) != "test" for name in motions.subject]))
    prior = learn_pose_prior(learnt, about.format(len(learnt), tested))
    prior.save(arguments.output / "pose_prior.npz")
    print(f"pose prior: {len(learnt)} frames and their mirror images")
    if arguments.motions.is_file():
        mocap = Mocap.load(arguments.motions)
        clips = [mocap.clip(index) for index in range(len(mocap))]
        train = [index for index, clip in enumerate(clips) if split_of(clip.subject) == "train"]
        frames = sum(len(clips[index]) for index in train)
        provenance = about.format(frames, f"{tested} {' '.join(VALIDATION_SUBJECTS)}")
        weights = clip_weights(clips)[train]
        learn_motion_prior((clips[index] for index in train), weights, provenance).save(
            arguments.output / "motion_prior.npz"
        )
        print(f"motion prior: {frames} frames")


if __name__ == "__main__":
    main()
