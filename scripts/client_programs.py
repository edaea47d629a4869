"""What `check_clients.py` asks Blender, OpenSim and rerun; each runs in a process of its own."""

import importlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

FPS, FRAMES = 25, 40
HIDDEN = range(15, 28)
"""Frames in which person 1 is not there."""
LIMIT_MM = 1.0


def check(holds: bool, words: str) -> None:
    """Print what was found; end the process where it is wrong."""
    print(f"check {'ok   ' if holds else 'WRONG'} {words}", flush=True)
    if not holds:
        sys.exit(1)


def blender(folder: Path) -> None:
    """Bones and skin in Blender's world, which is z up as the simulated one is, against the body model."""
    bpy: Any = importlib.import_module("bpy")

    truth = np.load(folder / "truth.npz")
    names = truth["joint_names"].tolist()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FPS
    bpy.ops.import_scene.gltf(filepath=str(folder / "export" / "people.glb"))
    bones, skin, hidden = [], [], []
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        for person in np.unique(truth["person"]).tolist():
            armature = bpy.data.objects[f"person_{person}"].evaluated_get(graph)
            heads = _heads(armature, [f"person_{person}_{name}" for name in names])
            row = np.flatnonzero((truth["frame"] == frame) & (truth["person"] == person))
            if len(row) == 0:
                hidden.append(np.ptp(heads, axis=0).max())
                continue
            mesh = bpy.data.objects[f"person_{person}_skin"].evaluated_get(graph)
            bones.append(np.linalg.norm(heads - truth["joints"][row[0]], axis=1))
            skin.append(np.linalg.norm(_vertices(mesh) - truth["vertices"][row[0]], axis=1))
    _check_mm("glb: bones", np.concatenate(bones))
    _check_mm("glb: skin", np.concatenate(skin))
    check(max(hidden) < 1e-3, f"glb: person 1 has no size in {len(hidden)} frames out of sight")
    for path in sorted((folder / "export").glob("*.bvh")):
        person, first, last = (int(word) for word in path.stem.replace("-", "_").split("_") if word.isdigit())
        # The importer begins at frame 1 at the earliest.
        bpy.ops.import_anim.bvh(filepath=str(path), frame_start=first + 1)
        armature = bpy.context.object
        apart = []
        for frame in range(first, last + 1):
            bpy.context.scene.frame_set(frame + 1)
            row = np.flatnonzero((truth["frame"] == frame) & (truth["person"] == person))[0]
            heads = _heads(armature.evaluated_get(bpy.context.evaluated_depsgraph_get()), names)
            apart.append(np.linalg.norm(heads - truth["joints"][row], axis=1))
        _check_mm(f"bvh: {path.name}", np.concatenate(apart))


def _heads(armature, names: list[str]) -> np.ndarray:
    """(24, 3) where bones begin in the world."""
    return np.array([armature.matrix_world @ armature.pose.bones[name].head for name in names])


def _vertices(mesh) -> np.ndarray:
    """(Nv, 3) a mesh as it is drawn, in the world."""
    flat = np.empty(3 * len(mesh.data.vertices), dtype=np.float32)
    mesh.data.vertices.foreach_get("co", flat)
    world = np.array(mesh.matrix_world)
    return flat.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def _check_mm(what: str, metres: np.ndarray) -> None:
    """All distances are within the limit."""
    mm = 1e3 * metres
    words = f"{what}: median {np.median(mm):.3f} mm, largest {mm.max():.3f} mm of {len(mm)} points"
    check(float(mm.max()) <= LIMIT_MM, words)


def opensim(folder: Path) -> None:
    """Markers read back by OpenSim, and its inverse kinematics on them with Pose2Sim's scaled model."""
    osim: Any = importlib.import_module("opensim")

    osim.Logger.setLevelString("Error")
    truth = np.load(folder / "truth.npz")
    kinds = ["trc"] + (["c3d"] if hasattr(osim, "C3DFileAdapter") else [])
    for path in sorted(path for kind in kinds for path in (folder / "export").glob(f"*.{kind}")):
        person = int(path.stem.split("_")[1])
        here = truth["person"] == person
        frames, truly = truth["frame"][here], _opensim_axes(truth["keypoints"][here])
        times, names, xyz = _read_markers(osim, path)
        unit = 1.0 if path.suffix == ".trc" else 1e-3
        if path.suffix == ".c3d":  # from the first frame with a marker; TRC has rows for those with one only
            times, xyz = times[~np.isnan(xyz).all(axis=(1, 2))], xyz[~np.isnan(xyz).all(axis=(1, 2))]
        same = bool((np.rint(times * FPS).astype(int) == frames).all()) and "CHip" in names
        apart = 1e3 * np.linalg.norm(unit * xyz - truly, axis=-1)
        words = f"{path.name}: {len(times)} frames of {len(names)} markers, largest difference"
        check(same and float(apart.max()) < 0.01, f"{words} {apart.max():.4f} mm")
    if "c3d" not in kinds:
        _c3d_as_opensim_would(folder)
    setup = json.loads((folder / "pose2sim.json").read_text())
    check(setup is not None, "Pose2Sim's model is there: pip install --no-deps pose2sim, or --pose2sim FOLDER")
    for person in (0, 1):
        _inverse_kinematics(osim, folder, Path(setup) / "OpenSim_Setup", f"person_{person}.trc")


def _c3d_as_opensim_would(folder: Path) -> None:
    """OpenSim reads C3D by ezc3d, but its package on PyPI is built without: here ezc3d reads, and TRC compares."""
    ezc3d: Any = importlib.import_module("ezc3d")
    osim: Any = importlib.import_module("opensim")

    for path in sorted((folder / "export").glob("*.c3d")):
        file = ezc3d.c3d(str(path))
        _, names, xyz = _read_markers(osim, path.with_suffix(".trc"))
        read = file["data"]["points"][:3].transpose(2, 1, 0)
        there = (file["data"]["meta_points"]["residuals"][0].T >= 0).all(axis=1)
        apart = np.linalg.norm(read[there] - 1e3 * xyz, axis=-1)
        same = file["parameters"]["POINT"]["LABELS"]["value"] == names
        check(same and float(apart.max()) < 0.01, f"{path.name}, by ezc3d, for this OpenSim is built without C3D: "
              f"as the TRC to {apart.max():.4f} mm, {(~there).sum()} frames missing")  # fmt: skip


def _opensim_axes(xyz: np.ndarray) -> np.ndarray:
    """What Pose2Sim makes of z up: (y, z, x)."""
    return xyz[..., [1, 2, 0]]


def _read_markers(osim: Any, path: Path) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Times, names and places of a file's markers as OpenSim reads them."""
    table = osim.TimeSeriesTableVec3(str(path))
    flat = table.flatten()
    values = np.array(
        [[row[c] for c in range(row.size())] for row in map(flat.getRowAtIndex, range(flat.getNumRows()))]
    )
    return (
        np.array(table.getIndependentColumn()),
        list(table.getColumnLabels()),
        values.reshape(len(values), -1, 3),
    )


def _inverse_kinematics(osim: Any, folder: Path, setup: Path, trc: str) -> None:
    """Scale Pose2Sim's model to a person's markers and follow them with it, with Pose2Sim's own settings."""
    work, stem = folder / "opensim", Path(trc).stem
    work.mkdir(exist_ok=True)
    shutil.copy(folder / "export" / trc, work / trc)
    times, _, xyz = _read_markers(osim, work / trc)
    model = osim.Model(str(setup / "Model_Pose2Sim_simple.osim"))
    model.set_MarkerSet(osim.MarkerSet(str(setup / "Markers_Body25.xml")))
    model.initSystem()
    model.printToXML(str(work / "model.osim"))
    scaling = ElementTree.parse(setup / "Scaling_Setup_Pose2Sim_Body25.xml")
    scaler = _found(scaling.getroot(), ".//ModelScaler")
    _set(_found(scaling.getroot(), ".//GenericModelMaker"), model_file="model.osim")
    measured = f"{times[0]} {times[np.flatnonzero(np.isfinite(xyz).all(axis=(1, 2)))[9]]}"
    _set(scaler, marker_file=trc, time_range=measured, scaling_order="measurements")
    _set(scaler, output_model_file=f"{stem}.osim")
    _set(_found(scaling.getroot(), ".//MarkerPlacer"), apply="false")
    scaling.write(work / f"{stem}_scaling.xml")
    osim.ScaleTool(str(work / f"{stem}_scaling.xml")).run()  # says false where no marker is placed
    check((work / f"{stem}.osim").exists(), f"Pose2Sim's model scaled to {trc}")
    tracking = ElementTree.parse(setup / "IK_Setup_Pose2Sim_Body25.xml")
    tool = _found(tracking.getroot(), ".//InverseKinematicsTool")
    _set(tool, model_file=str((work / f"{stem}.osim").resolve()), marker_file=str((work / trc).resolve()))
    _set(tool, time_range=f"{times[0]} {times[-1]}", results_directory=str(work.resolve()))
    _set(tool, output_motion_file=str((work / f"{stem}.mot").resolve()), report_errors="true")
    tracking.write(work / f"{stem}_ik.xml")
    osim.InverseKinematicsTool(str(work / f"{stem}_ik.xml")).run()
    motion = osim.TimeSeriesTable(str(work / f"{stem}.mot"))
    errors = osim.TimeSeriesTable(str(next(work.glob("*ik_marker_errors.sto"))))
    rms = 1e3 * errors.getDependentColumn("marker_error_RMS").to_numpy()
    tilt, knee = (motion.getDependentColumn(name).to_numpy() for name in ("pelvis_tilt", "knee_angle_r"))
    check(motion.getNumRows() == len(times), f"inverse kinematics of {trc}: {motion.getNumRows()} frames")
    # Joints of a detector are not the model's: a few centimetres. A wrong axis or unit is decimetres and more.
    words = f"markers {np.nanmedian(rms):.0f} mm from the model (median of frames' RMS), pelvis tilt"
    check(
        float(np.nanmedian(rms)) < 60, f"{words} {np.median(tilt):.0f} degrees, right knee {np.median(knee):.0f}"
    )


def _found(root: ElementTree.Element, path: str) -> ElementTree.Element:
    """An element that must be there."""
    element = root.find(path)
    assert element is not None, path
    return element


def _set(element: ElementTree.Element, **texts: str) -> None:
    """Give children of an element their text; make those that are not there."""
    for name, text in texts.items():
        child = element.find(name)
        (ElementTree.SubElement(element, name) if child is None else child).text = text


def rerun(folder: Path) -> None:
    """The recording verified by rerun, joints read back from it, and opened in its viewer without a window."""
    import rerun as rr

    from shapepose_fg.io.export.rerun_app import viewer_file

    path = folder / "export" / "people.rrd"
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(path)], capture_output=True, check=False
    )
    check(done.returncode == 0, f"rerun verifies {path.name}, {path.stat().st_size / 1e6:.1f} MB")
    truth = np.load(folder / "truth.npz")
    parts = [chunk for chunk in rr.chunk.RrdReader(path).stream() if chunk.entity_path == "/world/people/1/joints"]
    columns = [chunk.to_record_batch().to_pydict() for chunk in parts]
    frames = np.concatenate([column["frame"] for column in columns]).astype(int)
    points = np.concatenate([column["Points3D:positions"] for column in columns])
    truly = truth["keypoints"][truth["person"] == 1]
    same = np.array_equal(np.sort(frames), np.setdiff1d(np.arange(FRAMES), HIDDEN))
    check(same, f"person 1 is there in {len(frames)} frames and not in the others")
    _check_mm("joints of person 1", np.linalg.norm(points[np.argsort(frames)] - truly, axis=-1).ravel())
    picture = folder / "viewer.png"
    client = rr.experimental.ViewerClient
    with client.spawn(headless=True, port=9911, detach_process=False, executable_path=viewer_file()) as viewer:
        viewer.open(str(path))
        time.sleep(5)
        viewer.save_screenshot(str(picture))
        errors = [entry for entry in viewer.get_logs() if "ERROR" in str(entry.level).upper()]
        viewer.quit()
    seen = cv2.imread(str(picture))
    check(seen is not None and len(errors) == 0, f"the viewer opens it without an error: {picture}")


CLIENTS = {"blender": blender, "opensim": opensim, "rerun": rerun}
