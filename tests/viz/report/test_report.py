"""report.html as text: what it says, that nothing can be smuggled into it, and how large it may
be.
"""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.model.result_body import model_of
from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.viz.report.figures import angle_curves, camera_figures, known_counts
from shapepose_fg.viz.report.writing import report_of, write_report
from tests.io.export.conftest import AWAY, FIRST, FPS, FRAMES, GUESSED, LOST

from .conftest import HOSTILE


class Page(HTMLParser):
    """What a browser makes of a page, as far as it matters here."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[str | None, str]] = []
        self.words: list[str] = []
        self.source = file.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs).get("type"), ""))

    def handle_data(self, data):
        last = self.tags[-1][0] if self.tags else ""
        if last == "script" and self.scripts and self.scripts[-1][1] == "":
            self.scripts[-1] = (self.scripts[-1][0], data)
        elif last != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())

    @property
    def scene(self) -> dict:
        return json.loads(next(text for kind, text in self.scripts if kind == "application/json"))


def array(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def assert_closed(page: Page) -> None:
    """Nothing is fetched, and no script runs but the page's own."""
    attributes = [(tag, name, value) for tag, each in page.tags for name, value in each.items()]
    assert not [
        each
        for each in attributes
        if each[1] in ("src", "action", "data") or each[1].startswith("on")
    ]
    assert all((value or "").startswith("#") for _, name, value in attributes if name == "href")
    assert "url(" not in page.source and "@import" not in page.source
    policy = next(each["content"] or "" for tag, each in page.tags if "http-equiv" in each)
    assert "default-src 'none'" in policy
    own = [text for kind, text in page.scripts if kind is None]
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in own]
    assert re.findall(r"'sha256-([^']+)'", policy) == hashes
    assert "unsafe" not in policy.replace("style-src 'unsafe-inline'", "")


def test_a_page_needs_nothing_but_itself(page):
    assert_closed(Page(page))


def test_names_stay_names(hostile_page, page):
    hostile, tame = Page(hostile_page), Page(page)
    assert_closed(hostile)
    assert not [tag for tag, _ in hostile.tags if tag == "img"]
    # The same scripts run, and names are read as they were written.
    assert [text for kind, text in hostile.scripts if kind is None] == [
        text for kind, text in tame.scripts if kind is None
    ]
    assert hostile.scene["cameras"][0]["name"] == HOSTILE
    assert hostile.text.count("document.title='taken'") >= 2 * 8


def test_the_scene_holds_every_joint_to_a_millimetre(page, result):
    scene = Page(page).scene
    starts, who = array(scene["starts"], "<i4"), array(scene["who"], "<u2")
    frames = np.repeat(array(scene["frames"], "<i4"), np.diff(starts))
    people = np.array([each["id"] for each in scene["people"]])[who]
    assert frames.tolist() == sorted(frames)
    packed = array(scene["joints"], "<i2").reshape(-1, 25, 3)
    # World coordinates: the scene's z is up, so the page's axes are the world's.
    joints = np.where(packed == -32768, np.nan, scene["origin"] + scene["unit"] * packed)
    known = array(scene["known"], "u1").reshape(-1, 25)
    order = np.lexsort((result.person, result.frame))
    assert (frames - result.frame[order] == 0).all() and (people == result.person[order]).all()
    # Half a millimetre in each coordinate.
    np.testing.assert_allclose(joints, result.joints[order], atol=0.51e-3)
    assert (known & 3 == result.known[order]).all()
    sigma = np.sqrt(np.trace(result.covariance[order], axis1=2, axis2=3) / 3)
    level = np.where(known >> 2 > 0, 1e-3 * 2 ** (((known >> 2) - 1.0) / 8), np.nan)
    # Eight levels to a doubling: half a level is 4.4 %.
    np.testing.assert_allclose(level, sigma, rtol=0.045)
    assert not ((people == 7) & np.isin(frames, AWAY)).any()
    lost = (people == LOST[1]) & (frames == LOST[0])
    assert np.isnan(joints[lost, BODY_25.index(LOST[2])]).all()
    np.testing.assert_allclose(array(scene["times"], "<f4"), np.arange(FRAMES) / FPS, atol=1e-5)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "-z"])
def test_people_stand_upright_whatever_axis_is_up(result, tmp_path, up):
    from shapepose_fg.core.world_axes import z_up

    turned = replace(result, joints=result.joints @ z_up(up))
    page = Page(write_report(tmp_path, turned, None))
    scene = page.scene
    packed = array(scene["joints"], "<i2").reshape(-1, 25, 3).astype(float)
    upright = np.median(
        packed[:, BODY_25.index("Neck")] - packed[:, BODY_25.index("MidHip")], axis=0
    )
    assert upright[2] > 400
    assert f"{up} is assumed to be up" in page.text


def test_figures_are_those_of_the_observations(result):
    cameras = camera_figures(result)
    table = result.observations
    for view, camera in enumerate(cameras):
        assert camera.name == table.view_names[view]
        assert camera.given == table.gate[..., view].size
        assert camera.gates[Gate.USED] == (table.gate[..., view] == Gate.USED).sum()
        assert camera.given - camera.gates[Gate.USED] == camera.gates[Gate.TOO_FAR]
        # Every residual of the fixture is (1, 1).
        assert camera.all.median_px == camera.used.high_px == pytest.approx(np.sqrt(2))
        assert camera.trend_px == pytest.approx([np.sqrt(2)] * FRAMES)
    counts = known_counts(result)
    assert counts.sum() == result.known.size
    assert counts[BODY_25.index(GUESSED[1])].tolist() == [16, 0, 24, 0, 0]
    # By person: the guessed wrist is person 3's.
    by_person = known_counts(result, (result.person == 7).astype(int))
    assert by_person[0].tolist() == [24 * 24, 0, 24, 0, 0] and by_person[1].tolist() == [
        16 * 25 - 1,
        0,
        0,
        0,
        1,
    ]


def test_the_page_says_who_was_there_and_what_happened(result, scene, tmp_path):
    run = {
        "configuration": {"temporal": True, "observations": {"sigma_m": 0.02}},
        "time": {"fps": FPS, "source": "assumed"},
        "notes": ["3 joints were left out."],
        "setup": {"warnings": ["cam2 looks turned by 5 degrees."]},
        "people": {
            "dropped": {"too few parts in the box": 4},
            "problems": [{"person": 3, "frame": 101}],
        },
        "dropped_frames": {"too few parts in the box": [[100, 103], [110, 111]]},
        "cameras": [
            {"camera": "cam0", "offered": 1234, "left_out": {"median_px": 9.4, "median_mm": 21.0}}
        ],
        "seconds": {"solve": 2.5},
        "probability": [{"person": 7, "evidence": 0.22, "probability": 0.87}],
        "noise_law": {"times": [2.0] * 7, "gross": [0.25] * 7, "count": [0, 0, 0, 5678, 0, 0, 0]},
    }
    text = Page(write_report(tmp_path, result.with_run(**run), scene.rig)).text
    for part in (
        "2 people in 24 frames of 6 cameras, 1.0 s at 25 Hz, an assumed frame rate",
        "cam2 looks turned by 5 degrees.",
        "3 joints were left out.",
        "too few parts in the box4100–102, 110",
        "person 3, frame 101",
        f"observations.sigma_m0.02{PipelineConfig().observations.sigma_m:g}",
        "1 234",
        "9.4 px, 21 mm",
        "1.4 / 1.4 px",
        "person 7100–123161",
        "Errors of the detector",
        "5 678",
        "0.87",
    ):
        assert part in text, part


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("notes", ["a", 3], "notes[1] must be text, got 3"),
        ("setup", 7, "setup must be an object, got 7"),
        ("cameras", [{"offered": "x"}], "cameras[0].offered must be a whole number, got text 'x'"),
        ("dropped_frames", {"far": [[1]]}, "dropped_frames.far[0] must hold 2 values, got 1"),
        ("people", {"dropped": {"far": None}}, "people.dropped.far must be a whole number, got"),
        ("noise_law", "text", "noise_law is damaged"),
    ],
)
def test_entries_of_run_json_that_make_no_sense_are_refused(
    result, scene, tmp_path, name, value, problem
):
    with pytest.raises(InputError, match=re.escape(f"run.json: {problem}")):
        write_report(tmp_path, result.with_run(**{name: value}), scene.rig)


def test_a_run_in_memory_may_hold_what_run_json_has_as_text_and_lists(result, scene, tmp_path):
    told = {"body": tmp_path / "body.npz", "cuts": (5,), "seconds": {"solve": np.float64(1.5)}}
    page = Page(write_report(tmp_path, result.with_run(**told), scene.rig))
    assert "body.npz" in page.text


def test_a_long_recording_is_thinned_and_says_so(result, scene, tmp_path, monkeypatch):
    whole = write_report(tmp_path, result, scene.rig).stat().st_size
    monkeypatch.setattr("shapepose_fg.viz.report.writing.SCENE_BYTES", 8000)
    thin = Page(write_report(tmp_path, result, scene.rig))
    assert len(thin.source) < whole - 8000
    every = int(np.ceil(whole / 8000)) and re.search(
        r"One frame in (\d+) is drawn \((\d+) of 24\)", thin.text
    )
    assert every is not None
    kept = array(thin.scene["frames"], "<i4")
    assert len(kept) == int(every[2]) == len(range(0, 24, int(every[1])))
    assert kept.tolist() == list(range(FIRST, FIRST + FRAMES, int(every[1])))
    # Figures are still those of every frame.
    assert "person 3100–12324" in thin.text


def test_angles_of_a_long_recording_are_drawn_at_steps_that_show_a_gait():
    scene = built_in_scene(people=1, frames=40)
    frame, truth = np.arange(4000), truth_of(scene)
    long = replace(truth.rows(frame % 40), frame=frame, time_s=frame / 25)
    (curve,) = (each for each in angle_curves(long, "z", model_of({}))[0] if "knee" in each.name)
    points = curve.lines[0].count("L") + 1
    assert curve.frames[0] == 0 and 1000 < curve.frames[1] < 4000
    assert curve.frames[1] / (points - 1) / 25 <= 0.15
    assert angle_curves(long.rows(frame < 1), "z", model_of({}))[0][0].frames == (0, 0)


def test_nobody_found_is_a_page_too(scene, tmp_path):
    nobody = Reconstruction.empty().with_run(frames=[0, 10], time={"fps": 25.0, "source": "fps"})
    page = Page(write_report(tmp_path, nobody, scene.rig))
    assert_closed(page)
    assert page.scripts == []
    assert "No people were found in 10 frames" in page.text


def test_one_frame_without_a_rate_is_a_page_too(result, scene, tmp_path):
    alone = result.at(FIRST).with_run(
        frames=[FIRST, FIRST + 1], time={"fps": None, "source": "assumed"}
    )
    page = Page(
        write_report(tmp_path, replace(alone, time_s=np.full(len(alone), np.nan)), scene.rig)
    )
    assert array(page.scene["frames"], "<i4").tolist() == [FIRST]


def test_without_times_the_scene_plays_at_the_usual_rate(result, scene, tmp_path):
    timeless = replace(result, time_s=np.full(len(result), np.nan)).with_run(time={})
    page = Page(write_report(tmp_path, timeless, scene.rig))
    np.testing.assert_allclose(array(page.scene["times"], "<f4"), np.arange(FRAMES) / 30, atol=1e-5)
    assert "the scene plays at 30 Hz" in page.text


def test_people_on_no_timeline_are_a_page_without_a_scene(result, scene, tmp_path):
    twice = replace(result, person=np.full(len(result), 3), observations=None)
    page = Page(write_report(tmp_path, twice, scene.rig))
    assert_closed(page)
    assert (
        page.scripts == []
        and "the scene is not drawn: person 3 has two rows of frame 100" in page.text
    )


def test_every_reason_has_words(result, scene, tmp_path):
    table = result.observations
    gate = table.gate.copy()
    gate[0, : len(Gate), 0] = list(Gate)
    xy = np.where((gate == Gate.NOT_SEEN)[..., None], np.nan, table.xy)
    confidence = np.where(gate == Gate.NOT_SEEN, 0, table.confidence)
    candidate = np.where(gate == Gate.NOT_SEEN, -1, table.candidate)
    changed = replace(table, gate=gate, xy=xy, confidence=confidence, candidate=candidate)
    text = Page(write_report(tmp_path, replace(result, observations=changed), scene.rig)).text
    for words in ("too far", "against the body", "behind camera", "no position"):
        assert f"{words}: " in text


def test_result_without_observations_or_body_file(result, scene, tmp_path):
    bare = replace(result, observations=None).with_run(body=str(tmp_path / "gone.pkl"))
    page = Page(write_report(tmp_path, bare, scene.rig))
    assert "mesh" not in page.scene
    assert "bodies are not drawn" in page.text and "observations.npz is missing" in page.text


def test_the_command_makes_the_page_anew(saved, page, capsys, tmp_path):
    page.unlink()
    with pytest.raises(SystemExit) as end:
        main(["report", str(saved)])
    assert end.value.code == 0
    assert capsys.readouterr().out.split() == [str(page)]
    assert_closed(Page(page))
    for wrong, words in (
        (["report", str(tmp_path / "none")], "there is no such file"),
        (["report", str(saved), "--up", "q"], "'--up': 'q' is not one of"),
        (["report", str(saved), "--fps", "0"], "--fps 0"),
    ):
        with pytest.raises(SystemExit) as end:
            main(wrong)
        assert end.value.code == 2
        assert words in capsys.readouterr().err


@pytest.mark.slow
def test_a_correction_brings_the_page_up_to_date(result, tmp_path, capsys):
    result.save(tmp_path)
    report_of(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["tracks", str(tmp_path), "rename", "7", "9"])
    assert end.value.code == 0
    assert "report.html is up to date" in capsys.readouterr().out
    assert "person 9" in Page(tmp_path / "report.html").text
