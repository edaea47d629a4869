"""How wide the learned fitter's covariances without a target must be: measured on people it was not taught."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, MIRROR, TARGET_SKELETONS, slots
from shapepose_fg.simulation.training.corruption import corrupt
from shapepose_fg.simulation.training.train import PeopleSource

INSIDE = 0.9
"""Share of the joints that shall lie inside the ellipsoid of that probability which their prior claims."""
_SKELETONS = ("SMPL_24", "HALPE_26", "BODY_25")
"""The last one that has a point decides."""
_ENOUGH = 50
"""Joints without which nothing is said."""


def calibrated(weights: FitterWeights, source: PeopleSource, model: BodyModel, count: int = 4096) -> FitterWeights:
    """The same weights with `spread` measured on `count` people of `source` for each skeleton.

    What is claimed of joints without their own target (`BodyFit.prior_covariance`, less the error of the model;
    whether or not they have one) is widened or narrowed so that `INSIDE` of them are there. Left and right are
    taken together.
    """
    plain = replace(weights, spread=torch.ones(len(BODY_POINTS)))
    spread = np.ones(len(BODY_POINTS))
    generator = torch.Generator().manual_seed(2)
    for name in _SKELETONS:
        places = slots(TARGET_SKELETONS[name])
        squared = left_out_squared(plain, source, model, places, count, generator)
        for place in places:
            both = np.concatenate([squared.get(place, np.zeros(0)), squared.get(MIRROR[place], np.zeros(0))])
            if len(both) >= _ENOUGH:
                spread[place] = np.quantile(both, INSIDE) / chi2.ppf(INSIDE, 3)
    return replace(weights, spread=torch.from_numpy(spread).float())


def left_out_squared(
    weights: FitterWeights,
    source: PeopleSource,
    model: BodyModel,
    places: tuple[int, ...],
    count: int,
    generator: torch.Generator,
) -> dict[int, NDArray[np.float64]]:
    """By point: squared Mahalanobis distances of true joints to where the body puts them without their target."""
    names = tuple(BODY_POINTS[place] for place in places)
    fitter = SmplFitter(model.with_keypoints(names), weights=weights)
    people = source.draw(count, generator)
    target, information = corrupt(people.points, torch.ones(count, len(BODY_POINTS)), generator)
    chosen = list(places)
    fit = fitter.fit(JointTargets(target[:, chosen].double().numpy(), information[:, chosen].double().numpy()))
    error = (fit.prior_xyz - people.points[:, chosen].double().numpy())[fit.ok]
    covariance = fit.prior_covariance[fit.ok] - fitter.config.model_sigma_m**2 * np.eye(3)
    squared = np.einsum("nji,njik,njk->nj", error, np.linalg.inv(covariance), error)
    return {place: squared[:, row] for row, place in enumerate(places)}
