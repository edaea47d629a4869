"""The head of a report: what it is of, what looks wrong, and the figures by which a result is judged first."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.io.export.markers import sigma_m
from shapepose_fg.viz.report import facts
from shapepose_fg.viz.report.elements import Element, element, listing
from shapepose_fg.viz.report.figures import Residual
from shapepose_fg.viz.report.sections import or_dash

_PARTS = {
    "scene": "Scene",
    "people": "People",
    "cameras": "Cameras",
    "joints": "Joints",
    "unused": "Not used",
    "run": "Run",
}


def header(title: str, people: Reconstruction, cameras: int) -> Element:
    """What this is a report of, in a sentence."""
    links = [element("a", words, href=f"#{name}") for name, words in _PARTS.items()]
    return element(
        "header",
        element("p", "shapepose-fg report", class_="kicker"),
        element("h1", title),
        element("p", _sentence(people, cameras), class_="summary"),
        element("nav", *links, aria_label="Parts of the report"),
    )


def _sentence(people: Reconstruction, cameras: int) -> str:
    """How many people in how many frames."""
    frames, count = len(_covered(people)), len(np.unique(people.person))
    who = f"{count} {'person' if count == 1 else 'people'}"
    if not over_time(people):
        who = f"{_plural(len(people), 'person', 'people')}, frame by frame,"
    fps, source = facts.rate(people.run)
    told = ""
    if fps is not None and fps > 0:
        assumed = ", a rate that is assumed because none was given" if source == "assumed" else ""
        told = f", {frames / fps:.1f}\u00a0s at {fps:.4g} a second{assumed}"
    by = f" of {cameras} cameras" if cameras > 0 else ""
    return f"{who if len(people) > 0 else 'Nobody was found'} in {_plural(frames, 'frame', 'frames')}{by}{told}."


def warnings(people: Reconstruction) -> Element | None:
    """What looks wrong, before everything else."""
    said = facts.warnings(people.run)
    if len(said) == 0:
        return None
    return element(
        "aside",
        element("h2", "Look at this first"),
        listing(said),
        class_="warnings",
        role="note",
    )


def key_figures(people: Reconstruction) -> Element:
    """The figures by which a result is judged first."""
    table = people.observations
    known = people.known[people.known != Known.UNKNOWN]
    placed = int(np.isfinite(people.joints).all(axis=-1).sum())
    sigma = sigma_m(people.covariance)
    sigma = sigma[np.isfinite(sigma)]
    seen = (known == Known.SEEN).mean() if len(known) > 0 else None
    px = Residual.of(np.zeros(0) if table is None else np.linalg.norm(table.residual_px, axis=-1))
    given = 0 if table is None else int((table.gate != Gate.NOT_SEEN).sum())
    used = None if table is None or given == 0 else (table.gate == Gate.USED).sum() / given
    median_mm = 1e3 * float(np.median(sigma)) if len(sigma) > 0 else None
    ok = float((people.status == "ok").mean()) if len(people) > 0 else None
    rows = f"of {_plural(len(people), 'row', 'rows')}: a person in a frame"
    cards = [
        ("joints seen", _percent(seen), "by two cameras, of those placed"),
        (
            "median error",
            or_dash(px.median_px, "{:.1f} px"),
            f"90 %: {or_dash(px.high_px, '{:.1f} px')}, all cameras",
        ),
        ("detections used", _percent(used), "of those given to people"),
        ("median sigma", or_dash(median_mm, "{:.0f} mm"), "how sure a joint's place is"),
        ("rows solved", _percent(ok), rows),
    ]
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


def over_time(people: Reconstruction) -> bool:
    """Whether a person's number is an identity."""
    return bool(people.run.get("configuration", {}).get("temporal", True))


def _covered(people: Reconstruction) -> NDArray[np.integer]:
    """(T,) all frames that were reconstructed, those without people too."""
    spans = covered_frames(people.run) or []
    return np.unique(np.concatenate([people.frame, *(np.arange(span.start, span.stop) for span in spans)]))


def _plural(count: int, one: str, several: str) -> str:
    return f"{count} {one if count == 1 else several}"


def _percent(share: float | None) -> str:
    """A share that is under 1 is not shown as if it were all."""
    if share is None:
        return "–"
    return f"{min(100 * float(share), 99.9) if share < 1 else 100:.3g} %"
