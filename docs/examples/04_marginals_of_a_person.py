"""The graph of a person in GTSAM: marginals, and a new measurement that makes a wrist certain."""

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from drawing import save

from factors import isotropic
from shapepose_fg import reconstruct
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.results.solve_again import window_solutions
from shapepose_fg.simulation import built_in_scene, simulate

WRIST, TOUCHED = BODY_25.index("RWrist"), 6

scene = built_in_scene(people=2, cameras=3, frames=13)
people = reconstruct(simulate(scene), scene.rig)
person = next(window_solutions(people, scene.rig))
print(f"person {person.person}: {person.graph.size()} factors, {person.values.size()} variables")

isam = gtsam.ISAM2()
isam.update(person.graph, person.values)


def sigmas_mm():
    """Standard deviation of the wrist in each frame, mean over the axes."""
    covariances = [isam.marginalCovariance(key) for key in person.keys[:, WRIST].tolist()]
    return 1000 * np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 3)


before = sigmas_mm()
# A sensor of yours feels the wrist in one frame, to 5 mm.
touch = gtsam.NonlinearFactorGraph()
place = person.joints[TOUCHED, WRIST]
touch.addPriorPoint3(int(person.keys[TOUCHED, WRIST]), place, isotropic(3, 0.005))
isam.update(touch, gtsam.Values())
after = sigmas_mm()

figure, axes = plt.subplots(figsize=(8, 4))
axes.plot(person.frames, before, "o-", label="cameras, body and motion")
axes.plot(person.frames, after, "o-", label=f"and a touch in frame {person.frames[TOUCHED]}")
axes.set(xlabel="frame", ylabel="standard deviation of the right wrist, mm", ylim=(0, None))
axes.legend()
save(figure)
