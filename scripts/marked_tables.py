"""Tables of the documents, written between their marks `<!-- NAME @1a2b3c4d -->` and `<!-- end -->`."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = (README, *sorted(DOCS.glob("*.md")))
IMAGES = DOCS / "images"


def write_table(name: str, text: str, made_with: str) -> None:
    """Put `text` between the marks of `name` on each page that has them, and in the mark what it was made with.

    ValueError where no page has them.
    """
    marked = re.compile(rf"<!-- {re.escape(name)}( @\w+)? -->\n.*?(<!-- end -->)", re.DOTALL)
    with_marks = [page for page in PAGES if marked.search(page.read_text(encoding="utf-8")) is not None]
    if len(with_marks) == 0:
        raise ValueError(f"no page has marks <!-- {name} --> and <!-- end -->: add them to one in docs/")
    for page in with_marks:
        old = page.read_text(encoding="utf-8")
        new = marked.sub(lambda found: f"<!-- {name} @{made_with} -->\n\n{text}\n\n{found[2]}", old)
        page.write_text(new, encoding="utf-8")
