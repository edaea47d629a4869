"""scripts/fit_motion.py: it finds the densities and states that made a motion."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "scripts/fit_motion.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("fit_motion", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_density_of_white_accelerations_is_found(script):
    rng, dt, fine = np.random.default_rng(0), 1 / script.FPS, 20
    noise = rng.normal(0.0, np.sqrt(0.5 * fine / dt), (12, 300 * fine, 25, 3))
    clips = np.cumsum(np.cumsum(noise, axis=1) * dt / fine, axis=1)[:, ::fine] * dt / fine
    # Speeds of people; faster ones are left out of the fit.
    clips = [clip - np.linspace(clip[0], clip[-1], len(clip)) for clip in clips]
    for still, rising, lost in script.acceleration_densities(clips).values():
        assert still + rising == pytest.approx(0.5, rel=0.25)
        assert lost == pytest.approx(0.5, rel=0.25)


def test_standing_and_moving_feet_are_told_apart(script):
    rng, speed = np.random.default_rng(1), np.repeat([0.02, 1.5] * 6, 15)
    steps = rng.normal(0.0, speed[:, None, None], (180, 25, 3)) / script.FPS
    found = script.foot_motion([np.cumsum(steps, axis=0)] * 3)
    # Velocities over two frames: white steps have half the variance.
    assert found["speed_m_s"][0] == pytest.approx(0.02 / np.sqrt(2), rel=0.3)
    assert found["speed_m_s"][2] == pytest.approx(1.5 / np.sqrt(2), rel=0.3)
    np.testing.assert_allclose(np.sum(found["turns"], axis=1), 1.0, atol=0.02)
