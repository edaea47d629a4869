"""Your own body: any file in SMPL's format, here the built-in body at 70 %, for children."""

from importlib.resources import files

import matplotlib.pyplot as plt
import numpy as np
from drawing import COLOURS, room, save

from shapepose_fg import reconstruct
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.simulation import built_in_scene, simulate

arrays = dict(np.load(files("shapepose_fg.body") / "data" / "open_body.npz"))
for name in ("v_template", "shapedirs"):
    arrays[name] = 0.7 * arrays[name]
np.savez_compressed("children.npz", **arrays)
children = BodyModel.load("children.npz")

scene = built_in_scene(people=2, frames=6, body=children)  # simulated children
people = reconstruct(simulate(scene), scene.rig, fitter=make_fitter(model=children))
rows = people.rows(people.status == "ok").at(5)
parts = (rows.betas, rows.global_orient, rows.body_pose, rows.transl)
vertices = children.vertices(BodyParameters(*parts))  # (people, vertices, 3), metres
height = np.ptp(vertices[..., 2], axis=1)
print("height of the surfaces, m:", np.round(height, 2))

figure = plt.figure(figsize=(8, 6))
axes = room(figure, vertices, title="surfaces of two children")
for surface, colour in zip(vertices, COLOURS, strict=False):
    axes.plot_trisurf(*surface.T, triangles=children.faces, color=colour, linewidth=0)
save(figure)
