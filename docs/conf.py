"""Configuration of the site, which `make docs` builds from README.md and the pages below docs/.

The pages are plain Markdown that GitHub shows as well: the source folder is the repository, links
are relative paths, and what only the site has (navigation, commands, settings, API) is added while
it is built, by docs/generated.py.
"""

import re
import shutil
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import generated  # noqa: E402

import shapepose_fg  # noqa: E402

project = "shapepose-fg"
author = copyright = "The shapepose-fg authors"
version = release = shapepose_fg.__version__

root_doc = "README"
include_patterns = ["*.md", "docs/**", "shapepose_fg/body/data/*.md"]
exclude_patterns = [".*", "build", "dist", "demo", "results", "tests", "**/*.egg-info"]
extensions = ["myst_parser", "sphinx.ext.autodoc"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_disable_syntax = ["myst_line_comment"]  # a line may begin with %
myst_heading_anchors = 4
suppress_warnings = ["misc.highlighting_failure"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
default_role = "code"
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"shapepose-fg {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = html_show_copyright = False
html_copy_source = html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}


def setup(app: Any) -> None:
    """Connect what is added to the pages while the site is built."""
    app.connect("source-read", generated.complete)
    app.connect("autodoc-process-docstring", generated.as_text)
    app.connect("html-page-context", _whole_options)
    app.connect("build-finished", _start)


def _whole_options(app: Any, name: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Wrap the options of commands in spans, so that no line is broken behind their hyphens."""
    context["body"] = re.sub(
        r'<div class="highlight-bash.*?</pre>',
        lambda code: re.sub(r"(?<=[>\s])-[\w-]+", r'<span class="option">\g<0></span>', code[0]),
        context.get("body", ""),
        flags=re.DOTALL,
    )


def _start(app: Any, error: Exception | None) -> None:
    """Let the site begin with the README: a folder's first page is named index.html."""
    if error is None and app.builder.format == "html":
        shutil.copyfile(Path(app.outdir, "README.html"), Path(app.outdir, "index.html"))
