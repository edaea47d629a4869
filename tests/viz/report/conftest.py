"""The result that exports are tested on, for its report: somebody out of sight, a hole, a guessed
joint.
"""

from dataclasses import replace
from pathlib import Path

import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.simulation import Scene
from shapepose_fg.viz.report.writing import write_report
from tests.io.export.conftest import result, saved, scene, true_bodies

__all__ = ["result", "saved", "scene", "true_bodies"]

HOSTILE = (
    "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"
)
"""What a calibration file could call a camera."""


@pytest.fixture(scope="session")
def page(saved: Path, result: Reconstruction, scene: Scene) -> Path:
    """The report of the result."""
    return write_report(saved, result, scene.rig)


@pytest.fixture(scope="session")
def hostile_page(result: Reconstruction, scene: Scene, tmp_path_factory) -> Path:
    """The report of the same people with names that would run as scripts."""
    first, *others = scene.rig.cameras
    rig = Rig((replace(first, name=HOSTILE), *others), scene.rig.up)
    table = result.observations
    assert table is not None
    named = replace(result, observations=replace(table, view_names=[HOSTILE, *scene.rig.names[1:]]))
    run = {"notes": [HOSTILE], "versions": {HOSTILE: HOSTILE}, "setup": {"warnings": [HOSTILE]}}
    run |= {
        "people": {"dropped": {HOSTILE: 3}},
        "inputs": {HOSTILE: "0"},
        "time": {"fps": 25, "source": HOSTILE},
    }
    return write_report(tmp_path_factory.mktemp("hostile"), named.with_run(**run), rig)
