"""Files of every format, cut and changed at random: they are read, or refused in one sentence; nothing else."""

import random
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from shapepose_fg.errors import InputError
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.skeleton_file import read_skeleton
from shapepose_fg.skeleton import COCO_17

sys.path.insert(0, str(Path(__file__).parent))
import test_calibration_formats as rigs
import test_people_formats as people

MUTATIONS = 30
"""Of each format; five hundred of each were tried when this was written."""
NUMBERS = ["1e400", "nan", "-1", "0", "99999999999999999999", '"x"', "null", "[]"]


def mutated(text: str, rng: random.Random) -> str:
    """`text` cut, or with something changed, taken out, doubled or renamed."""
    place = rng.randrange(len(text))
    match rng.randrange(6):
        case 0:
            return text[:place]
        case 1:
            return text[:place] + rng.choice('0123456789-.eE[]{}":,=<>/ \nax') + text[place + 1 :]
        case 2:
            return text[:place] + text[place + rng.randrange(1, 40) :]
        case 3:
            return text[: place + rng.randrange(1, 60)] + text[place:]
        case 4:
            found, new = list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?", text)), rng.choice(NUMBERS)
        case _:
            found, new = list(re.finditer(r"[A-Za-z_]{3,}", text)), "zzz"
    if len(found) == 0:
        return text
    chosen = rng.choice(found)
    return text[: chosen.start()] + new + text[chosen.end() :]


def try_mutations(folder: Path, read: Callable[[], object]) -> None:
    """Read the folder with one file changed at a time."""
    rng = random.Random(0)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    texts = {path: path.read_text() for path in files}
    refused = 0
    for _ in range(MUTATIONS):
        path = rng.choice(files)
        path.write_text(mutated(texts[path], rng))
        try:
            read()
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
        path.write_text(texts[path])
    assert refused > 0


@pytest.mark.parametrize("program", rigs.WRITERS)
def test_calibrations(tmp_path, program):
    write, wishes, _ = rigs.WRITERS[program]
    path = write(tmp_path)
    try_mutations(tmp_path, lambda: read_rig(path, **wishes))


def test_colmap(tmp_path):
    shutil.copytree(rigs.DATA / "colmap", tmp_path / "colmap")
    try_mutations(tmp_path / "colmap", lambda: read_rig(tmp_path / "colmap", unit="m", up="z"))


@pytest.mark.parametrize("program", people.WRITERS)
def test_detections(tmp_path, program):
    people.WRITERS[program](tmp_path, people.people_of(COCO_17))
    rig = people.two_cameras("left", "right")
    try_mutations(tmp_path, lambda: read_detections(tmp_path, rig))


def test_skeletons(tmp_path):
    (tmp_path / "ours.toml").write_text(people.USER)
    try_mutations(tmp_path, lambda: read_skeleton(tmp_path / "ours.toml"))
