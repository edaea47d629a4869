"""First reconstruction: from 2D detections of six cameras to people in 3D."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import draw_people, room, save

from shapepose_fg import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

# A simulated recording. Yours: rig = read_rig("calibration.json") and
# detections = read_detections("detections", rig), both from shapepose_fg.
scene = built_in_scene(frames=12)
detections = simulate(scene)

people = reconstruct(detections, scene.rig)
people.save("results")  # for the commands: shapepose-fg export results trc

print(f"{len(people)} rows: {len(set(people.person))} people in {len(scene)} frames")
print("joints", people.joints.shape, "metres; covariances", people.covariance.shape)

last = people.at(11)
truth = scene.truth_at(11)
error = np.linalg.norm(last.joints[:, None] - truth, axis=-1).mean(axis=-1).min(axis=1)
print("mean error of each person, mm:", np.round(1000 * error, 1))

figure = plt.figure(figsize=(8, 6))
axes = room(figure, truth, title=f"{len(last)} people, {len(scene.rig)} cameras; grey: the truth")
draw_people(axes, truth, colours=("#bbbbbb",), linewidth=5)
draw_people(axes, last.joints, linewidth=2)
save(figure)
