"""The scripts and the notebook of docs/examples run, and draw; the gallery shows them all."""

import json
import runpy
from pathlib import Path

import cv2
import pytest

from shapepose_fg import simulation

FOLDER = Path(__file__).parents[2] / "docs" / "examples"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
SLOW = ("01", "02", "03", "05", "06", "08", "11", "12")
"""Those that take seconds, and use little that the others do not."""
FRAMES = 14
"""Most frames that a script simulates here: all calls and the picture are those of more frames."""

pytest.importorskip("matplotlib", reason="examples draw with Matplotlib, of the extra dev")


@pytest.fixture
def empty_folder(tmp_path, monkeypatch) -> Path:
    """The working directory, from which the examples' own folder is imported, without a window."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return tmp_path


@pytest.fixture
def short_scenes(monkeypatch) -> None:
    """Simulated scenes of `FRAMES` frames at most."""
    whole = simulation.built_in_scene

    def shorter(*given: object, frames: int = FRAMES, **more: object) -> simulation.Scene:
        return whole(*given, frames=min(frames, FRAMES), **more)

    monkeypatch.setattr(simulation, "built_in_scene", shorter)


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(each, id=each.stem, marks=[pytest.mark.slow] * each.name.startswith(SLOW))
        for each in SCRIPTS
    ],
)
@pytest.mark.usefixtures("short_scenes")
def test_an_example_draws_where_it_is_told(script, empty_folder, monkeypatch):
    picture = empty_folder / "drawn.png"
    monkeypatch.setattr("sys.argv", [str(script), str(picture)])
    runpy.run_path(str(script), run_name="__main__")
    drawn = cv2.imread(str(picture))
    assert drawn is not None and min(drawn.shape[:2]) > 200
    assert (drawn < 128).any(axis=-1).mean() > 0.005, "an empty picture"


@pytest.mark.slow
def test_the_notebook_runs(empty_folder):
    names: dict = {}
    for cell in json.loads((FOLDER / "first_hour.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), "first_hour.ipynb", "exec"), names)
    assert len(names["people"]) == 40
    assert abs(sorted(names["distance_m"])[20] - 0.40) < 0.03
    assert (empty_folder / "results" / "people.npz").is_file()


def test_the_gallery_shows_every_example():
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert len(SCRIPTS) >= 12
    for number, script in enumerate(SCRIPTS, 1):
        assert script.name.startswith(f"{number:02}_")
        assert f"]({script.name})" in page and f"](pictures/{script.stem}.png)" in page
        assert (FOLDER / "pictures" / f"{script.stem}.png").is_file()
        assert len(script.read_text(encoding="utf-8").splitlines()) < 60
