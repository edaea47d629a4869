"""Exports opened by the programs that users open them with.

    python scripts/check_clients.py [blender opensim rerun]

A recording of three people is simulated and reconstructed; one of them is taken away for half a second. Then

- `blender` imports GLB and BVH (package bpy): bones and skin move as ours;
- `opensim` reads TRC (package opensim), and ezc3d, by which OpenSim does, C3D;
- `rerun` verifies the .rrd and reads joints back from it (package rerun-sdk).

Each client runs in a process of its own. Needs `pip install -e ".[export,view]" bpy opensim`.
"""

import argparse
import importlib
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

FPS, FRAMES = 25, 40
HIDDEN = range(15, 28)
"""Frames in which person 1 is not there."""
LIMIT_MM = 1.0


def main() -> None:
    """Check what was asked for; exit code 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clients", nargs="*", metavar="CLIENT", help="blender, opensim, rerun; all by default")
    parser.add_argument("--folder", type=Path, help="keep the files here")
    parser.add_argument("--inside", choices=CLIENTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if not set(arguments.clients) <= set(CLIENTS):
        parser.error(f"clients are {' '.join(CLIENTS)}")
    if arguments.inside is not None:
        CLIENTS[arguments.inside](arguments.folder)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        make(folder)
        failed = [client for client in arguments.clients or CLIENTS if not run(client, folder)]
    sys.exit(f"failed: {' '.join(failed)}" if failed else 0)


def run(client: str, folder: Path) -> bool:
    """Whether a client's checks hold, in a process of its own."""
    command = [sys.executable, __file__, "--inside", client, "--folder", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line.removeprefix("check ") for line in done.stdout.splitlines() if line.startswith("check ")]
    errors = (done.stderr or done.stdout).splitlines()[-4:] if done.returncode != 0 else []
    print(f"{client}:", *lines, *errors, sep="\n  ", flush=True)
    return done.returncode == 0 and len(lines) > 0


def make(folder: Path) -> None:
    """A result, its export in all formats, and its joints and skin by the body model: truth.npz."""
    import torch

    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
    from shapepose_fg.cli.main import main as shapepose
    from shapepose_fg.core.frame_times import FrameTimes
    from shapepose_fg.io.calibration import write_rig
    from shapepose_fg.pipeline.pipeline import reconstruct
    from shapepose_fg.simulation import built_in_scene, simulate

    torch.set_num_threads(1)
    scene = built_in_scene(people=3, frames=FRAMES)
    people = reconstruct(simulate(scene), scene.rig, times=FrameTimes.from_fps(FPS, FRAMES))
    there = ~((people.person == 1) & np.isin(people.frame, HIDDEN))
    people = replace(people.rows(there), shapes=None)
    people.save(folder / "results")
    write_rig(scene.rig, folder / "results" / "cameras.json")
    try:
        shapepose(["export", str(folder / "results"), "all", "--output", str(folder / "export")])
    except SystemExit as end:
        if end.code:
            raise
    parts = (people.betas, people.global_orient, people.body_pose, people.transl)
    body, parameters = BodyModel.default(), BodyParameters(*(torch.from_numpy(part).float() for part in parts))
    np.savez(
        folder / "truth.npz",
        frame=people.frame,
        person=people.person,
        joints=body.joints(parameters).numpy(),
        vertices=body.vertices(parameters).numpy(),
        keypoints=people.joints,
        joint_names=body.joint_names,
        keypoint_names=people.joint_names,
    )


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
    """Markers as OpenSim reads them from TRC; C3D by ezc3d, as OpenSim does, whose package is built without it."""
    osim: Any = importlib.import_module("opensim")
    ezc3d: Any = importlib.import_module("ezc3d")
    truth = np.load(folder / "truth.npz")
    for path in sorted((folder / "export").glob("*.trc")):
        here = truth["person"] == int(path.stem.split("_")[1])
        truly = truth["keypoints"][here][..., [1, 2, 0]]  # what Pose2Sim makes of z up
        table = osim.TimeSeriesTableVec3(str(path))
        flat = table.flatten()
        rows = [flat.getRowAtIndex(index) for index in range(flat.getNumRows())]
        xyz = np.array([[row[c] for c in range(row.size())] for row in rows]).reshape(len(rows), -1, 3)
        frames = np.rint(np.array(table.getIndependentColumn()) * FPS).astype(int)
        check(np.array_equal(frames, truth["frame"][here]), f"{path.name}: {len(frames)} frames, the right ones")
        _check_mm(f"{path.name}: markers", np.linalg.norm(xyz - truly, axis=-1).ravel())
        points = ezc3d.c3d(str(path.with_suffix(".c3d")))["data"]["points"][:3].transpose(2, 1, 0)
        there = ~np.isnan(points).all(axis=(1, 2))
        _check_mm(f"{path.stem}.c3d: markers", np.linalg.norm(1e-3 * points[there] - xyz, axis=-1).ravel())


def rerun(folder: Path) -> None:
    """The recording verified by rerun, and joints read back from it."""
    import rerun as rr

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


CLIENTS = {"blender": blender, "opensim": opensim, "rerun": rerun}

if __name__ == "__main__":
    main()
