"""Live: people of the newest frame, where they will be, and refined rows a little later."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import save

from shapepose_fg import OnlineReconstructor, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import built_in_scene, simulate

HIPS, AHEAD_S = BODY_25.index("MidHip"), 0.2

scene = built_in_scene(people=2, frames=40)
now, soon, behind = [], [], []
with OnlineReconstructor(scene.rig, lag_s=0.3) as live:
    for frame, detections in enumerate(simulate(scene)):
        live.push(detections, frame / scene.fps)  # as a detector delivers them
        now.append(live.people())
        soon.append(live.people(frame / scene.fps + AHEAD_S))
        behind.append(live.settled())
    behind.append(live.finish())

figure, axes = plt.subplots(figsize=(8, 4))
kinds = (("newest frame", now, "."), (f"predicted {AHEAD_S} s ahead", soon, "x"))
for label, answers, mark in (*kinds, ("refined, 0.3 s later", behind, "-")):
    rows = Reconstruction.concatenate([each for each in answers if len(each) > 0])
    of_person = rows.person == 0
    error = np.full(of_person.sum(), np.nan)
    for n, time in enumerate(rows.time_s[of_person]):
        frame = round(time * scene.fps)
        if frame < len(scene):
            error[n] = np.linalg.norm(
                scene.keypoints[frame, :, HIPS] - rows.joints[of_person][n, HIPS], axis=-1
            ).min()
    print(f"{label}: median error of the hips {1000 * np.nanmedian(error):.0f} mm")
    axes.plot(rows.time_s[of_person], rows.joints[of_person, HIPS, 0], mark, label=label)
axes.set(xlabel="time, s", ylabel="x of the hips of person 0, m")
axes.legend()
save(figure)
