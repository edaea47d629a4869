"""The X step: one person's joints, solved with what the views and the body say of them."""

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import interpolated
from shapepose_fg.estimation.linearisation import Message, ViewEvidence
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.window_graph import WindowGraph


def solve_joints(
    person: WindowGraph, evidence: ViewEvidence, of_body: Message, part: slice, config: EstimatorConfig
) -> Array:
    """X (T, J, 3) of one person, metres, whose rows are a `part` of those of views and body; NaN where unknown."""
    views, body = evidence.message.rows(part), of_body.rows(part)
    inlier, sigma_m, points = evidence.inlier[part], evidence.sigma_m[part], evidence.points[part]
    placed = sigma_m <= config.refine.max_sigma_m
    initial = np.where(placed[..., None], points, np.where(body.known[..., None], body.xyz, np.nan))
    if not person.temporal:
        return person.solve(inlier & (placed | body.known)[..., None], views, body, initial)
    initial = interpolated(np.where(np.isfinite(points), points, initial), person.times_s)
    # X_0 alone is no evidence: a joint that nobody says anything of has nothing that determines it.
    mentioned = (inlier.any(axis=-1) | body.known).any(axis=0) | person.touched
    initial[:, ~mentioned] = np.nan
    lost = sigma_m > LOST_M
    feet = feet_of(config.joints if config.motion.contact else ())
    return person.solve(inlier, views, body, initial, lost, feet)
