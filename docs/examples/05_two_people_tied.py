"""Two people tied by a factor: they hold hands, so two of their wrists are 14 cm apart."""

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from drawing import save

from factors import isotropic
from shapepose_fg import reconstruct
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import built_in_scene, simulate

WRISTS = [BODY_25.index("RWrist"), BODY_25.index("LWrist")]


def hold_hands(window, keys):
    """R = |a wrist of one - the other wrist of the other| - 0.14 m, where they are near."""
    for other in window.partners:
        rows, other_rows = window.shared(other)
        for wrist, others in (WRISTS, WRISTS[::-1]):
            between = window.first[rows, wrist] - other.first[other_rows, others]
            if np.nanmedian(np.linalg.norm(between, axis=1)) < 0.30:
                for pair in zip(keys[rows, wrist], other.keys[other_rows, others], strict=True):
                    yield gtsam.RangeFactor3(*map(int, pair), 0.14, isotropic(1, 0.01))


scene = built_in_scene(people=2, cameras=3, frames=25)
detections = simulate(scene)
alone = reconstruct(detections, scene.rig)
together = reconstruct(detections, scene.rig, extra_factors=hold_hands)
print("made and inactive:", together.run["extra_factors"])

figure, axes = plt.subplots(figsize=(8, 4))
for people, label in ((alone, "each person alone"), (together, "tied by a factor")):
    one, two = (people.joints[people.person == person] for person in (0, 1))
    pairs = (np.linalg.norm(one[:, a] - two[:, b], axis=1) for a, b in (WRISTS, WRISTS[::-1]))
    distance_m = min(pairs, key=np.median)
    print(f"{label}: {np.median(distance_m):.3f} m, varies by {1000 * np.std(distance_m):.0f} mm")
    axes.plot(distance_m, label=label)
axes.axhline(0.143, color="grey", linestyle=":", label="truth")
axes.set(xlabel="frame", ylabel="distance of the hands' wrists, m", ylim=(0, None))
axes.legend()
save(figure)
