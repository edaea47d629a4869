"""What other programs make of our files: rates, start frames, axes and units, read back by those
programs.

Blender's Python (bpy), OpenSim's, trimesh and Polars need other versions of packages than ours:
they run in a process of their own, by a Python that has them. SHAPEPOSE_READERS names such Pythons,
with colons between.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.export.registry import FORMATS, export_result

from .conftest import AWAY, FIRST, FRAMES

RATE = 60.0


def read_by(module: str, code: str, *files: Path) -> dict:
    """What `code` prints last, as JSON; it has `module`, and its files as `files`."""
    pythons = [
        *filter(None, os.environ.get("SHAPEPOSE_READERS", "").split(os.pathsep)),
        sys.executable,
    ]
    find = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for python in pythons:
        if subprocess.run([python, "-c", find], env=clean, check=False).returncode == 0:
            words = [
                python,
                "-c",
                f"import json, sys, {module}\nfiles = sys.argv[1:]\n{code}",
                *map(str, files),
            ]
            done = subprocess.run(words, env=clean, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            return json.loads(done.stdout.strip().splitlines()[-1])
    pytest.skip(
        f"{module} is not installed; pip install it beside, and name that Python in "
        "SHAPEPOSE_READERS"
    )


@pytest.fixture(scope="module")
def filmed(result):
    """The result as it was filmed at 60 a second, its times in microseconds, as `detect` writes
    them.
    """
    return replace(result, time_s=(result.frame / RATE).round(6)).with_run(time={"fps": 59.9988})


@pytest.fixture(scope="module")
def exported(filmed, scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    filmed.save(folder)
    write_rig(scene.rig, folder / "cameras.json")
    pytest.importorskip("pyarrow", reason='needs pip install "shapepose-fg[archive]"')
    names = ("amass", "trc", "c3d", "bvh", "glb", "csv", "parquet")
    export_result(folder, [FORMATS[name] for name in names], folder)
    return folder


def test_all_rates_are_exact(exported):
    trc = (exported / "person_3.trc").read_text().splitlines()
    assert trc[2].split("\t")[:2] == ["60", "60"]
    with np.load(exported / "person_3_frames_100-123_amass.npz") as amass:
        assert amass["mocap_framerate"] == amass["mocap_frame_rate"] == RATE
    bvh = (exported / "person_3_frames_100-123.bvh").read_text().splitlines()
    (step,) = (line.split(":")[1] for line in bvh if line.startswith("Frame Time"))
    assert 1 / float(step) == pytest.approx(RATE, abs=1e-9)
    ezc3d = pytest.importorskip("ezc3d")
    c3d = ezc3d.c3d(str(exported / "person_3.c3d"))
    assert (
        c3d["parameters"]["POINT"]["RATE"]["value"][0]
        == c3d["header"]["points"]["frame_rate"]
        == RATE
    )
    # It gives numbers from 0, which stand in the file from 1.
    assert c3d["header"]["points"]["first_frame"] == FIRST
    assert c3d["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]


BVH = """
bpy.ops.wm.read_factory_settings(use_empty=True)
how = dict(global_scale=1, frame_start=int(files[1]), update_scene_fps=True)
bpy.ops.import_anim.bvh(filepath=files[0], **how)
scene, figure = bpy.context.scene, bpy.context.object
strip = figure.animation_data.action.layers[0].strips[0]
keys = [point.co[0] for point in strip.channelbags[0].fcurves[0].keyframe_points]
scene.frame_set(int(files[1]))
hip = figure.matrix_world @ figure.pose.bones["pelvis"].head
rate = scene.render.fps / scene.render.fps_base
print(json.dumps({"rate": rate, "keys": keys, "pelvis": list(hip)}))
"""


def test_blender_has_a_bvh_where_the_docs_say(exported, filmed, true_bodies):
    """The start frame is the number in the name and one; frame n is then at n + 1; z is up, in
    metres.
    """
    file = exported / f"person_3_frames_{FIRST}-{FIRST + FRAMES - 1}.bvh"
    told = read_by("bpy", BVH, file, Path(str(FIRST + 1)))
    assert told["rate"] == pytest.approx(RATE, abs=1e-3)
    assert told["keys"] == [frame + 1 for frame in range(FIRST, FIRST + FRAMES)]
    np.testing.assert_allclose(told["pelvis"], true_bodies(3, FIRST)[0][0], atol=1e-4)


GLB = """
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 60
bpy.ops.import_scene.gltf(filepath=files[0])
figure = next(each for each in bpy.data.objects if each.type == "ARMATURE" and "3" in each.name)
keys = sorted({point.co[0] for action in bpy.data.actions
               for curve in action.layers[0].strips[0].channelbags[0].fcurves
               for point in curve.keyframe_points})
bpy.context.scene.frame_set(int(files[1]))
places = [list(figure.matrix_world @ bone.head) for bone in figure.pose.bones]
print(json.dumps({"keys": keys, "places": places}))
"""


def test_blender_has_a_glb_from_its_frame_0_on(exported, true_bodies):
    told = read_by("bpy", GLB, exported / "people.glb", Path("20"))
    np.testing.assert_allclose(told["keys"], np.arange(FRAMES), atol=0.01)
    pelvis = true_bodies(3, FIRST + 20)[0][0]
    assert np.linalg.norm(np.array(told["places"]) - pelvis, axis=1).min() < 1e-3


TRC = """
table = opensim.TimeSeriesTableVec3(files[0])
name = table.getColumnLabels()[0]
first = table.getRowAtIndex(0)
print(json.dumps({"rate": table.getTableMetaDataString("DataRate"),
                  "unit": table.getTableMetaDataString("Units"),
                  "times": list(table.getIndependentColumn()), "name": name,
                  "first": [first[0][axis] for axis in range(3)]}))
"""


def test_opensim_reads_markers(exported, filmed):
    told = read_by("opensim", TRC, exported / "person_3.trc")
    assert float(told["rate"]) == RATE and told["unit"] == "m"
    np.testing.assert_allclose(told["times"], np.arange(FIRST, FIRST + FRAMES) / RATE, atol=1e-6)
    row = filmed.rows((filmed.frame == FIRST) & (filmed.person == 3))
    joint = row.joints[0, BODY_25.index(told["name"])]
    np.testing.assert_allclose(told["first"], joint[[1, 2, 0]], atol=1e-6)  # y up


def test_polars_reads_a_row_per_person_and_frame(exported, filmed):
    code = """
table = polars.read_parquet(files[0])
print(json.dumps({"frame": table["frame"].to_list(), "time_s": table["time_s"].to_list(),
                  "rows": len(polars.read_csv(files[1]))}))
"""
    told = read_by("polars", code, exported / "people.parquet", exported / "joints.csv")
    assert told["frame"] == filmed.frame.tolist() and told["time_s"] == filmed.time_s.tolist()
    assert told["rows"] == np.isfinite(filmed.joints).all(axis=2).sum()


def test_trimesh_reads_bodies_that_stand_along_y(exported):
    code = """
scene = trimesh.load(files[0])
low, high = scene.bounds
print(json.dumps({"low": low.tolist(), "high": high.tolist(), "meshes": len(scene.geometry)}))
"""
    told = read_by("trimesh", code, exported / "people.glb")
    extent = np.subtract(told["high"], told["low"])
    assert told["meshes"] == 2 and 1.4 < extent[1] < 2.2


@pytest.mark.slow
def test_rerun_has_the_frames_and_their_times(exported, filmed, tmp_path):
    rerun = pytest.importorskip("rerun")
    export_result(exported, [FORMATS["rrd"]], tmp_path)
    chunks = rerun.chunk.RrdReader(tmp_path / "people.rrd").stream()
    tables = [
        chunk.to_record_batch() for chunk in chunks if chunk.entity_path == "/world/people/7/joints"
    ]
    rows = sorted(
        (row for table in tables for row in table.to_pylist()), key=lambda row: row["frame"]
    )
    assert [row["frame"] for row in rows] == [
        n for n in range(FIRST, FIRST + FRAMES) if n not in AWAY
    ]
    seconds = [row["time"].total_seconds() for row in rows]
    np.testing.assert_allclose(seconds, [row["frame"] / RATE for row in rows], atol=2e-6)
