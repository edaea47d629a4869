"""One timeline for all formats: frames, times, rates, who is where, and results that have none."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.world_axes import opensim_axes, y_up, z_up
from shapepose_fg.io.export.registry import read_take
from shapepose_fg.io.export.take import Take

from .conftest import AWAY, FIRST, FPS, FRAMES, GUESSED


def test_everybody_has_a_place_in_every_frame(result):
    take = Take.of(result, "z")
    assert take.persons.tolist() == [3, 7]
    assert take.frames.tolist() == list(range(FIRST, FIRST + FRAMES))
    assert take.fps == FPS
    assert (take.rows[0] >= 0).all()
    assert take.frames[take.rows[1] < 0].tolist() == list(AWAY)
    joints = take.column("joints", 1)
    assert np.isnan(joints[AWAY.start - FIRST]).all()
    np.testing.assert_array_equal(
        joints[0], result.at(FIRST).rows(result.at(FIRST).person == 7).joints[0]
    )


def test_frames_without_anybody_have_a_time(result):
    people = result.rows(result.frame != FIRST + 5).with_run(frames=[FIRST - 2, FIRST + FRAMES + 3])
    take = Take.of(people, "z")
    assert take.frames[0] == FIRST - 2 and len(take.frames) == FRAMES + 5
    np.testing.assert_allclose(take.times_s, take.frames / FPS, atol=1e-9)


def test_dropped_frames_are_holes_at_one_rate(result):
    """Frames 110 to 114 were taken a step later than they would be: at one rate a frame is
    missing.
    """
    late = replace(result, time_s=result.time_s + np.where(result.frame >= 110, 1 / FPS, 0))
    take, lost = Take.of(late, "z").at_one_rate()
    assert lost == 0
    assert len(take.frames) == FRAMES + 1
    assert (take.rows[:, 10] < 0).all() and (take.rows[0, 11:] >= 0).all()
    np.testing.assert_allclose(np.diff(take.times_s), 1 / FPS)


def test_frames_nearer_than_a_step_are_counted(result):
    """Person 3 alone; the frames after 120 come twice as fast: of four, two have a step of their
    own.
    """
    alone = result.rows(result.person == 3)
    fast = replace(
        alone,
        time_s=np.where(
            alone.frame > 119, 119 / FPS + (alone.frame - 119) / (2 * FPS), alone.time_s
        ),
    )
    take, lost = Take.of(fast, "z").at_one_rate()
    assert lost == 2
    assert len(take.frames) == FRAMES - 2


def test_times_in_another_unit_are_refused(result):
    odd = replace(result, time_s=np.where(result.frame > 120, result.time_s + 1e9, result.time_s))
    with pytest.raises(ValueError, match="give --fps, or a part with --frames"):
        Take.of(odd, "z").at_one_rate()


def test_seen_only_leaves_inferred_joints_out(result):
    take = Take.of(result, "z", seen_only=True)
    wrist = BODY_25.index(GUESSED[1])
    assert np.isnan(take.column("joints", 0)[:, wrist]).all()
    assert np.isnan(take.column("covariance", 0)[:, wrist]).all()
    assert np.isfinite(take.column("joints", 0)[:, wrist - 1]).all()
    unseen = replace(
        result, known=np.where(result.frame[:, None] == 110, Known.MOTION, result.known)
    )
    bodies = Take.of(unseen, "z", seen_only=True).column("betas", 0)
    assert np.isnan(bodies[110 - FIRST]).all() and np.isfinite(bodies[111 - FIRST]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"run": {"configuration": {"temporal": False}}}, "this result is frame by frame"),
        ({"person": "same"}, "has two rows of frame 100"),
        ({"time_s": "unknown"}, "give --fps"),
        ({"time_s": "falling"}, "does not increase"),
    ],
)
def test_a_result_without_a_timeline_is_refused(result, change, words):
    columns = {
        "same": np.full(len(result), 3),
        "unknown": np.full(len(result), np.nan),
        "falling": -result.time_s,
    }
    change = {
        name: columns[value] if isinstance(value, str) else value for name, value in change.items()
    }
    with pytest.raises(ValueError, match=words):
        Take.of(replace(result, observations=None, **change), "z")


def test_old_files_do_not_say_what_was_seen(result):
    old = replace(result, known=np.full_like(result.known, Known.UNKNOWN))
    with pytest.raises(ValueError, match="leave out --seen-only"):
        Take.of(old, "z", seen_only=True)


def test_nobody_is_nothing_to_export():
    with pytest.raises(ValueError, match="the result has no people"):
        Take.of(Reconstruction.empty(), "z")


def test_the_up_axis_comes_from_the_cameras_or_is_asked_for(saved, result, tmp_path):
    assert read_take(saved).up == "z"
    assert read_take(saved, up="-y").up == "-y"
    result.save(tmp_path)
    with pytest.raises(
        InputError,
        match=r"cameras\.json: this file is missing, and it contains the up axis; give --up",
    ):
        read_take(tmp_path)


def test_people_and_frames_can_be_chosen(saved):
    take = read_take(saved, frames=range(110, 120), persons=(7,))
    assert take.persons.tolist() == [7]
    assert take.frames.tolist() == list(range(110, 120))
    with pytest.raises(InputError, match=r"--person 5: .* it has 3 7"):
        read_take(saved, persons=(5,))
    for frames, persons in ((range(1000, 1100), None), (range(AWAY.start, AWAY.stop), (7,))):
        with pytest.raises(
            InputError,
            match=r"--frames: .* no people in these frames; people are in frames 100 to 123",
        ):
            read_take(saved, frames=frames, persons=persons)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_up_is_up_in_every_format(up):
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    for turn, goal in ((y_up(up), (0, 1, 0)), (opensim_axes(up), (0, 1, 0)), (z_up(up), (0, 0, 1))):
        assert (turn @ axis).tolist() == list(goal)
        assert np.linalg.det(turn) == pytest.approx(1)
        np.testing.assert_array_equal(turn @ turn.T, np.eye(3))


def test_z_up_is_what_others_make_of_it():
    assert (opensim_axes("z") @ (1, 2, 3)).tolist() == [2, 3, 1]  # Pose2Sim: X->Y, Y->Z, Z->X
    assert (y_up("z") @ (1, 2, 3)).tolist() == [1, 3, -2]  # Blender turns it back by (x, -z, y)
    assert (z_up("z") @ (1, 2, 3)).tolist() == [1, 2, 3]
