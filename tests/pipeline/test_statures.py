"""How tall people come out: children and the very tall too, though the body's shapes are those of
adults.
"""

import numpy as np
import pytest

from shapepose_fg import reconstruct
from shapepose_fg.body.shapes import statures_m
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.scene import Scene
from tests.conftest import read_body
from tests.foreign import Proportions, recast


def fitted_m(scene: Scene) -> np.ndarray:
    """Statures of all people in the reconstruction of a scene, in order."""
    people = reconstruct(
        simulate(scene, seed=1), scene.rig, times=FrameTimes.from_fps(25, len(scene))
    )
    assert people.shapes is not None
    return np.sort(statures_m(people.shapes.betas, read_body()))


@pytest.mark.slow
@pytest.mark.parametrize("stature_m", [1.10, 2.00])
def test_people_are_as_tall_as_they_are_to_5_cm(stature_m):
    """Two people of adults' proportions; of 1.10 m they came out with 1.18 and 1.19."""
    scene = built_in_scene(1, people=2, cameras=6, frames=24, fps=25.0)
    sizes = stature_m / statures_m(scene.motion.betas, read_body())
    scene = recast(scene, [Proportions(np.full(24, size), np.full(24, size)) for size in sizes])
    np.testing.assert_allclose(fitted_m(scene), [stature_m] * 2, atol=0.05)


@pytest.mark.slow
def test_adults_are_as_tall_as_before():
    """Four people of the model's own shapes, 1.49 to 1.88 m."""
    scene = built_in_scene(1, people=4, cameras=6, frames=40, fps=25.0)
    true = np.sort(statures_m(scene.motion.betas, read_body()))
    np.testing.assert_allclose(fitted_m(scene), true, atol=0.02)
