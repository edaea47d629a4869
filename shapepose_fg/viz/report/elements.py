"""HTML as a tree of elements: every text and attribute is escaped when it is written."""

from collections.abc import Sequence
from importlib.resources import files
from xml.etree import ElementTree

Element = ElementTree.Element
Child = str | Element | None


def element(tag: str, *children: Child, **attributes: str | None) -> Element:
    """An element with `children`, texts or elements; those that are None are left out, attributes too.

    Names of attributes are Python's: `class_` is class, `aria_label` is aria-label.
    """
    made = Element(tag)
    for name, value in attributes.items():
        if value is not None:
            made.set(name.rstrip("_").replace("_", "-"), value)
    for child in children:
        if child is None:
            continue
        if not isinstance(child, str):
            made.append(child)
        elif len(made) == 0:
            made.text = (made.text or "") + child
        else:
            made[-1].tail = (made[-1].tail or "") + child
    return made


def html(root: Element) -> str:
    """The text of an element and all within. What is inside `script` and `style` is written as it is."""
    return ElementTree.tostring(root, encoding="unicode", method="html")


def asset(name: str) -> str:
    """Text of a file that ships beside this one."""
    return (files("shapepose_fg.viz.report") / "data" / name).read_text(encoding="utf-8")


def asset_element(name: str) -> Element:
    """The element that a file of well-formed HTML holds, without the blanks between its elements."""
    root = ElementTree.fromstring(asset(name))
    for each in root.iter():
        each.text = each.text if each.text and each.text.strip() else None
        each.tail = each.tail.strip() if each.tail and each.tail.strip() else None
    return root


def listing(texts: Sequence[Child], **attributes: str | None) -> Element:
    """A list with an item for each text."""
    return element("ul", *(element("li", each) for each in texts), **attributes)


def definitions(pairs: Sequence[tuple[Child, Child]], **attributes: str | None) -> Element:
    """A list of names and what they mean."""
    return element(
        "dl",
        *(part for name, value in pairs for part in (element("dt", name), element("dd", value))),
        **attributes,
    )


def section(name: str, title: str, *children: Child) -> Element:
    """A part of the page with its heading."""
    heading = element("h2", title, id=f"{name}-title")
    return element("section", heading, *children, id=name, aria_labelledby=f"{name}-title")


def table(head: list[Child], rows: list[list[Child]], *, numbers: set[int], label: str) -> Element:
    """A table that scrolls sideways where the page is narrow; columns in `numbers` are set flush right."""
    cell_class = ["number" if column in numbers else None for column in range(len(head))]
    heads = [element("th", cell, scope="col", class_=kind) for cell, kind in zip(head, cell_class, strict=True)]
    body = []
    for row in rows:
        first, *rest = row
        cells = [element("td", cell, class_=kind) for cell, kind in zip(rest, cell_class[1:], strict=True)]
        body.append(element("tr", element("th", first, scope="row", class_=cell_class[0]), *cells))
    whole = element("table", element("thead", element("tr", *heads)), element("tbody", *body), aria_label=label)
    # What scrolls can be reached with the keyboard.
    return element("div", whole, class_="scroll", tabindex="0", role="group", aria_label=label)


def share_bar(shares: list[tuple[str, float]], label: str) -> Element:
    """Shares of a whole, 0 to 1, as one bar; each with the class of its colour."""
    pieces = [
        element("span", class_=f"piece {kind}", style=f"width:{100 * share:.2f}%")
        for kind, share in shares
        if share > 0
    ]
    return element("span", *pieces, class_="bar", role="img", aria_label=label, title=label)


def trend(values: list[float | None], most: float, label: str) -> Element:
    """A line over time, from 0 to `most`; None is a gap."""
    width, height = 120.0, 22.0
    step = width / max(len(values) - 1, 1)
    paths, pen_down = [], False
    for index, value in enumerate(values):
        if value is not None:
            y = height - 1 - (height - 2) * min(value / most, 1.0) if most > 0 else height - 1
            paths.append(f"{'L' if pen_down else 'M'}{index * step:.1f} {y:.1f}")
            if not pen_down:
                paths.append(f"h.8v0h-.8M{index * step:.1f} {y:.1f}")
        pen_down = value is not None
    line = element("path", d="".join(paths) or "M0 0")
    box = f"0 0 {width:g} {height:g}"
    return element("svg", line, viewBox=box, class_="trend", role="img", aria_label=label)
