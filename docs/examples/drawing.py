"""Pictures of people by Matplotlib, for the examples beside this file."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from shapepose_fg.core.skeleton import BODY_25

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def room(figure, points, place=111, title=""):
    """Axes around points (..., 3) in metres, on the floor, z up."""
    low, high = (
        edge(points, axis=tuple(range(points.ndim - 1))) for edge in (np.nanmin, np.nanmax)
    )
    low, high = np.r_[low[:2] - 0.3, 0.0], np.r_[high[:2] + 0.3, high[2] + 0.1]
    axes = figure.add_subplot(place, projection="3d", title=title)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.15)
    axes.locator_params(nbins=4)
    axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    axes.view_init(elev=12, azim=-60)
    return axes


def draw_people(axes, joints, colours=COLOURS, **style):
    """Skeletons of people: joints (P, 25, 3), metres."""
    for number, person in enumerate(joints):
        for ends in BODY_25.limbs:
            line = person[list(ends)].T
            if np.isfinite(line).all():
                axes.plot(*line, color=colours[number % len(colours)], **style)


def save(figure):
    """Save a picture where the command line says, by default here, under the script's name."""
    default = Path(sys.argv[0]).with_suffix(".png").name
    file = Path(sys.argv[1] if len(sys.argv) > 1 else default)
    figure.savefig(file, dpi=110, bbox_inches="tight")
    plt.close(figure)
    print("picture:", file)
