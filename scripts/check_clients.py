"""Exports opened by the programs that users open them with.

    python scripts/check_clients.py [blender opensim rerun]

A recording of three people is simulated and reconstructed; one of them is taken away for half a second. Then

- `blender` imports GLB and BVH (package bpy): bones and skin move as ours;
- `opensim` reads TRC and C3D (package opensim), and runs inverse kinematics on the markers with the model that
  Pose2Sim ships (package pose2sim, without what it depends on, or its unpacked wheel: `--pose2sim FOLDER`);
- `rerun` verifies the .rrd and counts what is in it (package rerun-sdk).

    pip install bpy opensim && pip install --no-deps pose2sim

Every client runs in a process of its own. Needs `pip install -e ".[export,view]"`; what is not installed is named.
"""

import argparse
import importlib
import importlib.util
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from client_programs import CLIENTS, FPS, FRAMES, HIDDEN


def main() -> None:
    """Check what was asked for; exit code 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clients", nargs="*", metavar="CLIENT", help="blender, opensim, rerun; all by default")
    parser.add_argument("--folder", type=Path, help="keep the files here")
    parser.add_argument("--pose2sim", type=Path, help="folder of the package Pose2Sim, if it is not installed")
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
        failed = [client for client in arguments.clients or CLIENTS if not run(client, folder, arguments.pose2sim)]
    sys.exit(f"failed: {' '.join(failed)}" if failed else 0)


def run(client: str, folder: Path, pose2sim: Path | None) -> bool:
    """Whether a client's checks hold, in a process of its own."""
    setup = pose2sim or _installed("Pose2Sim")
    (folder / "pose2sim.json").write_text(json.dumps(None if setup is None else str(setup.resolve())))
    command = [sys.executable, __file__, "--inside", client, "--folder", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("check ")]
    print(f"{client}:", *(line.removeprefix("check ") for line in lines), sep="\n  ", flush=True)
    if done.returncode != 0:
        print("  " + "\n  ".join((done.stderr or done.stdout).splitlines()[-4:]))
    return done.returncode == 0 and len(lines) > 0


def _installed(package: str) -> Path | None:
    """The folder of a package, without importing it."""
    found = importlib.util.find_spec(package)
    return None if found is None or found.origin is None else Path(found.origin).parent


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


if __name__ == "__main__":
    main()
