"""A factor of your own: everybody carries a box, so the wrists are 40 cm apart."""

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from drawing import COLOURS, save

from factors import isotropic
from shapepose_fg import reconstruct
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import built_in_scene, simulate

RIGHT, LEFT = BODY_25.index("RWrist"), BODY_25.index("LWrist")


def carries_a_box(window, keys):
    """R = |right wrist - left wrist| - 0.4 m, in every frame."""
    for right, left in keys[:, [RIGHT, LEFT]].tolist():
        yield gtsam.RangeFactor3(right, left, 0.40, isotropic(1, 0.01))


scene = built_in_scene(people=2, frames=10)
times = FrameTimes.from_fps(25, len(scene))
detections = simulate(scene)
without = reconstruct(detections, scene.rig, times=times)
carriers = reconstruct(detections, scene.rig, times=times, extra_factors=carries_a_box)
print("made and inactive:", carriers.run["extra_factors"])

figure, axes = plt.subplots(figsize=(8, 4))
for people, style, what in ((without, ":", "without the factor"), (carriers, "-", "with it")):
    distance_m = np.linalg.norm(people.joints[:, RIGHT] - people.joints[:, LEFT], axis=1)
    print(f"{what}: median distance of the wrists {np.median(distance_m):.2f} m")
    for person in np.unique(people.person):
        rows = people.person == person
        axes.plot(people.time_s[rows], distance_m[rows], style, color=COLOURS[person])
axes.set(xlabel="time, s", ylabel="distance of the wrists, m", ylim=(0, None))
axes.set_title("dotted: without the factor; line: with it")
save(figure)
