"""How many cameras are enough? Errors and reported standard deviations with two to six."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import save

from shapepose_fg import reconstruct
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.simulation import built_in_scene, simulate

COUNTS = (2, 3, 4, 6)
errors, sigmas = [], []
for cameras in COUNTS:
    scene = built_in_scene(people=2, cameras=cameras, frames=10)
    people = reconstruct(simulate(scene), scene.rig)
    score = joint_metrics(people, scene.keypoints)
    # Length of the expected error of each joint: the root of the variances' sum over the axes.
    sigma = np.sqrt(np.trace(people.covariance, axis1=2, axis2=3))
    errors.append(score.mpjpe_mm)
    sigmas.append(1000 * np.nanmean(sigma))
    print(
        f"{cameras} cameras: {score.recall:.0%} found, {errors[-1]:.0f} mm, sigma {sigmas[-1]:.0f}"
    )

figure, axes = plt.subplots(figsize=(8, 4))
axes.plot(COUNTS, errors, "o-", label="mean error, by the truth")
axes.plot(COUNTS, sigmas, "o:", label="what the result itself says")
axes.set(xlabel="cameras", ylabel="mm", xticks=COUNTS, ylim=(0, None))
axes.legend()
save(figure)
