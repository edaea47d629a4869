"""A frame as a detector leaves it: noise, misses, false candidates, affinities of all sizes."""

import numpy as np
import pytest

from shapepose_fg.detections import Detections
from shapepose_fg.skeleton import BODY_25


@pytest.fixture(scope="session")
def crowded(five_cameras, two_people) -> Detections:
    """Four people close to each other: 4 px of noise, a fifth missed, a false candidate for every third joint."""
    rng = np.random.default_rng(5)
    people = np.concatenate([two_people, two_people[::-1] + np.array([0.1, 0.5, 0.0])])
    xy, _ = five_cameras.project(people)
    view, person, joint = (index.ravel() for index in np.indices(xy.shape[:3]))
    xy = xy.reshape(-1, 2) + rng.normal(0, 4, (len(view), 2))
    seen = rng.random(len(view)) > 0.2
    false = rng.random(len(view)) < 1 / 3
    view, joint = (np.concatenate([each[seen], each[false]]) for each in (view, joint))
    person = np.concatenate([person[seen], np.full(false.sum(), -1)])
    xy = np.concatenate([xy[seen], xy[false] + rng.normal(0, 80, (false.sum(), 2))])
    order = rng.permutation(len(view))
    view, joint, person, xy = view[order], joint[order], person[order], xy[order]
    pairs, affinity = [], []
    for first, second in BODY_25.limbs:
        heads, tails = np.flatnonzero(joint == first), np.flatnonzero(joint == second)
        for head in heads:
            for tail in tails[view[tails] == view[head]]:
                own = person[head] == person[tail] >= 0
                if own or rng.random() < 0.3:
                    pairs.append((head, tail))
                    affinity.append(rng.uniform(0.3, 1.0) if own else rng.uniform(0.0, 0.5))
    confidence = np.where(person >= 0, rng.uniform(0.3, 1.0, len(view)), rng.uniform(0.1, 0.6, len(view)))
    return Detections(view, joint, xy, confidence, np.array(pairs), np.array(affinity))
