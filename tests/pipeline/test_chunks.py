"""Chunks of a recording, reconstructed side by side: the same people, the same joints, the same
names.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyParameters
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.kept_arrays import InFolder, InMemory
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, Task, reconstruct, reconstruct_parts
from shapepose_fg.pipeline.runs import chunks
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.chunks import (
    Border,
    Chunk,
    Identities,
    cut_in_chunks,
    same_people,
    windows_of,
)
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.solved_windows import solve_chunk
from shapepose_fg.pipeline.windows import Engine, WindowConfig
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.tracking.identities import FollowingConfig
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import BodyScale, TrackingConfig, Tracks
from tests.marks import slow

CONFIG = PipelineConfig(
    batch_frames=12,
    following=FollowingConfig(look_ahead_s=0.3),
    windows=WindowConfig(overlap_s=0.16),
)
CUTS = (30,)


@pytest.fixture(scope="module", autouse=True)
def short_warm_up():
    """Chunks of a second deserve less than six to warm up."""
    before, chunks.WARM_S = chunks.WARM_S, 0.5
    yield
    chunks.WARM_S = before


@pytest.fixture(scope="module")
def scene():
    """Two people before four cameras, 54 frames with a cut after 30."""
    return built_in_scene(seed=3, people=2, cameras=4, frames=54)


@pytest.fixture(scope="module")
def recording(scene):
    return simulate(scene, seed=3)


@pytest.fixture(scope="module")
def times(scene):
    return FrameTimes.from_fps(scene.fps, len(scene))


@pytest.fixture(scope="module")
def assembly(scene, recording, times) -> Assembly:
    return reconstruct_parts(InMemory(), Task(recording, scene.rig, CONFIG, times=times, cuts=CUTS))


@pytest.fixture(scope="module")
def whole(assembly) -> Reconstruction:
    """Four windows."""
    return assembly.reconstruction()


@pytest.fixture(scope="module")
def in_chunks(scene, recording, times):
    return reconstruct(
        recording, scene.rig, CONFIG, times=times, cuts=CUTS, execution=Execution(chunk_frames=12)
    )


@pytest.mark.slow
def test_every_row_is_of_its_frame_and_its_person(scene, whole):
    """In a run of several windows: where somebody is when, how fast, with which body, from which
    detections.
    """
    assert np.bincount(whole.frame).tolist() == [2] * 54
    assert np.lexsort((whole.person, whole.frame)).tolist() == list(range(len(whole)))
    np.testing.assert_allclose(whole.time_s, whole.frame / scene.fps, atol=1e-9)
    places, speeds = scene.keypoints, np.gradient(scene.keypoints, 1 / scene.fps, axis=0)
    apart = np.linalg.norm(whole.joints[:, None] - places[whole.frame], axis=-1)
    who = apart.mean(axis=-1).argmin(axis=1)
    assert (
        len(
            set(zip(whole.person.tolist(), who.tolist(), (whole.frame >= 30).tolist(), strict=True))
        )
        == 4
    )
    truth, speed, seen = (
        places[whole.frame, who],
        speeds[whole.frame, who],
        whole.known == Known.SEEN,
    )
    error = whole.joints - truth
    assert np.median(np.linalg.norm(error, axis=-1)[seen]) < 0.03
    assert np.median(np.linalg.norm(whole.velocity - speed, axis=-1)[seen]) < 0.25
    squared = np.einsum("nji,njik,njk->nj", error, np.linalg.inv(whole.covariance), error)
    assert (
        0.75 < (squared[seen] < 7.81).mean() <= 1
    )  # of a Gaussian 95 %; two people whose errors last
    columns = (whole.betas, whole.global_orient, whole.body_pose, whole.transl)
    body = scene.body.keypoints(BodyParameters(*columns))
    moving = seen & (np.linalg.norm(speed, axis=-1) > 0.5)
    for track in np.unique(whole.person):
        mine = np.flatnonzero(whole.person == track)
        for other in (truth, body):
            late = {
                step: np.linalg.norm(
                    whole.joints[mine] - np.roll(other[mine], step, axis=0), axis=-1
                )[2:-2]
                for step in (-1, 0, 1)
            }
            late = {step: each[moving[mine][2:-2]].mean() for step, each in late.items()}
            assert min(late, key=late.__getitem__) == 0, (
                "nearest to the truth and the body of its own frame"
            )
    projected = np.moveaxis(scene.rig.project(whole.joints)[0], 0, 2)
    table = whole.observations
    residual = (projected - table.xy)[table.used]
    np.testing.assert_allclose(table.residual_px[table.used], residual, atol=1e-2)
    assert np.median(np.linalg.norm(residual, axis=-1)) < 8


@pytest.mark.slow
def test_a_person_s_rows_are_read_from_all_windows(assembly, whole):
    for number in assembly.parts_of:
        mine = whole.person == number
        for name in ("time_s", "joints", "covariance"):
            found = np.concatenate([piece for (piece,) in assembly.own_pieces(number, (name,))])
            np.testing.assert_array_equal(found, getattr(whole, name)[mine])
    first, last = min(assembly.parts_of), max(assembly.parts_of)
    named = replace(assembly, names={first: 40, last: first}, shapes=None).reconstruction()
    expected = np.where(
        whole.person == first, 40, np.where(whole.person == last, first, whole.person)
    )
    np.testing.assert_array_equal(named.person, expected)
    np.testing.assert_array_equal(named.observations.person, expected)
    thinned = assembly.reconstruction(every=5)
    expected = whole.rows(whole.frame % 5 == 0)
    for name in whole.ROWS:
        np.testing.assert_array_equal(getattr(thinned, name), getattr(expected, name), err_msg=name)


@pytest.mark.slow
def test_chunks_change_neither_people_nor_names(whole, in_chunks):
    assert np.array_equal(in_chunks.frame, whole.frame)
    pairs = set(zip(whole.person.tolist(), in_chunks.person.tolist(), strict=True))
    assert len(pairs) == len(np.unique(whole.person)) == len(np.unique(in_chunks.person))
    # The same windows and detections. Only where tracks expected joints differs, after half a
    # second of warm-up, and that is where joints start that no two views see.
    apart = np.abs(in_chunks.joints - whole.joints)
    assert apart.max() < 2e-3 and apart.mean() < 1e-5
    one, other = (
        {e["person"]: e["evidence"] for e in each.run["probability"]} for each in (whole, in_chunks)
    )
    assert one.keys() == {name for name, _ in pairs}
    assert len(set(one.values())) == 4, "everybody's own"
    for name, in_chunk in pairs:
        assert one[name] == pytest.approx(other[in_chunk], abs=2e-3)


@pytest.mark.slow
def test_processes_change_no_byte_of_it(scene, recording, times, in_chunks):
    found = reconstruct(
        recording,
        scene.rig,
        CONFIG,
        times=times,
        cuts=CUTS,
        execution=Execution(chunk_frames=12, workers=2),
    )
    for name in found.ROWS:
        equal_nan = name != "status"
        assert np.array_equal(
            getattr(found, name), getattr(in_chunks, name), equal_nan=equal_nan
        ), name


@pytest.mark.slow
def test_a_run_in_chunks_that_was_stopped_goes_on(scene, recording, times, in_chunks, tmp_path):
    def stop(done: int, _: int) -> None:
        if done >= 20:
            raise Stopped(15)

    task = Task(recording, scene.rig, CONFIG, times=times, cuts=CUTS)
    with pytest.raises(Stopped):
        reconstruct_parts(InFolder(tmp_path), task, Execution(chunk_frames=12, progress=stop))
    done: list[int] = []
    execution = Execution(chunk_frames=12, progress=lambda n, _: done.append(n))
    found = reconstruct_parts(InFolder(tmp_path), task, execution).reconstruction()
    assert done[0] > 20
    for name in ("joints", "covariance", "person", "body_pose", "frame"):
        equal_nan = name not in ("person", "frame")
        assert np.array_equal(
            getattr(found, name), getattr(in_chunks, name), equal_nan=equal_nan
        ), name


def test_every_frame_is_in_one_chunk_whose_borders_are_those_of_windows():
    times = FrameTimes.from_fps(25.0, 1000)
    config = replace(CONFIG, batch_frames=20)
    found = cut_in_chunks(range(10, 1000), (333,), times.frame_s, config, 100)
    frames = [frame for chunk in found for frame in chunk.own]
    assert frames == list(range(10, 1000))
    for chunk in found:
        start = 10 if chunk.own.start < 333 else 333
        assert (chunk.own.start - start) % 20 == 0 and (chunk.first - start) % 20 == 0
        assert chunk.first >= start and chunk.until <= (333 if chunk.own.stop <= 333 else 1000)
        assert chunk.until >= chunk.own.stop
        assert chunk.ended == (chunk.until in (333, 1000))


@dataclass(frozen=True)
class NobodyIsThere:
    """A tracker that finds nobody, and so is quick."""

    skeleton = BODY_25
    scale = BodyScale(np.ones(25), np.ones(25))
    config = TrackingConfig()

    def nobody(self) -> Tracks:
        """Tracks of no people."""
        return Tracks.none(BODY_25)

    def search(self, frame: int) -> None:
        """Nowhere."""

    def newcomers(self, *_: object) -> tuple[np.ndarray, np.ndarray]:
        """Nobody."""
        return np.zeros((0, 25, 3)), np.zeros((0, 25, 1), dtype=np.intp)

    def ahead(self, tracks: Tracks, _: float) -> JointStates:
        """Where they are."""
        return tracks.joints


@pytest.mark.parametrize(
    ("batch", "views", "fps"),
    [
        (12, 3, 3.0),
        *slow((12, 6, 60.0), (1, 3, 50.0)),
    ],
)
def test_every_chunk_gives_its_own_frames_and_whole_windows(fps, views, batch):
    """Times of views are rounded when their mean is taken: 0.4 s or 1 s are a frame more or less
    then.
    """
    config = PipelineConfig(batch_frames=batch)
    times = FrameTimes.from_fps(fps, 200)
    of_views = times.of_views(views)

    def read(frame: int) -> Input:
        return Input(frame, of_views[frame], Detections.empty(), range(views))  # type: ignore[arg-type]

    def spans(chunk: Chunk) -> list[tuple[list[int], int, int]]:
        engine = Engine(NobodyIsThere(), config)  # type: ignore[arg-type]
        found = windows_of(engine, chunk, read)
        return [
            ([given.frame for given, _ in span.decided], span.start, span.stop) for span in found
        ]

    whole = [
        (frames, start, stop)
        for stretch in (range(170), range(170, 200))
        for frames, start, stop in spans(Chunk(stretch, stretch.start, stretch.stop, ended=True))
    ]
    pieces = []
    for chunk in cut_in_chunks(range(200), (170,), times.frame_s, config, max(24, 2 * batch)):
        found = spans(chunk)
        own = [frame for frames, start, stop in found for frame in frames[start:stop]]
        assert own == list(chunk.own), chunk
        pieces += found
    # The frames that a chunk's first window overlaps are those of the windows without chunks, too.
    assert pieces == whole


def test_windows_take_the_frames_that_overlap_them():
    """By default 0.4 s on either side: nine frames of 24 a second; the last takes what is left."""
    times = FrameTimes.from_fps(24.0, 70).of_views(3)
    engine = Engine(NobodyIsThere(), PipelineConfig(batch_frames=20))  # type: ignore[arg-type]
    given = [Input(frame, times[frame], Detections.empty(), range(3)) for frame in range(70)]  # type: ignore[arg-type]
    spans, _ = engine.follow(engine.start(), given, last=True)
    own, taken = [], []
    for span in spans:
        frames = [each.frame for each, _ in span.decided]
        own.append((frames[span.start], frames[span.stop - 1]))
        taken.append((frames[0], frames[-1]))
        assert frames == list(range(frames[0], frames[-1] + 1))
    assert own == [(0, 19), (20, 39), (40, 69)]
    assert taken == [(0, 29), (11, 49), (31, 69)]


def test_a_chunk_without_its_frames_is_an_error_and_no_gap(scene, recording):
    setup = Setup(scene.rig, recording.skeleton, CONFIG, make_fitter(CONFIG.body))
    given = tuple(Input(n, np.full(4, n / 25), Detections.empty(), scene.rig) for n in range(16))
    short = Chunk(range(0, 12), 0, 16, ended=False)  # half a window and 0.3 s more are needed
    with pytest.raises(
        RuntimeError, match=r"0 frames were solved in the windows of the chunk range\(0, 12\)"
    ):
        solve_chunk(setup, (short, given))


def border(track, candidate, place):
    """Rows of one frame with one joint and one view."""
    n = len(track)
    return Border(
        np.zeros(n, int),
        np.array(track),
        np.array(candidate).reshape(n, 1, 1),
        np.array(place).reshape(n, 1, 3),
    )


def test_who_is_who_by_detections_and_out_of_sight_by_place():
    before = border([0, 1, 2], [7, 8, -1], [[0, 0, 0], [9, 0, 0], [5, 0, 0.0]])
    after = border(
        [10, 11, 12, 13], [8, 7, -1, -1], [[0, 0, 0], [9, 0, 0], [5.1, 0, 0], [5.0, 2, 0.0]]
    )
    assert same_people(before, after) == {10: 1, 11: 0, 12: 2}


def test_strangers_on_both_sides_of_a_border_stay_strangers():
    """Other detections; out of sight in other places, or who knows where; one who is seen and one
    who is not.
    """
    nowhere = [np.nan] * 3
    for before, after in (
        (([7], [[0, 0, 0.0]]), ([9], [[0, 0, 0.0]])),
        (([-1], [[0, 0, 0.0]]), ([-1], [[0.4, 0, 0]])),
        (([-1], [nowhere]), ([-1], [nowhere])),
        (([7], [[0, 0, 0.0]]), ([-1], [[2, 0, 0.0]])),
    ):
        assert same_people(border([0], *before), border([10], *after)) == {}
    # One of two goes on; the other's place is taken by nobody.
    two, one = border([0, 1], [7, 8], [[0, 0, 0], [9, 0, 0.0]]), border([10], [8], [[9, 0, 0.0]])
    assert same_people(two, one) == {10: 1} and same_people(one, two) == {1: 10}


def test_identities_go_on_from_chunk_to_chunk():
    places = [[0, 0, 0], [9, 0, 0.0]]
    identities = Identities(5, border([3, 4], [7, 8], places))
    names = identities.names(border([0, 1], [8, 6], places[::-1]), isolated=False)
    assert [identities.name(track, names) for track in (0, 1)] == [4, 5]  # one goes on, one is new
    identities.remember(border([1, 0], [6, 8], places), names)
    names = identities.names(border([0, 1], [6, 8], places), isolated=False)
    assert [identities.name(track, names) for track in (0, 1)] == [5, 4]
    names = identities.names(border([0], [6], [[0, 0, 0.0]]), isolated=True)
    assert identities.name(0, names) == 6


def test_chunks_shorter_than_a_window_are_refused(scene, recording):
    with pytest.raises(ValueError, match="chunk_frames must be at least batch_frames"):
        reconstruct(recording, scene.rig, CONFIG, execution=Execution(chunk_frames=3))
