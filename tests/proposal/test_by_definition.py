"""Stage I on a crowded frame, against what it is defined to be, worked out one thing at a time."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.candidates import CandidateConfig, PairPoints, triangulate_pairs
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, FrameArrays, Nearby, own_affinity

CONFIG = CandidateConfig()
GATE_M, ANGLE_DEG = 0.07, 3.0
"""What is documented, so that another default is noticed."""


@pytest.fixture(scope="module")
def points(crowded, five_cameras) -> PairPoints:
    return triangulate_pairs(crowded, five_cameras, CONFIG)


@pytest.mark.slow
def test_points_are_the_pairs_whose_rays_meet(points, crowded, five_cameras):
    """Least squares of x P_3 - P_1 and y P_3 - P_2; kept within 7 cm of both, in front, 3 degrees
    apart.
    """
    normalised = five_cameras.normalise(crowded.view, crowded.xy)
    found = {tuple(sorted(pair)): n for n, pair in enumerate(points.pair.tolist())}
    assert len(found) == len(points.xyz)
    kept = 0
    for first, second in combinations(range(len(crowded)), 2):
        if (
            crowded.joint[first] != crowded.joint[second]
            or crowded.view[first] == crowded.view[second]
        ):
            continue
        P = five_cameras.cTw[crowded.view[[first, second]]]
        rows = [
            n * camera[2] - camera[k]
            for camera, xy in zip(P, normalised[[first, second]], strict=True)
            for k, n in enumerate(xy)
        ]
        A = np.array(rows)
        xyz = np.linalg.lstsq(A[:, :3], -A[:, 3], rcond=None)[0]
        at = P[:, :, :3] @ xyz + P[:, :, 3]
        error = np.linalg.norm(at[:, :2] - normalised[[first, second]] * at[:, 2:], axis=1).max()
        rays = np.einsum(
            "vji,vj->vi", P[:, :, :3], np.column_stack([normalised[[first, second]], np.ones(2)])
        )
        cosine = rays[0] @ rays[1] / np.prod(np.linalg.norm(rays, axis=1))
        angle = math.degrees(math.acos(min(1.0, abs(cosine))))
        fits = error < GATE_M and (at[:, 2] > 0).all() and angle > ANGLE_DEG
        assert ((first, second) in found) == fits, (error, angle)
        if fits:
            n = found[first, second]
            np.testing.assert_allclose(points.xyz[n], xyz, atol=1e-9)
            assert points.joint[n] == crowded.joint[first]
            assert points.score[n] == pytest.approx(
                math.sqrt(crowded.confidence[first] * crowded.confidence[second])
            )
            kept += 1
    assert kept > 1000  # not about nothing


def test_an_overlap_serves_only_joints_that_have_nothing_of_their_own():
    """Two noses in one view: who has the first of all detections keeps it, who has none gets the
    nearer one.
    """
    nose = BODY_25.index("Nose")
    chosen = np.full((2, 25, 1), -1, dtype=np.intp)
    chosen[0, nose, 0] = 0
    first = np.where(np.arange(26) > nose, 4, 0)
    near = Nearby(
        first, np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0.03, 0.01, 0.02, 0.024])
    )
    near.share(np.full(4, LEAST_AFFINITY), chosen)
    assert chosen[:, nose, 0].tolist() == [0, 0]
    chosen[1] = -1
    near = replace(near, distance_m=np.array([0.03, 0.01, 0.024, 0.02]))
    near.share(np.full(4, LEAST_AFFINITY), chosen)
    assert chosen[:, nose, 0].tolist() == [0, 1] and (np.delete(chosen, nose, axis=1) == -1).all()


def test_mean_affinity_is_over_the_neighbours_that_the_person_owns_in_that_view(
    crowded, five_cameras
):
    """A pair that is not listed counts 0; without a neighbour there is none, and the mean is 0."""
    rng = np.random.default_rng(0)
    own, owns = np.full((3, 25, 5), -1), np.zeros((3, len(crowded)), dtype=bool)
    for person, row in np.argwhere(rng.random(owns.shape) < 0.3).tolist():
        own[person, crowded.joint[row], crowded.view[row]] = row  # the last of a joint in a view
    owns[np.nonzero(own >= 0)[0], own[own >= 0]] = True
    arrays = FrameArrays.of(crowded, five_cameras, BODY_25)
    every = [np.ascontiguousarray(index.ravel()) for index in np.indices(owns.shape)]
    affinity, neighbours = (each.reshape(owns.shape) for each in own_affinity(*every, own, arrays))
    listed = {
        tuple(pair): value
        for pair, value in zip(crowded.pairs.tolist(), crowded.affinity, strict=True)
    }
    for person, row in zip(*(index.ravel() for index in np.indices(owns.shape)), strict=True):
        total, there = 0.0, set()
        for other in np.flatnonzero(owns[person] & (crowded.view == crowded.view[row])).tolist():
            joined = tuple(sorted((crowded.joint[row], crowded.joint[other])))
            if joined in {tuple(sorted(limb)) for limb in BODY_25.limbs}:
                there.add(int(crowded.joint[other]))
                total += listed.get((row, other), listed.get((other, row), 0.0))
        assert neighbours[person, row] == len(there)
        assert affinity[person, row] == pytest.approx(total / max(len(there), 1))
