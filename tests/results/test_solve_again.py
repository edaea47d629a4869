"""People solved anew from the observations of a result: nothing changes where nobody did, and swaps
are mended.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.pipeline import setup
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.results import solve_again
from shapepose_fg.results.edits import Action, Edit, apply, solve_anew
from shapepose_fg.results.solve_again import Solver, solve_rows
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.scene import Scene

FRAMES = 12
CONFIG = PipelineConfig(batch_frames=8)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(people=3, cameras=4, frames=FRAMES)


@pytest.fixture(scope="module")
def people(scene) -> Reconstruction:
    """One window of twelve frames: it takes up to half of its eight more."""
    return reconstruct(simulate(scene), scene.rig, CONFIG)


def solve(rows: Reconstruction, scene: Scene, config: PipelineConfig = CONFIG) -> Reconstruction:
    offsets = KeypointOffsets.from_dict(rows.run["keypoint_offsets"])
    fitter = make_fitter(config.body, BodyModel.default()).with_keypoint_offsets(offsets)
    return solve_rows(rows, Solver(scene.rig, config, fitter))


def moved_mm(one: Reconstruction, other: Reconstruction) -> np.ndarray:
    np.testing.assert_array_equal(one.frame, other.frame)
    np.testing.assert_array_equal(one.person, other.person)
    return 1e3 * np.linalg.norm(one.joints - other.joints, axis=-1)


def test_solved_anew_nobody_moves(scene, people):
    """The same observations, from where the views put them: the alternation settles to the same,
    but for joints that views hardly see.
    """
    again = solve_anew(
        replace_changed(people, frozenset(people.person.tolist())), lambda rows: solve(rows, scene)
    )
    assert np.nanmedian(moved_mm(again, people)) < 1.5
    assert np.nanquantile(moved_mm(again, people), 0.9) < 10
    assert (again.observations.gate != people.observations.gate).mean() < 0.02
    np.testing.assert_array_equal(again.observations.candidate, people.observations.candidate)
    assert again.run == people.run


def replace_changed(people: Reconstruction, changed: frozenset[int]):
    return replace(
        apply(people, Edit(Action.RENAME, int(people.person[0]), 99)),
        people=people,
        changed=changed,
    )


LONG = PipelineConfig(batch_frames=6, windows=WindowConfig(overlap_s=0.1))


def solved_frames(work: Callable[[], Reconstruction]) -> tuple[list[list[int]], Reconstruction]:
    """The frames of each window that is solved meanwhile, and what comes of it."""
    frames, solve = [], setup.solve_window

    def noted(observations, *others, **more):
        frames.append(sorted(set(observations.frame.tolist())))
        return solve(observations, *others, **more)

    with pytest.MonkeyPatch.context() as patch:
        for module in (setup, solve_again):
            patch.setattr(module, "solve_window", noted)
        return frames, work()


@pytest.mark.slow
def test_rows_are_solved_anew_in_the_windows_of_the_recording():
    """22 frames cut before the tenth, windows of six that overlap by three; the last of each part
    is longer.
    """
    scene = built_in_scene(people=2, cameras=4, frames=22)
    windows, people = solved_frames(lambda: reconstruct(simulate(scene), scene.rig, LONG, cuts=[9]))
    spans = [(0, 9), (9, 19), (12, 22)]  # 9 to 15 and 15 to 22, and three frames of the other
    assert windows == [list(range(start, stop)) for start, stop in spans]
    assert solved_frames(lambda: solve(people, scene, LONG))[0] == windows
    # Nobody in the frames about the border: it lies where it did.
    gone = [13, 14, 15, 16]
    fewer = people.rows(~np.isin(people.frame, gone))
    expected = [[frame for frame in window if frame not in gone] for window in windows]
    assert solved_frames(lambda: solve(fewer, scene, LONG))[0] == expected


@pytest.mark.slow
def test_a_swap_is_mended_and_only_who_was_in_it_is_solved(scene, people):
    """Two people who changed places in frame 6 are torn apart by motion; put right, they are where
    they were.
    """
    first, second, third = sorted(set(people.person.tolist()))[:3]
    swap = Edit(Action.SWAP, first, second, 6)
    wrong = solve_anew(apply(people, swap), lambda rows: solve(rows, scene))
    there = wrong.person == third
    assert moved_mm(wrong, apply(people, swap).people)[there].max() == 0
    torn = moved_mm(wrong, apply(people, swap).people)[~there]
    assert np.nanmax(torn) > 30, "motion holds on to who it thinks they are"
    mended = solve_anew(apply(wrong, swap), lambda rows: solve(rows, scene))
    assert np.nanmedian(moved_mm(mended, people)) < 1
    assert np.nanquantile(moved_mm(mended, people), 0.95) < 20


def test_without_observations_it_is_said(scene, people):
    with pytest.raises(ValueError, match="rows without observations cannot be solved again"):
        solve(replace(people, observations=None), scene)


def saved(people: Reconstruction, scene: Scene, folder: Path) -> Path:
    people.save(folder)
    write_rig(scene.rig, folder / CAMERAS)
    return folder


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    return int(caught.value.code or 0)


@pytest.mark.slow
def test_tracks_solves_anew_who_changed(scene, people, tmp_path, capsys):
    folder = saved(people, scene, tmp_path / "results")
    whole = (folder / "people.npz").read_bytes()
    first = int(people.person[0])
    assert run("tracks", folder, "split", first, 5, "--new", 40) == 0
    assert f"done: split {first} 5 --new 40; solved again: {first} 40" in capsys.readouterr().out
    split = Reconstruction.load(folder)
    others = ~np.isin(people.person, [first])
    np.testing.assert_array_equal(
        split.joints[~np.isin(split.person, [first, 40])], people.joints[others]
    )  # to the last digit
    new = split.person == 40
    assert split.frame[new].tolist() == list(range(5, FRAMES))
    # Half as many frames on either side, the same views: a joint that is seen moves by millimetres.
    own = people.joints[(people.person == first) & (people.frame >= 5)]
    assert np.nanmedian(np.linalg.norm(split.joints[new] - own, axis=-1)) < 0.01
    assert run("tracks", folder, "undo") == 0
    assert (folder / "people.npz").read_bytes() == whole


def test_without_time_rows_do_not_depend_on_who_they_are(scene, people, tmp_path, capsys):
    run_json = people.run | {"configuration": people.run["configuration"] | {"temporal": False}}
    folder = saved(replace(people, run=run_json), scene, tmp_path / "results")
    first = int(people.person[0])
    assert run("tracks", folder, "split", first, 5) == 0
    assert "joints and bodies were not solved again" in capsys.readouterr().out
    relabelled = Reconstruction.load(folder).joints
    np.testing.assert_array_equal(np.sort(relabelled, axis=0), np.sort(people.joints, axis=0))


def test_a_result_without_its_cameras_changes_identities_only(people, tmp_path, capsys):
    replace(people, rig=None).save(tmp_path / "results")
    assert run("tracks", tmp_path / "results", "split", int(people.person[0]), 5) == 0
    assert "joints and bodies were not solved again" in capsys.readouterr().out


def test_the_setup_of_a_result(scene, people, tmp_path):
    folder = saved(people, scene, tmp_path / "results")
    loaded = Reconstruction.load(folder)
    solver = Solver.read(folder, loaded)
    assert solver.config == CONFIG
    np.testing.assert_allclose(solver.rig.cTw, scene.rig.cTw)
    offsets = solver.fitter.model.keypoint_offsets
    np.testing.assert_allclose(
        offsets.xyz_m, KeypointOffsets.from_dict(people.run["keypoint_offsets"]).xyz_m
    )
    assert (people.observations.gate == Gate.USED).any()
    write_rig(built_in_scene(cameras=5, frames=1).rig, folder / CAMERAS)
    with pytest.raises(
        InputError, match=r"cameras.json: the cameras are not those of observations.npz"
    ):
        Solver.read(folder, loaded)
    other = replace(loaded, run=loaded.run | {"configuration": {"speed": 3}})
    write_rig(scene.rig, folder / CAMERAS)
    with pytest.raises(
        InputError,
        match=r"run.json: speed is not a known key; it was written by another"
        r" version .* reconstruct",
    ):
        Solver.read(folder, other)
    with pytest.raises(InputError, match=r"run.json: configuration is missing"):
        Solver.read(folder, replace(loaded, run={}))


@pytest.mark.slow
def test_any_damaged_file_of_a_result_is_one_sentence(scene, people, tmp_path, capsys):
    """Bytes of each file changed at random, then listed and corrected: an answer, or one
    sentence.
    """
    rng, first = np.random.default_rng(0), int(people.person[0])
    folder = saved(people, scene, tmp_path / "results")
    assert run("tracks", folder, "rename", first, 30) == 0
    kept = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    refused = 0
    for name in ("run.json", "corrections.json", CAMERAS, "observations.npz", "people.npz"):
        for _ in range(4):
            for path, content in kept.items():
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(content)
            damaged = bytearray(kept[folder / name])
            place = int(rng.integers(len(damaged)))
            if rng.random() < 0.5:
                damaged[place] = int(rng.integers(256))
            else:
                del damaged[place : place + int(rng.integers(1, 30))]
            (folder / name).write_bytes(bytes(damaged))
            capsys.readouterr()
            for arguments in ((), ("drop", 30), ("undo",)):
                code = run("tracks", folder, *arguments)
                error = capsys.readouterr().err
                assert code in (0, 2) and error.count("\n") == (code == 2), error
                refused += code == 2
    assert refused > 15
