"""The HTML page of a report: data/page.html filled in, as one self-contained text."""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from shapepose_fg.core.drawing import PALETTE
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.results.track_summary import TrackSummary
from shapepose_fg.viz.report.facts import page_entries
from shapepose_fg.viz.report.figures import KINDS, Curve, camera_figures, known_counts, overall
from shapepose_fg.viz.report.scene import PageScene

if TYPE_CHECKING:
    from jinja2 import Environment

_SCRIPTS = ("geometry.js", "skin.js", "drawing.js", "page.js")
"""Scripts in the order in which they are loaded."""


def page_text(
    title: str,
    people: Reconstruction,
    tracks: Sequence[TrackSummary],
    scene: PageScene | None,
    remarks: Sequence[str],
    curves: Mapping[int, Sequence[Curve]],
) -> str:
    """The page of a result as self-contained HTML, without references to other addresses.

    `tracks` are the identities, `scene` is drawn if given, `remarks` state what is missing on the
    page, and `curves` are joint angles by person.
    """
    by_person = known_counts(
        people, np.searchsorted([each.person for each in tracks], people.person)
    )
    by_joint, kinds = known_counts(people), [kind.name.lower() for kind in KINDS]
    return filled(
        "page.html",
        scene,
        Gate=Gate,
        title=title,
        remarks=[*remarks],
        run=page_entries(people.run),
        overall=overall(people),
        cameras=camera_figures(people),
        curves=curves,
        tracks=[
            (each, dict(zip(kinds, counts, strict=True)), PALETTE[each.person % len(PALETTE)])
            for each, counts in zip(tracks, by_person.tolist(), strict=True)
        ],
        known=dict(zip(kinds, by_joint.sum(axis=0).tolist(), strict=True)),
        joints=[
            (name, dict(zip(kinds, counts, strict=True)))
            for name, counts in zip(people.joint_names.tolist(), by_joint.tolist(), strict=True)
        ],
    )


def filled(name: str, scene: PageScene | None, **values: object) -> str:
    """Fill in one of the pages in data/, and embed the `scene` and everything that the page needs.

    Texts of the input are escaped, and the page's Content-Security-Policy forbids all scripts
    except its own.
    """
    scripts = [_asset(name) for name in _SCRIPTS] if scene is not None else []
    digests = (
        base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
        for text in scripts
    )
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:"
    return (
        _pages()
        .get_template(name)
        .render(policy=policy, style=_asset("report.css"), scripts=scripts, scene=scene, **values)
    )


@cache
def _pages() -> "Environment":
    """The compiled pages; to compile them takes longer than to fill them in."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    pages = Environment(
        loader=FunctionLoader(_asset),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        extensions=["jinja2.ext.do"],
    )
    pages.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    pages.filters |= {
        "dash": _dash,
        "share": _share,
        "percent": _percent,
        "count": _count,
        "path": _path,
    }
    return pages


def _dash(value: float | None, text: str, none: str = "–") -> str:
    """`value` formatted by `text`; a dash if it is None or NaN."""
    return none if value is None or value != value else text % value


def _share(count: int, total: int) -> str:
    """A share as text, in which only 0 is shown as 0 and only 1 as 1; a dash if `total` is 0."""
    if count in (0, total):
        return "–" if total == 0 else f"{100 * count / total:.0f} %"
    percent = 100 * count / total
    return "under 0.1 %" if percent < 0.05 else f"{min(percent, 99.9):.1f} %"


def _percent(share: float | None) -> str:
    """A share of 0 to 1 in per cent with three digits; only 1 is shown as 100 %."""
    return "–" if share is None else f"{min(100 * share, 99.9) if share < 1 else 100:.3g} %"


def _count(value: float | None) -> str:
    """A whole number with thin spaces between groups of three digits."""
    return "–" if value is None else f"{value:,.0f}".replace(",", "\u202f")


def _path(values: list[float | None], most: float) -> str:
    """SVG path of a time series in a box of 120 x 22, for values from 0 to `most`; None is a
    gap.
    """
    step, drawn, pen_down = 120 / max(len(values) - 1, 1), list[str](), False
    for index, value in enumerate(values):
        if value is not None:
            at = f"{index * step:.1f} {21 - 20 * min(value / most, 1.0) if most > 0 else 21:.1f}"
            drawn.append(f"L{at}" if pen_down else f"M{at}h.8v0h-.8M{at}")
        pen_down = value is not None
    return "".join(drawn) or "M0 0"


def _asset(name: str) -> str:
    """Text of a file in the folder data/."""
    return (files("shapepose_fg.viz.report") / "data" / name).read_text(encoding="utf-8")
