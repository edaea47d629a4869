"""Keep a distance: the probability that somebody is within 40 cm of a machine, over time."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import COLOURS, save

from shapepose_fg import reconstruct
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.results.uncertainty import distances
from shapepose_fg.simulation import built_in_scene, simulate

scene = built_in_scene(people=3, frames=60)
times = FrameTimes.from_fps(25, len(scene))
people = reconstruct(simulate(scene), scene.rig, times=times)

tool = (0.75, 0.75, 1.0)  # of the machine, metres
distance = distances(people, tool)  # of all joints of all rows, with their covariances
near = np.nanmax(distance.below(0.40), axis=1)  # of each person, the joint that is nearest

figure, axes = plt.subplots(figsize=(8, 4))
for person in np.unique(people.person):
    rows = people.person == person
    axes.plot(people.time_s[rows], near[rows], color=COLOURS[person], label=f"person {person}")
    print(f"person {person}: within 40 cm with a probability of up to {near[rows].max():.0%}")
axes.axhline(0.05, color="grey", linestyle=":")
axes.set(xlabel="time, s", ylabel="probability to be within 40 cm", ylim=(-0.02, 1.02))
axes.set_title("the machine stops above the dotted line, 5 %")
axes.legend()
save(figure)
