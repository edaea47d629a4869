"""The part of a report that says how a result came about."""

from collections import Counter
from collections.abc import Sequence

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.viz.report import facts
from shapepose_fg.viz.report.elements import Child, Element, definitions, element, listing, section, table

_SOURCES = {
    "assumed": "assumed: nothing says how many frames there are a second (--fps)",
    "fps": "given as --fps",
    "given": "given frame by frame",
}


def run_section(people: Reconstruction, remarks: Sequence[str]) -> Element:
    """Frames, times, settings, versions, inputs, and what was noted on the way."""
    run = people.run
    parts: list[Child] = []
    said = [*remarks, *facts.notes(run)]
    if len(said) > 0:
        parts += [element("h3", "Notes"), listing(said)]
    parts += [element("h3", "Facts"), definitions(_facts(people), class_="facts")]
    parts.append(element("h3", "Settings that are not the default"))
    changed = facts.changed_settings(run)
    if len(changed) == 0:
        known = isinstance(run.get("configuration"), dict)
        parts.append(element("p", "None." if known else "run.json does not say the settings."))
    else:
        rows: list[list[Child]] = [[element("code", name), value, usual] for name, value, usual in changed]
        parts.append(table(["setting", "value", "default"], rows, numbers=set(), label="Settings"))
    for key, title in (("versions", "Versions"), ("inputs", "Inputs, with their sha256")):
        told = facts.pairs(run, key)
        if len(told) > 0:
            parts.append(element("details", element("summary", title), definitions(told, class_=f"facts {key}")))
    return section("run", "Run", *parts)


def _facts(people: Reconstruction) -> list[tuple[Child, Child]]:
    """Names and values."""
    run = people.run
    fps, source = facts.rate(run)
    spans = [f"{span.start}–{span.stop - 1}" for span in covered_frames(run) or [] if len(span) > 0]
    entries: list[tuple[Child, Child]] = [
        ("frames", ", ".join(spans) or "not said"),
        ("frames a second", f"{fps:.4g}" if fps is not None else "not said"),
        ("times", _SOURCES.get(source, source) or "not said"),
        ("cuts at", ", ".join(map(str, run.get("cuts", []))) or "none"),
        ("body model", str(run.get("body") or "the open body that ships")),
        ("skeleton", f"{len(people.joint_names)} joints"),
    ]
    status = Counter(people.status.tolist())
    entries.append(("rows", ", ".join(f"{count} {name}" for name, count in status.items()) or "none"))
    spent = facts.stages(run)
    if len(spent) > 0:
        total = sum(seconds for _, seconds in spent)
        longest = sorted((each for each in spent if each[1] >= 0.05), key=lambda each: -each[1])
        listed = ", ".join(f"{name} {seconds:.1f}" for name, seconds in longest)
        entries.append(("time", f"{total:.1f} s of processors: {listed}"))
    return entries
