"""Tables of the documents, written between their marks `<!-- NAME @1a2b3c4d -->` and `<!-- end -->`."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

from shapepose_fg.evaluation.experiments.made_with import fingerprint

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = (README, *sorted(DOCS.glob("*.md")))
MADE_WITH = DOCS / "made_with"


def write_table(name: str, text: str, made_with: Mapping[str, str]) -> bool:
    """Put `text` between the marks of `name` on each page that has them; returns whether one has.

    The mark names the file in docs/made_with that says what it was made with.
    """
    marked = re.compile(rf"<!-- {re.escape(name)}( @\w+)? -->\n.*?(<!-- end -->)", re.DOTALL)
    with_marks = [page for page in PAGES if marked.search(page.read_text(encoding="utf-8")) is not None]
    if len(with_marks) == 0:
        return False
    digits = fingerprint(made_with)
    MADE_WITH.mkdir(exist_ok=True)
    (MADE_WITH / f"{digits}.json").write_text(json.dumps(made_with, indent=1) + "\n", encoding="utf-8")
    for page in with_marks:
        old = page.read_text(encoding="utf-8")
        new = marked.sub(lambda found: f"<!-- {name} @{digits} -->\n\n{text}\n\n{found[2]}", old)
        page.write_text(new, encoding="utf-8")
    return True
