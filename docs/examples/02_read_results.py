"""Read a result with nothing but NumPy: the height of a knee over time, and how certain it is."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import COLOURS, save

from shapepose_fg import reconstruct
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.simulation import built_in_scene, simulate

scene = built_in_scene(people=2, frames=30)
times = FrameTimes.from_fps(25, len(scene))
reconstruct(simulate(scene), scene.rig, times=times).save("results")

# From here on, this package is not needed. One row per person and frame.
with np.load("results/people.npz") as file:
    result = dict(file)
joint = result["joint_names"].tolist().index("LKnee")
height = result["joints"][:, joint, 2]
sigma = np.sqrt(result["covariance"][:, joint, 2, 2])
names = result["known_names"][result["known"][:, joint]]
for name, count in zip(*np.unique(names, return_counts=True), strict=True):
    print(f"the knee is {name} in {count} rows")

figure, axes = plt.subplots(figsize=(8, 4))
for person in np.unique(result["person"]):
    rows = (result["person"] == person) & (result["status"] == "ok")
    time, colour = result["time_s"][rows], COLOURS[person % len(COLOURS)]
    axes.plot(time, height[rows], color=colour, label=f"person {person}")
    low, high = height[rows] - 1.96 * sigma[rows], height[rows] + 1.96 * sigma[rows]
    axes.fill_between(time, low, high, color=colour, alpha=0.25, linewidth=0)
axes.set(xlabel="time, s", ylabel="height of the left knee, m", title="with 95 % intervals")
axes.legend()
save(figure)
