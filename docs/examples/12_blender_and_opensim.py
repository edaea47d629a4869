"""Results in Blender and OpenSim: write GLB, BVH and TRC files, and read the markers back."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from drawing import COLOURS, save

from shapepose_fg import reconstruct
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.io.export.registry import chosen, export_result
from shapepose_fg.simulation import built_in_scene, simulate

scene = built_in_scene(people=2, frames=25)
times = FrameTimes.from_fps(25, len(scene))
reconstruct(simulate(scene), scene.rig, times=times).save("results")

written = export_result(Path("results"), chosen(["glb", "bvh", "trc"]), Path("results/export"))
for kind, output in written.items():
    print(kind, *(path.name for path in output.files))
# Blender: File > Import > glTF (people with surfaces) or BVH (a skeleton to retarget).
# OpenSim: Tools > Scale, then Inverse Kinematics, with a TRC file per person; y is up.

figure, axes = plt.subplots(figsize=(8, 4))
for number, path in enumerate(sorted(Path("results/export").glob("*.trc"))):
    lines = path.read_text().splitlines()
    markers = [name for name in lines[3].split("\t")[2:] if name]
    table = np.array([line.split("\t") for line in lines[5:] if line.strip()])
    place = table[:, 2:].astype(float).reshape(len(table), -1, 3)[:, : len(markers)]
    heel = place[:, markers.index("LHeel"), 1]
    axes.plot(table[:, 1].astype(float), heel, color=COLOURS[number], label=path.name)
axes.set(xlabel="time, s", ylabel="height of the marker LHeel, m", ylim=(0, None))
axes.legend()
save(figure)
