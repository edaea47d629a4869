"""Tables of the documents, written between their marks `<!-- NAME -->` and `<!-- end -->`."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
EVALUATION, SIMULATION, IMAGES = DOCS / "evaluation.md", DOCS / "simulation.md", DOCS / "images"


def write_table(name: str, text: str, *pages: Path) -> None:
    """Put `text` between the marks of `name` on each of the `pages` that has them; ValueError where none has."""
    marked = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    with_marks = [page for page in pages if marked.search(page.read_text(encoding="utf-8")) is not None]
    if len(with_marks) == 0:
        raise ValueError(
            f"no page has marks <!-- {name} --> and <!-- end -->: add them to one of"
            f" {', '.join(page.name for page in pages)}"
        )
    for page in with_marks:
        old = page.read_text(encoding="utf-8")
        page.write_text(marked.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", old), encoding="utf-8")
