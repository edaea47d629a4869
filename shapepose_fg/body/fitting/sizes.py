"""People outside the range of adult shapes: children, and the very tall.

A body's shapes are those of adults, and extrapolate badly: at 1.10 m, five standard deviations
below the mean, thighs are a sixth too short for a child, and a body fitted to a child's joints is 6
cm too tall. Such people are therefore fitted after scaling to an adult's size. The result is then
the body closest to the scaled one that has
*the same stature*.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyConfig
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Mask

_ADULT = 2.0
"""Range of adults' stature, standard deviations from the mean."""
_ROUNDS = 2
"""Number of estimates at an adult's size; the first size is biased by the prior of adults."""


def points_at_rest(body: BodyModel) -> tuple[Array, Array]:
    """All points of the mean body in T-pose, relative to its pelvis, (150,), metres, and
    their derivatives by the betas, (150, 10).
    """
    betas = np.concatenate((np.zeros((1, 10)), np.eye(10)))
    xyz = body.points.positions(np.tile(np.eye(3), (11, 24, 1, 1)), betas, np.zeros((11, 3)))
    xyz = (xyz - xyz[:, [BODY_POINTS.index("pelvis")]]).reshape(11, -1)
    return xyz[0], (xyz[1:] - xyz[0]).T


@dataclass(frozen=True)
class Sizes:
    """Stature of a body model as a function of shape."""

    stature_m: float
    """Stature of the mean body, metres."""
    taller: Array
    """(10,) change of stature per beta, metres."""

    @classmethod
    def of(cls, body: BodyModel) -> "Sizes":
        """Measure a body model."""
        template, shapes = body.arrays.template, body.arrays.shapes
        top, sole = template[:, 1].argmax(), template[:, 1].argmin()
        return cls(float(template[top, 1] - template[sole, 1]), shapes[top, 1] - shapes[sole, 1])

    def far(self, betas: Array) -> Mask:
        """(G,) whether the stature for `betas` (G, 10) is outside the range of adults."""
        return np.abs(betas @ self.taller) > _ADULT * np.linalg.norm(self.taller)

    def ratio(self, betas: Array) -> Array:
        """(G,) stature for `betas` (G, 10), relative to the mean body."""
        return 1 + betas @ self.taller / self.stature_m

    def measured(self, body: BodyModel, betas: Array, information: Array, pull: Array) -> Array:
        """(10,) betas of a person who was measured with `information` (10, 10) without a prior,
        where `pull` (10,) is information times betas; `betas` (10,) are a first estimate.

        At an adult's size, the prior of adults holds: if the person is `size` times the adult with
        betas a, size a + (size - 1) u is measured, with u the betas that make a body larger.
        """
        mean, by_betas = points_at_rest(body)
        larger = np.linalg.lstsq(by_betas, mean, rcond=None)[0]
        for _ in range(_ROUNDS):
            size = self.ratio(betas[None])[0]
            right = size * (pull - (size - 1) * information @ larger)
            adult = np.linalg.solve(size**2 * information + np.eye(10), right)
            betas = self.resized(body, adult[None], np.array([size]))[0]
        return betas

    def resized(self, body: BodyModel, betas: Array, size: Array) -> Array:
        """(G, 10) betas of the bodies closest to bodies `betas` (G, 10) scaled by `size` (G,), with
        the same stature as these.

        Minimises |points - wanted|² / sigma² + |betas|², with the stature as a constraint.
        """
        mean, by_betas = points_at_rest(body)
        wanted = size[:, None] * (mean + betas @ by_betas.T) - mean
        taller = (size * self.ratio(betas) - 1) * self.stature_m
        system = np.zeros((11, 11))
        system[:10, :10] = by_betas.T @ by_betas + BodyConfig.model_sigma_m**2 * np.eye(10)
        system[:10, 10] = system[10, :10] = self.taller
        right = np.concatenate([wanted @ by_betas, taller[:, None]], axis=1)
        return np.asarray(np.linalg.solve(system, right.T).T[:, :10], dtype=np.float64)
