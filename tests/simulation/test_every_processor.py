"""The same seed gives the same recording, whatever kernels linear algebra and compiled functions
take.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import sequence
from tests.conftest import pytest_configure

ROOT = Path(__file__).parents[2]
NO_VECTORS = {"NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3"}
"""NumPy's functions as on a processor from before 2013."""
PROCESSORS = [
    {"OPENBLAS_CORETYPE": "Nehalem"},
    {"OPENBLAS_CORETYPE": "Prescott", "NUMBA_CPU_NAME": "generic"} | NO_VECTORS,
]
"""Variables that choose kernels of other processors, all of which an x86-64 with AVX2 can run."""


def recordings(mocap: Path) -> dict[str, np.ndarray]:
    """Truth and detections of the built-in scene and of two pairs who dance, some frames of two
    seeds each.
    """
    found = {}
    crowd = sequence("crowd", "tune", Mocap.load(mocap), cameras=4, frames=40).part(range(3))
    for seed in (0, 1):
        demo = built_in_scene(seed, people=5, cameras=4, frames=4)
        for name, scene in (("demo", demo), ("crowd", crowd)):
            found |= {f"{name} {seed} {part}": value for part, value in parts(scene, seed).items()}
    return found


def parts(scene: Scene, seed: int) -> dict[str, np.ndarray]:
    """All arrays of a scene and of the detections in it, frames one after the other."""
    recording = simulate(scene, seed=seed)
    names = vars(recording[0])
    made = {name: np.concatenate([vars(frame)[name] for frame in recording]) for name in names}
    return made | {
        "count": np.array([len(frame) for frame in recording]),
        "joints": scene.keypoints,
    }


def save(mocap: str, output: str) -> None:
    """What another process runs: with the same draws as here."""
    pytest_configure()
    np.savez(output, **recordings(Path(mocap)))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def here(tiny_mocap_file: Path) -> dict[str, np.ndarray]:
    return recordings(tiny_mocap_file)


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names kernels of x86-64")
@pytest.mark.parametrize("processor", PROCESSORS, ids=" ".join)
def test_the_same_seed_gives_the_same_recording_on_every_processor(
    processor: dict[str, str], here: dict[str, np.ndarray], tiny_mocap_file: Path, tmp_path: Path
):
    code = "import sys; from tests.simulation.test_every_processor import save; save(*sys.argv[1:])"
    run = [sys.executable, "-c", code, str(tiny_mocap_file), str(tmp_path / "there.npz")]
    subprocess.run(run, check=True, timeout=600, cwd=ROOT, env=os.environ | processor)
    with np.load(tmp_path / "there.npz") as there:
        assert set(there) == set(here)
        for name, value in here.items():
            np.testing.assert_allclose(there[name], value, rtol=0, atol=1e-9, err_msg=name)
