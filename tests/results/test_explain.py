"""Joints that were spoiled on purpose: `explain` names what was done, and says nothing of those
that were not.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg import InputError, explain, reconstruct, write_rig
from shapepose_fg.cameras.check.report import check_setup
from shapepose_fg.cli.main import main
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.results.explanation import Cause, Explanation
from shapepose_fg.results.solve_again import Solver, solve_rows
from shapepose_fg.simulation import built_in_scene, simulate

ELBOW, SPOILED = 6, range(3, 8)
"""LElbow, and the frames in which its detections are changed."""


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=3, cameras=4, frames=12, seed=3)


@pytest.fixture(scope="module")
def people(scene) -> Reconstruction:
    return reconstruct(simulate(scene, seed=3), scene.rig)


def solved(people: Reconstruction, rig, **columns) -> Reconstruction:
    """The rows solved from other detections, or before other cameras."""
    assert people.observations is not None
    table = replace(people.observations, **columns)
    return solve_rows(replace(people, observations=table), Solver.of(people, rig))


def seen_by_many(people: Reconstruction, frame: int = 5) -> tuple[int, int, np.ndarray]:
    """A person whose elbow most cameras use in a frame: number, row, cameras."""
    assert people.observations is not None
    used = people.observations.used[:, ELBOW].sum(axis=-1) * (people.frame == frame)
    row = int(used.argmax())
    return int(people.person[row]), row, np.flatnonzero(people.observations.used[row, ELBOW])


def rows_of(people: Reconstruction, person: int) -> np.ndarray:
    return np.flatnonzero((people.person == person) & np.isin(people.frame, SPOILED))


def without(table: ObservationTable, rows: np.ndarray, views: list[int]) -> dict[str, np.ndarray]:
    """Columns of a table in which some views have not seen the elbow."""
    empty = {
        "xy": np.nan,
        "residual_px": np.nan,
        "gate": 0,
        "candidate": -1,
        "confidence": 0,
        "probability": 0,
    }
    columns = {name: getattr(table, name).copy() for name in empty}
    for name, nothing in empty.items():
        columns[name][rows[:, None], ELBOW, np.array(views)] = nothing
    return columns


def asked(people: Reconstruction, rig, person: int) -> Explanation:
    return explain(people, rig, person=person, joint="LElbow", frame=5)


def first(found: Explanation) -> tuple[Cause, tuple[str, ...]]:
    return found.findings[0].cause, found.findings[0].cameras


def test_nothing_is_the_matter(people, scene):
    person, _, cameras = seen_by_many(people)
    found = asked(people, scene.rig, person)
    assert found.findings == ()
    assert [view.gate for view in found.views].count("used") == len(cameras)
    whole = sum(view.share for view in found.views) + found.body_share + found.motion_share
    assert whole == pytest.approx(1, abs=1e-9)
    assert all(view.off_sigma < 3 for view in found.views if view.off_sigma is not None)


@pytest.mark.slow
def test_no_view_and_one_view(people, scene):
    person, _, cameras = seen_by_many(people)
    rows = rows_of(people, person)
    nobody = asked(
        solved(people, scene.rig, **without(people.observations, rows, [0, 1, 2, 3])),
        scene.rig,
        person,
    )
    assert first(nobody) == (Cause.PRIOR_ONLY, ())
    assert nobody.body_share + nobody.motion_share == pytest.approx(1, abs=1e-9)
    others = [view for view in range(4) if view != cameras[0]]
    one = asked(
        solved(people, scene.rig, **without(people.observations, rows, others)), scene.rig, person
    )
    assert first(one) == (Cause.ONE_VIEW, (scene.rig.names[cameras[0]],))


@pytest.mark.slow
def test_a_detection_where_nobody_is(people, scene):
    """Half a metre off, straight up in the picture."""
    person, _, cameras = seen_by_many(people)
    xy = people.observations.xy.copy()
    xy[rows_of(people, person), ELBOW, cameras[0], 1] -= 150
    found = asked(solved(people, scene.rig, xy=xy), scene.rig, person)
    assert first(found) == (Cause.GATED, (scene.rig.names[cameras[0]],))
    assert found.views[cameras[0]].off_px == pytest.approx(150, rel=0.2)
    assert found.views[cameras[0]].share == 0


@pytest.mark.slow
def test_somebody_elses_detection(people, scene):
    person, _, cameras = seen_by_many(people)
    table, view = people.observations, None
    for other in np.flatnonzero((people.frame == 5) & (people.person != person)):
        common = np.intersect1d(cameras, np.flatnonzero(table.used[other, ELBOW]))
        if len(common):
            view, name = int(common[0]), int(people.person[other])
    assert view is not None
    theirs = np.flatnonzero((people.person == name) & np.isin(people.frame, SPOILED))
    columns = without(table, theirs, [view])
    for mine in rows_of(people, person):
        same = theirs[people.frame[theirs] == people.frame[mine]]
        if len(same) and table.gate[same[0], ELBOW, view] and table.gate[mine, ELBOW, view]:
            columns["xy"][mine, ELBOW, view] = table.xy[same[0], ELBOW, view]
    found = asked(solved(people, scene.rig, **columns), scene.rig, person)
    assert first(found) == (Cause.FOREIGN, (scene.rig.names[view],))
    assert found.views[view].looks_like == f"person {name}'s LElbow"


@pytest.mark.slow
def test_detections_that_were_not_taken_are_named_where_the_recording_is_given(people, scene):
    """Spoiled before anybody is sought: in one camera an elbow is half a metre up, in another it is
    missed, and the detector joins somebody else's with the arm. Neither is given to the person.
    """
    person, row, cameras = seen_by_many(people)
    table, recording = people.observations, simulate(scene, seed=3)
    away, taken = int(cameras[0]), None
    for other in np.flatnonzero((people.frame == 5) & (people.person != person)):
        for view in cameras[1:].tolist():
            if table.used[other, ELBOW, view]:
                taken, name = view, int(people.person[other])
    assert taken is not None
    frames = [recording[t] for t in range(len(recording))]
    for mine in rows_of(people, person):
        frame, theirs = (
            int(people.frame[mine]),
            (people.person == name) & (people.frame == people.frame[mine]),
        )
        seen = replace(frames[frame], xy=frames[frame].xy.copy(), pairs=frames[frame].pairs.copy())
        of = table.candidate[[mine, *np.flatnonzero(theirs)]][:, ELBOW]
        up = np.flatnonzero((seen.view == away) & (seen.place == of[0, away]))
        seen.xy[up, 1] -= 150
        lost, joined = (
            np.flatnonzero((seen.view == taken) & (seen.place == each)) for each in of[:, taken]
        )
        if len(lost) and len(joined):
            ends = seen.pairs
            seen.affinity[(ends == joined[0]).any(axis=1)] = 0.0
            ends[ends == lost[0]] = joined[0]
            seen = seen.only(np.arange(len(seen)) != lost[0])
        frames[frame] = seen
    spoiled = Recording(BODY_25, frames)
    found = reconstruct(spoiled, scene.rig)
    at = people.joints[row]
    near = np.linalg.norm(found.joints - at, axis=-1).mean(axis=1) + 10 * (found.frame != 5)
    who = int(found.person[near.argmin()])
    done = {(Cause.GATED, scene.rig.names[away]), (Cause.FOREIGN, scene.rig.names[taken])}
    told = explain(found, scene.rig, person=who, joint="LElbow", frame=5, detections=spoiled)
    assert done <= {(each.cause, *each.cameras[:1]) for each in told.findings}
    # Of what was given to them neither is seen.
    assert not done & {
        (each.cause, *each.cameras[:1]) for each in asked(found, scene.rig, who).findings
    }
    untouched = explain(
        people, scene.rig, person=person, joint="LElbow", frame=5, detections=recording
    )
    assert not done & {(each.cause, *each.cameras[:1]) for each in untouched.findings}


@pytest.mark.slow
def test_views_that_the_body_contradicts(people, scene):
    """All views put the elbow 60 cm above itself."""
    person, _, cameras = seen_by_many(people)
    rows, xy = rows_of(people, person), people.observations.xy.copy()
    up = np.array([0.0, 0.0, 0.6])
    for row in rows:
        moved = (
            scene.rig.project(people.joints[row, ELBOW] + up)[0]
            - scene.rig.project(people.joints[row, ELBOW])[0]
        )
        xy[row, ELBOW] += moved
    found = asked(solved(people, scene.rig, xy=xy), scene.rig, person)
    cause, named = first(found)
    assert cause == Cause.CONTRADICTION
    assert set(named) == {scene.rig.names[view] for view in cameras}
    assert {found.views[view].gate for view in cameras} == {_gate(Gate.CONTRADICTS_BODY)}


def _gate(gate: Gate) -> str:
    return gate.name.lower().replace("_", " ")


def with_turned(rig, view: int, degrees: float):
    """The rig with a camera turned to the side."""
    cameras = list(rig.cameras)
    wTc = cameras[view].wTc.copy()
    wTc[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    cameras[view] = replace(cameras[view], wTc=wTc)
    return replace(rig, cameras=tuple(cameras))


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [2.0, 4.0])
def test_a_camera_that_was_turned(scene, degrees):
    """The set-up check finds it, in 12 frames; by 4 degrees hardly anything of it was used."""
    rig, recording = with_turned(scene.rig, 3, degrees), simulate(scene, seed=3)
    report = check_setup(recording, rig)
    found = reconstruct(recording, rig).with_run(setup=report.as_dict())
    person, _, _ = seen_by_many(found)
    told = explain(found, rig, person=person, joint="LElbow", frame=5, detections=recording)
    assert first(told) == (Cause.WRONG_CAMERA, (rig.names[3],))
    assert report.warnings[0] in told.words[1]
    # Without what the check found it is not known; no other camera is accused.
    unknown = asked(found.with_run(setup={}), rig, person)
    assert all(each.cause != Cause.WRONG_CAMERA for each in unknown.findings)


def test_what_the_set_up_check_left_out_is_said(people, scene):
    """In the frames that it says, and no others."""
    person, _, _ = seen_by_many(people)
    name, spell = scene.rig.names[2], {"camera": scene.rig.names[2], "frames": [3, 6]}
    findings = [{"kind": "turned", "cameras": [name], "says": "it looks turned"}]
    left_out = people.with_run(setup={"findings": findings, "left_out": [spell], "doubted": []})
    told = asked(left_out, scene.rig, person)
    assert first(told) == (Cause.WRONG_CAMERA, (name,))
    assert "it looks turned" in told.words[1]
    later = explain(left_out, scene.rig, person=person, joint="LElbow", frame=6)
    assert all(each.cause != Cause.WRONG_CAMERA for each in later.findings)
    doubted = people.with_run(setup={"findings": findings, "left_out": [], "doubted": [spell]})
    assert first(asked(doubted, scene.rig, person)) == (Cause.CONTRADICTION, (name,))


@pytest.mark.slow
def test_the_command_says_the_same(people, scene, tmp_path, capsys):
    people.save(tmp_path)
    write_rig(scene.rig, tmp_path / CAMERAS)
    person, _, _ = seen_by_many(people)
    with pytest.raises(SystemExit) as ended:
        main(["explain", str(tmp_path), str(person), "LElbow", "--frame", "5", "--json"])
    assert ended.value.code == 0
    told, found = json.loads(capsys.readouterr().out), asked(people, scene.rig, person)
    assert told["position_m"] == pytest.approx(found.position_m, abs=1e-6)
    assert [view["gate"] for view in told["views"]] == [view.gate for view in found.views]
    with pytest.raises(SystemExit):
        main(["explain", str(tmp_path), str(person), "LElbow", "--time", str(5 / 30)])
    screen = capsys.readouterr().out
    assert "LElbow of person" in screen
    assert "cameras agree on it" in screen


def test_who_is_not_there_is_said(people, scene):
    with pytest.raises(InputError, match="person 77: not in the result"):
        explain(people, scene.rig, person=77, joint="LElbow", frame=5)
    nobody = replace(people.rows(slice(0, 0)), observations=None)
    with pytest.raises(InputError, match="person 0: not in the result; there are none"):
        explain(nobody, scene.rig, person=0, joint="LElbow", frame=5)
    with pytest.raises(InputError, match="joint Tail: the result has no joint of this name"):
        explain(
            people,
            scene.rig,
            person=int(people.person[0]),
            joint="Tail",
            frame=int(people.frame[0]),
        )
    with pytest.raises(InputError, match="is not in frame 99"):
        explain(people, scene.rig, person=int(people.person[0]), joint="LElbow", frame=99)


@pytest.mark.parametrize(
    ("words", "change"),
    {
        "time_s must increase": lambda people: replace(people, time_s=np.zeros(len(people))),
        "does not at person": lambda people: replace(people, time_s=np.full(len(people), np.nan)),
        "occurs twice in frame": lambda people: with_both(people, frame=np.full(len(people), 5)),
        "persons must be at most": lambda people: with_both(people, person=people.person + 10**6),
        "people.problems must be": lambda people: people.with_run(people={"problems": 3}),
        r"people.problems\[0\].frame must be": lambda people: people.with_run(
            people={"problems": [{"person": 0, "frame": "5", "joint": "LElbow", "reason": "odd"}]}
        ),
        "setup.left_out": lambda people: people.with_run(
            setup={"left_out": [{"camera": {}, "frames": [0, 9]}]}
        ),
        "extra_factors must be": lambda people: people.with_run(extra_factors=[1]),
        "cameras are not those of": lambda people: replace(
            people,
            observations=replace(
                people.observations, view_names=people.observations.view_names[::-1]
            ),
        ),
    }.items(),
)
def test_files_that_were_changed_are_refused_in_one_sentence(people, scene, words, change):
    tampered = change(people)
    with pytest.raises(InputError, match=words):
        explain(tampered, scene.rig, person=int(tampered.person[0]), joint="LElbow", frame=5)


def with_both(people: Reconstruction, **columns) -> Reconstruction:
    """The rows with other identities or frames, what they were solved from included."""
    assert people.observations is not None
    return replace(people, observations=replace(people.observations, **columns), **columns)
