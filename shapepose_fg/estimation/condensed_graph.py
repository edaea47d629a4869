"""A person's window, or people in single frames, as a GTSAM graph of bodies and shapes only, from
which each joint and its projection factors are eliminated: a container factor a frame. GTSAM solves
each of them with it.
"""

from collections import deque
from collections.abc import Iterator
from itertools import repeat

import gtsam
import numpy as np

from factors import body_keys, shape_key
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.estimation.body_window import HELD, BodyState, BodyWindow


def gtsam_step(window: BodyWindow, state: BodyState) -> tuple[Array, Array]:
    """Gauss-Newton step of GTSAM at a solved window: of the betas (10,), in single frames (T, 10),
    and of the poses (T, N). Rotations of the root are tangent vectors in world axes. LinAlgError if
    the system is singular.
    """
    poses = body_keys(0, np.arange(len(window))).tolist()
    shapes = [shape_key(n) for n in range(len(np.atleast_2d(state.betas)))]
    graph = gtsam.GaussianFactorGraph()
    deque(map(graph.push_back, _factors(window, state, poses, shapes)), maxlen=0)
    try:
        found = graph.optimize(gtsam.Ordering([*poses, *shapes]))
    except RuntimeError as error:  # gtsam.IndeterminantLinearSystemException
        raise np.linalg.LinAlgError(str(error)) from None
    of_shape, of_pose = (np.array([found.at(key) for key in each]) for each in (shapes, poses))
    return of_shape.reshape(state.betas.shape), of_pose


def _factors(
    window: BodyWindow, state: BodyState, poses: list[int], shapes: list[int]
) -> Iterator[gtsam.GaussianFactor]:
    """The factors: one for each frame, the shape's priors, and those of motion."""
    H, pull = frame_systems(window, state)
    pull[:, 10:] -= window.last.pull
    T, N = window.last.pull.shape
    at = np.arange(10, 10 + N)
    H[:, at, at] += HELD
    if window.links is not None:
        H[:, at, at] += window.links.diagonal[:T]
    yield from map(
        gtsam.HessianFactor, poses, shapes * (T // len(shapes)), H[:, 10:, 10:], H[:, 10:, :10],
        pull[:, 10:], H[:, :10, :10], pull[:, :10], repeat(0.0),
    )  # fmt: skip
    unit, betas = gtsam.noiseModel.Unit.Create(10), np.atleast_2d(state.betas)
    yield from map(gtsam.JacobianFactor, shapes, repeat(np.eye(10)), -betas, repeat(unit))
    if window.links is None:
        return
    none, still = np.zeros((N, N)), np.zeros(N)
    for k in range(1, min(T, 1 + window.links.beyond.shape[-1])):
        couplings = map(np.diag, window.links.beyond[: T - k, :, k - 1])
        yield from map(
            gtsam.HessianFactor, poses[:-k], poses[k:], repeat(none), couplings, repeat(still),
            repeat(none), repeat(still), repeat(0.0),
        )  # fmt: skip


def frame_systems(
    window: BodyWindow, state: BodyState, joints: Mask | None = None
) -> tuple[Array, Array]:
    """Information of each frame about betas and pose around a state: Hessians (T, P, P) and
    negative gradients (T, P), with the priors of poses. Rotations of the root are tangent vectors
    in world axes. With `joints` (J,), only the information of these joints, without priors.
    """
    system, turn, P = window.last.system, state.root, window.energy.num_free
    if joints is not None:
        system = window.information_from(state, joints)
    lower = np.tril(system[:, :P])
    H, pull = lower + np.tril(lower, -1).mT, -system[:, P]
    H[:, 10:13] = turn @ H[:, 10:13]
    H[..., 10:13] = H[..., 10:13] @ turn.mT
    pull[:, 10:13] = (turn @ pull[:, 10:13, None])[..., 0]
    return H, pull
