"""People in single frames: the model of `body_window.py` without motion, for all rows at once."""

from copy import copy
from dataclasses import replace

import numpy as np

from shapepose_fg.body.kernels.solving import solved
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.estimation.body_window import (
    DAMPING,
    HELD,
    SETTLED_M,
    STEPS,
    Around,
    BodyState,
    BodyWindow,
    Marginals,
)
from shapepose_fg.estimation.condensed_graph import frame_systems

DEVIATION_M = 0.012
"""Standard deviation of a detector's joint from the body's, metres per axis. It is larger than in a
window, because a single frame determines the shape less. Of 7, 12 and 20 mm, it is the value with
which neither simulated nor recorded people are much worse than with the best of them."""


class BodyFrames(BodyWindow):
    """The model of T rows of people in single frames, each row with its own shape."""

    over_time = False
    deviation_m = DEVIATION_M

    def rows(self, index: Index) -> "BodyFrames":
        """The model of some rows."""
        part = copy(self)
        part.observations, part.views = self.observations.rows(index), self.views.rows(index)
        part.standing = self.standing.rows(index)
        part._held = self._held.rows(index)
        for name in ("sigmas_px", "times_s", "variance", "origin"):
            setattr(part, name, getattr(self, name)[index])
        if hasattr(self, "last"):
            part.last = self.last.rows(index)
        return part

    def solve(self, start: Array) -> BodyState:
        """The states of least cost; the solver starts at bodies `start` (T, P) in the world."""
        self.origin = start[:, None, -3:]
        free = start.copy()
        free[:, -3:] = 0.0
        zero = np.zeros((*self.sigmas_px.shape[:2], 3))
        state = BodyState(free[:, :10], exp_so3(free[:, 10:13]), free[:, 13:], zero)
        self.last = self.around(state, self._bodies(state))
        damping, left = np.full(len(free), DAMPING), np.arange(len(free))
        for _ in range(STEPS):
            if len(left) == 0:
                break
            part, at = self.rows(left), state.rows(left)
            system = part.last.system.copy()
            system[:, range(10), range(10)] += 1.0  # the prior of the shape
            system[:, self.energy.num_free, :10] += at.betas
            step = np.empty((len(left), self.energy.num_free))
            solved(system, damping[left], step, np.empty(len(left)))
            step[:, 10:13] = (at.root @ step[:, 10:13, None])[..., 0]
            next_state, new = part._after(at, part.last, step[:, :10], step[:, 10:])
            better = _better(new, part.last)
            moved = new.bodies + next_state.deviation - part.last.bodies - at.deviation
            small = np.linalg.norm(moved, axis=-1).mean(axis=-1) < SETTLED_M
            state.put(left[better], next_state.rows(better))
            self.last.put(left[better], new.rows(better))
            worse = np.maximum(10 * damping[left], 1e-2)
            damping[left] = np.where(better, np.maximum(damping[left] / 5, 1e-6), worse)
            left = left[~(better & small) & (damping[left] <= 1e3)]
        return state

    def split(self, marginals: Marginals) -> list[tuple[Index, Marginals]]:
        """Each row, and its marginals."""
        found = list[tuple[Index, Marginals]]()
        for at in np.arange(len(self))[:, None]:
            names = ("poses", "steps", "shape", "across")
            parts = (getattr(marginals, name)[at] for name in names)
            one = Marginals(self.rows(at), marginals.state.rows(at), *parts)
            vars(one).update(of_bodies=marginals.of_bodies[at])  # computed for all at once
            found.append((at, one))
        return found

    def take(self, state: BodyState, shape: Array, pose: Array) -> BodyState:
        """The states after another step; rows that the step makes worse keep their state."""
        moved, new = self._after(state, self.last, shape, pose)
        worse = ~_better(new, self.last)
        new.put(worse, self.last.rows(worse))
        moved.put(worse, state.rows(worse))
        self.last = new
        return moved

    def covariances(self, state: BodyState) -> Marginals:
        """Marginal covariances of every row's variables, around the last solution."""
        H, _ = frame_systems(self, state)
        H[:, range(H.shape[1]), range(H.shape[1])] += np.repeat([1.0, HELD], [10, H.shape[1] - 10])
        whole = np.asarray(np.linalg.inv(H), dtype=np.float64)
        poses, across = whole[:, 10:, 10:], whole[:, 10:, :10]
        self.last = replace(self.last, system=np.empty((len(self), 0, 0)))
        return Marginals(self, state, poses, np.zeros_like(poses), whole[:, :10, :10], across)

    def _total(self, state: BodyState, cost: Array) -> tuple[Array, Array]:
        """The cost of each row with that of its shape, and zero for the gradient of motion."""
        nothing = np.zeros((len(cost), self.energy.num_free - 10))
        return cost + np.square(state.betas).sum(axis=1), nothing


def _better(new: Around, last: Around) -> Mask:
    return np.asarray(new.cost <= last.cost + 1e-3 * np.abs(last.cost))
