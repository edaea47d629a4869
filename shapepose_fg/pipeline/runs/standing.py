"""The floor of a run: from the soles of everybody's bodies, where their feet stand."""

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.soles import lowest_of_feet
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.floor import LOOK_S, Floor, find_floor
from shapepose_fg.pipeline.runs.parts import Parts

MOST_ROWS = 4000
"""About so many rows, of every so many frames, a floor is found from."""
STANDS_M_S = 0.1
"""A foot stands where its heel or a toe is seen and slower, and the speed is known to within this per axis."""
_BODY = ("betas", "global_orient", "body_pose", "transl")


def floor_of(parts: Parts, joints: tuple[str, ...], model: BodyModel, up: np.ndarray) -> Floor | str:
    """The floor, or in words why none was found; `up` (3,) points up in the world."""
    # Ankles alone do not say where the sole is: unseen feet hang as the body's prior has them.
    soles = [n for n in feet_of(joints).tolist() if not joints[n].endswith("Ankle")]
    sides = [[n for n in soles if joints[n].startswith(side)] for side in "RL"]
    if len(soles) == 0:
        return "the detector has no heels and toes"
    points, looks = [], []
    every = 1 + (parts.rows - 1) // MOST_ROWS
    for n in range(len(parts)):
        person, time_s = parts.column(n, "person"), parts.column(n, "time_s")
        speed, spread = parts.column(n, "velocity"), parts.column(n, "velocity_covariance")
        with np.errstate(invalid="ignore"):
            still = (np.linalg.norm(speed, axis=2) < STANDS_M_S) & (
                np.trace(spread, axis1=2, axis2=3) < 3 * STANDS_M_S**2
            )
        still &= parts.column(n, "known") == Known.SEEN
        stands = np.stack([still[:, side].any(axis=1) for side in sides], axis=1)
        stands &= (parts.column(n, "frame") % every == 0)[:, None]
        stands &= (parts.column(n, "status") == Status.OK)[:, None]
        rows, side = np.nonzero(stands)
        betas, orient, pose, transl = (parts.column(n, name)[rows] for name in _BODY)
        points.append(lowest_of_feet(model, (betas, orient, pose, transl), up)[np.arange(len(rows)), side])
        looks.append(np.stack([person[rows], side, (time_s[rows] // LOOK_S).astype(np.int64)], axis=1))
    whose = np.unique(np.concatenate(looks), axis=0, return_inverse=True)[1]
    return find_floor(np.concatenate(points), whose.ravel(), up)
