"""The page of a report: head, key figures, scene, sections; one text with everything in it."""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from shapepose_fg.export.markers import sigma_m
from shapepose_fg.observation_table import Gate
from shapepose_fg.reconstruction import Known, Reconstruction
from shapepose_fg.report import facts
from shapepose_fg.report.elements import Child, Element, element, html
from shapepose_fg.report.figures import CameraFigures, Residual
from shapepose_fg.report.run_section import run_section
from shapepose_fg.report.scene import Thinning
from shapepose_fg.report.sections import (
    cameras_section,
    gates_section,
    joints_section,
    or_dash,
    people_section,
)
from shapepose_fg.tracking.listing import TrackSummary

_SCRIPTS = ("geometry.js", "skin.js", "drawing.js", "page.js")
"""In the order in which they are loaded."""


@dataclass(frozen=True)
class Content:
    """Everything that a page says."""

    title: str
    """Name of the result."""
    people: Reconstruction
    """The result."""
    tracks: Sequence[TrackSummary]
    """Its identities."""
    cameras: Sequence[CameraFigures]
    """What became of each camera's detections; none where that is not recorded."""
    scene: dict[str, Any] | None
    """What is drawn; None where nobody was found."""
    thinning: Thinning | None
    """Which frames of it are there."""
    remarks: Sequence[str] = ()
    """What the page lacks, a sentence each."""


def page_text(content: Content) -> str:
    """The page as HTML: self-contained, with no address of anything else in it.

    Texts of the input are escaped, and the page's own policy forbids every script but those that are part of it.
    """
    scripts = [_asset(name) for name in _SCRIPTS] if content.scene is not None else []
    hashes = " ".join(f"'sha256-{_sha256(text)}'" for text in scripts) or "'none'"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="referrer", content="no-referrer"),
        element("title", f"{content.title} – shapepose-fg report"),
        element("style", _asset("report.css")),
    )
    main = element(
        "main",
        _warnings(content.people),
        _key_figures(content),
        _scene(content),
        people_section(content.people, content.tracks, _over_time(content.people)),
        cameras_section(content.cameras),
        joints_section(content.people),
        gates_section(content.people, content.cameras),
        run_section(content.people, content.remarks),
    )
    body = element("body", _header(content), main)
    if content.scene is not None:
        body.append(element("script", _json(content.scene), type="application/json", id="scene-data"))
    for text in scripts:
        body.append(element("script", text))
    return "<!DOCTYPE html>\n" + html(element("html", head, body, lang="en")) + "\n"


def _header(content: Content) -> Element:
    """What this is a report of, in a sentence."""
    links = [
        element("a", words, href=f"#{name}")
        for name, words in (
            ("scene", "Scene"),
            ("people", "People"),
            ("cameras", "Cameras"),
            ("joints", "Joints"),
            ("unused", "Not used"),
            ("run", "Run"),
        )
    ]
    return element(
        "header",
        element("p", "shapepose-fg report", class_="kicker"),
        element("h1", content.title),
        element("p", _sentence(content), class_="summary"),
        element("nav", *links, aria_label="Parts of the report"),
    )


def _sentence(content: Content) -> str:
    people, frames = content.people, len(covered(content.people))
    count = len(content.tracks)
    who = (
        f"{count} {'person' if count == 1 else 'people'}"
        if _over_time(people)
        else f"{len(people)} rows of people"
    )
    fps, source = facts.rate(people.run)
    told = ""
    if fps is not None and fps > 0:
        assumed = ", a rate that is assumed because none was given" if source == "assumed" else ""
        told = f", {frames / fps:.1f} s at {fps:.4g} a second{assumed}"
    cameras = f" of {len(content.cameras)} cameras" if len(content.cameras) > 0 else ""
    return f"{who if len(people) > 0 else 'Nobody was found'} in {_plural(frames, 'frame')}{cameras}{told}."


def _warnings(people: Reconstruction) -> Element | None:
    """What looks wrong, before everything else."""
    said = facts.warnings(people.run)
    if len(said) == 0:
        return None
    return element(
        "aside",
        element("h2", "Look at this first"),
        element("ul", *(element("li", each) for each in said)),
        class_="warnings",
        role="note",
    )


def _key_figures(content: Content) -> Element:
    """The figures by which a result is judged first."""
    people, table = content.people, content.people.observations
    known = people.known[people.known != Known.UNKNOWN]
    placed = int(np.isfinite(people.joints).all(axis=-1).sum())
    sigma = sigma_m(people.covariance)
    sigma = sigma[np.isfinite(sigma)]
    px = Residual.of(np.zeros(0) if table is None else np.linalg.norm(table.residual_px, axis=-1))
    used = None if table is None else (table.gate == Gate.USED).sum() / max((table.gate != Gate.NOT_SEEN).sum(), 1)
    ok = float((people.status == "ok").mean()) if len(people) > 0 else None
    cards = [
        ("joints seen", _percent((known == Known.SEEN).mean() if len(known) > 0 else None), "by a camera, of those placed"),
        ("median error", or_dash(px.median_px, "{:.1f} px"), f"90 %: {or_dash(px.high_px, '{:.1f} px')}, all cameras"),
        ("detections used", _percent(used), "of those given to people"),
        ("median sigma", f"{1e3 * np.median(sigma):.0f} mm" if len(sigma) > 0 else "–", "how sure a joint's place is"),
        ("rows solved", _percent(ok), f"of {_plural(len(people), 'row')}: a person in a frame"),
    ]  # fmt: skip
    if placed == 0:
        return element("p", "No joint was placed.")
    items = [
        element(
            "div",
            element("dt", name),
            element("dd", element("strong", value), element("span", meaning)),
        )
        for name, value, meaning in cards
    ]
    return element("dl", *items, class_="cards")


def _scene(content: Content) -> Element | None:
    """The canvas, with what moves it."""
    if content.scene is None:
        return None
    frames = 0 if content.thinning is None else content.thinning.kept
    cameras = [element("option", f"camera {each['name']}", value=str(index)) for index, each in enumerate(content.scene["cameras"])]  # fmt: skip
    layers = [("bodies", "Bodies", "mesh" in content.scene), ("bones", "Skeletons", True)]
    layers += [("sigma", "Uncertainty", True), ("trails", "Paths", True), ("cameras", "Cameras", len(cameras) > 0)]
    boxes = [
        element("label", _checkbox(name, name not in ("sigma",)), words, title=_LAYERS[name])
        for name, words, there in layers
        if there
    ]
    speeds = [
        element("option", f"{speed:g}×", value=f"{speed:g}", selected="selected" if speed == 1 else None)
        for speed in (0.25, 0.5, 1, 2, 4)
    ]
    through = element(
        "select", element("option", "free view", value=""), *cameras, id="through", aria_label="Look from"
    )
    controls = element(
        "div",
        element("button", "Play", id="play", type="button", aria_label="Play"),
        element(
            "input",
            type="range",
            id="frame",
            min="0",
            max=str(max(frames - 1, 0)),
            value="0",
            step="1",
            aria_label="Frame",
        ),  # fmt: skip
        element("output", id="clock", for_="frame"),
        element("label", "speed ", element("select", *speeds, id="speed"), class_="speed"),
        class_="controls",
    )
    canvas = element(
        "canvas", "The people in 3D.", id="canvas", tabindex="0", role="img",
        aria_label="People in 3D, with the cameras. Arrow keys turn the view, plus and minus zoom.",
    )  # fmt: skip
    hint = element("p", "Drag to turn · right button or two fingers to move · wheel to zoom", class_="hint")
    stage = element("div", canvas, hint, element("div", id="key", class_="key"), class_="stage")
    tools = element(
        "div",
        *boxes,
        element("span", class_="space"),
        through if cameras else None,
        element("button", "Reset view", id="reset", type="button"),
        class_="tools",
    )
    strip = element("canvas", "Who is there when.", id="strip", role="img", aria_label="Who is there when")
    parts: list[Child] = [
        element("noscript", element("p", "The scene needs JavaScript, which is switched off here.")),
        tools,
        stage,
        controls,
        strip,
        element(
            "p",
            "One row a person: how high it is filled says how many joints are seen. Click to go there.",
            class_="lead strip-words",
        ),  # fmt: skip
    ]
    if content.thinning is not None and content.thinning.every > 1:
        thin = content.thinning
        words = (
            f"Drawn here is one frame in {thin.every} ({thin.kept} of {thin.of}), so that the page stays small; "
        )
        parts.append(element("p", words + "all figures below are of every frame.", class_="lead"))
    return element("section", element("h2", "Scene", class_="visually-hidden", id="scene-title"), *parts, id="scene", aria_labelledby="scene-title")  # fmt: skip


_LAYERS = {
    "bodies": "The fitted bodies, with a vertex per 5 cm of skin",
    "bones": "The joints and what joins them; rings are joints that no camera saw in this frame",
    "sigma": "Spheres that hold a joint's true place with 95 % probability, by the mean of its sigmas",
    "trails": "Where people walked in the last two seconds",
    "cameras": "Where cameras stand and look",
}


def _checkbox(name: str, on: bool) -> Element:
    return element("input", type="checkbox", id=f"show-{name}", checked="checked" if on else None)


def covered(people: Reconstruction) -> np.ndarray:
    """(T,) all frames that were reconstructed, those without people too."""
    from shapepose_fg.run_summary import covered_frames

    spans = covered_frames(people.run) or []
    return np.unique(np.concatenate([people.frame, *(np.arange(span.start, span.stop) for span in spans)]))


def _over_time(people: Reconstruction) -> bool:
    settings = people.run.get("configuration", {})
    return bool(settings.get("temporal", True))


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _percent(share: float | None) -> str:
    """A share that is under 1 is not shown as if it were all."""
    if share is None:
        return "–"
    return f"{min(100 * float(share), 99.9) if share < 1 else 100:.3g} %"


def _asset(name: str) -> str:
    """Text of a file that ships beside this one."""
    return (files("shapepose_fg.report") / "data" / name).read_text(encoding="utf-8")


def _sha256(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _json(value: object) -> str:
    """JSON that no name in it can end."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
