"""A calibration that was changed is written in the format it came in, and reads back as it was
changed.
"""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.core.camera import Rig
from shapepose_fg.io.calibration import read_rig, write_like, write_rig
from shapepose_fg.io.calibration.rewriting import REWRITTEN
from shapepose_fg.io.calibration.xml_files import QUALISYS
from shapepose_fg.simulation import built_in_scene
from tests.io.test_calibration_formats import WRITERS, easymocap

DATA = Path(os.environ.get("SHAPEPOSE_DATA", "../shared")) / "data"
REAL = {
    "shelf/calibration.json": {},
    "panoptic_pizza/calibration.json": {"image_size": (1920, 1080)},
    "formats/pose2sim_Calib.toml": {},
    "formats/freemocap_calibration.toml": {"unit": "mm", "up": "-y"},
    "formats/caliscope_camera_array.toml": {"up": "-y"},
    "pose2sim_single/Calib.qca.txt": {},
}


def changed(rig: Rig) -> Rig:
    """The rig with every camera turned, moved, and of other focal length and distortion."""
    cameras = []
    for number, camera in enumerate(rig.cameras):
        wTc, K = camera.wTc.copy(), camera.K.copy()
        wTc[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec([0.01, -0.02, 0.005 * number]).as_matrix()
        wTc[:3, 3] += (0.01, -0.03, 0.02)
        K[:2] *= 1.01
        bent = camera.distortion * 1.1
        cameras.append(replace(camera, wTc=wTc, K=K, distortion=bent))
    return replace(rig, cameras=tuple(cameras))


def same(one: Rig, other: Rig) -> None:
    assert one.names == other.names and one.up == other.up
    for a, b in zip(one.cameras, other.cameras, strict=True):
        assert a.image_size == b.image_size and a.lens == b.lens
        for name in ("K", "wTc", "distortion"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)


def test_our_own_rig_file_reads_back(tmp_path):
    rig = built_in_scene(frames=1).rig
    write_rig(rig, tmp_path / "rig.json")
    assert write_like(tmp_path / "rig.json", changed(rig), tmp_path / "new.json")[0] == "rig file"
    same(read_rig(tmp_path / "new.json"), changed(rig))


@pytest.mark.parametrize("name", REAL)
def test_real_files_read_back_and_keep_the_rest(tmp_path, name):
    source, how = DATA / name, REAL[name]
    if not source.exists():
        pytest.skip("recordings are not here")
    rig, target = read_rig(source, **how), tmp_path / f"new{source.suffix}"
    assert write_like(source, changed(rig), target, how.get("unit"))[0] != "rig file"
    same(read_rig(target, **how), changed(rig))
    write_like(source, rig, target, how.get("unit"))
    same(read_rig(target, **how), rig)


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_is_written_as_it_came_in(tmp_path, name):
    """As the tests of reading have each; a folder becomes a folder."""
    write, how, _ = WRITERS[name]
    (tmp_path / "given").mkdir()
    source = write(tmp_path / "given")
    rig, target = (
        read_rig(source, **how),
        tmp_path / ("new" if source.is_dir() else f"new{source.suffix}"),
    )
    form, there = write_like(source, changed(rig), target, how.get("unit"))
    assert there == target and form != "rig file"
    same(read_rig(target, **how), changed(rig))


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_named_json_is_json(tmp_path, name):
    write, how, _ = WRITERS[name]
    (tmp_path / "given").mkdir()
    source = write(tmp_path / "given")
    rig = read_rig(source, **how)
    form, there = write_like(source, changed(rig), tmp_path / "new.json", how.get("unit"))
    assert there == tmp_path / "new.json"
    if source.suffix != ".json":
        assert form == "rig file"
    json.loads(there.read_text())


def test_a_folder_s_format_goes_into_a_file_as_our_own(tmp_path):
    source = easymocap(tmp_path)
    rig = read_rig(source)
    assert write_like(source, changed(rig), tmp_path / "new.json")[0] == "rig file"
    same(read_rig(tmp_path / "new.json"), changed(rig))


def test_what_does_not_read_back_is_written_as_our_own(tmp_path, monkeypatch):
    """Whatever a format's writer makes of it, nobody is left with a file that cannot be read."""
    write, how, _ = WRITERS["Qualisys"]
    source = write(tmp_path)
    rig = read_rig(source, **how)
    for text in ("", "<calibration><cameras><camera serial='1'/></cameras></calibration>"):
        monkeypatch.setitem(
            REWRITTEN, QUALISYS.name, lambda content, *_, text=text: {content.path: text}
        )
        assert write_like(source, changed(rig), tmp_path / "new.json")[0] == "rig file"
        same(read_rig(tmp_path / "new.json"), changed(rig))


def test_a_lens_that_two_pictures_share_cannot_be_written_as_two(tmp_path):
    """COLMAP's pictures of one camera have one focal length: what was refined apart is written as
    our own.
    """
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "cameras.txt").write_text(
        "# cameras\n1 OPENCV 1280 720 900 900 640.5 360.5 0.1 0 0 0\n"
    )
    turn = "0.9689124217106447 0 0.24740395925452294 0"
    poses = [f"{n} {turn} {n}.5 0.25 3 1 left/{n}.png\n{n}.0 2.0 -1\n" for n in (1, 2)]
    (folder / "images.txt").write_text("# pictures\n" + "".join(poses))
    rig = read_rig(folder, up="z", unit="m")
    moved = changed(rig)
    assert "COLMAP" in write_like(folder, moved, tmp_path / "new", "m")[0]
    same(read_rig(tmp_path / "new", up="z", unit="m"), moved)
    K = moved.cameras[0].K.copy()
    K[:2] *= 1.01
    apart = replace(moved, cameras=(replace(moved.cameras[0], K=K), moved.cameras[1]))
    form, there = write_like(folder, apart, tmp_path / "apart", "m")
    assert form == "rig file" and there == tmp_path / "apart.json"
    same(read_rig(there), apart)
