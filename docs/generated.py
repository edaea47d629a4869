"""Parts of the site that come from the program itself: navigation, commands, settings, API."""

import ast
import importlib
import inspect
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

PACKAGES = ("shapepose_fg", "factors")
"""What is installed, and whose exported names are public."""

NAVIGATION = {
    "Guides": [
        "docs/guides/biomechanics",
        "docs/guides/research",
        "docs/guides/robots",
        "docs/guides/phones",
        "docs/examples/README",
    ],
    "How to": [
        "Reconstruct a recording <docs/using>",
        "Detect joints in videos <docs/detection>",
        "Check a set-up <docs/setup_checks>",
        "Calibrate and synchronise <docs/calibrating>",
        "Moving cameras <docs/moving_cameras>",
        "Read the report <docs/report>",
        "Export <docs/export>",
        "Explain a joint <docs/uncertainty>",
        "Live <docs/live>",
        "ROS 2 <docs/ros>",
        "Long runs <docs/reliability>",
        "Archives <docs/batch>",
        "Score results <docs/evaluate>",
        "Simulate people <docs/simulation>",
    ],
    "Reference": [
        "Commands <docs/reference/commands>",
        "Settings <docs/reference/settings>",
        "Calibration files <docs/calibration_files>",
        "Detection files <docs/detection_files>",
        "Joints and layouts <docs/joints>",
        "Results <docs/results>",
        "Joint angles <docs/joint_angles>",
        "Files that you keep <docs/project_files>",
        "Names, axes, units, times <docs/conventions>",
        "Python API <docs/reference/api>",
    ],
    "Extend and understand": [
        "Extend <docs/extending>",
        "Factors <docs/factors>",
        "Data flow <docs/data_flow>",
        "The body model <docs/body_model>",
        "Body fitting <docs/body_fitting>",
        "Data of the body <shapepose_fg/body/data/README>",
        "The fitter's weights <shapepose_fg/body/data/fitter>",
        "The prior of poses <shapepose_fg/body/data/pose_prior>",
        "The prior of motion <shapepose_fg/body/data/motion_prior>",
    ],
    "Judge": [
        "Evaluation <docs/evaluation>",
        "Real recordings <docs/evaluation/real>",
        "Simulated people <docs/evaluation/people>",
        "Accuracy of joint angles <docs/evaluation/angles>",
        "Covariances, explanations <docs/evaluation/covariances>",
        "The paper's experiments <docs/evaluation/paper>",
        "Speed and memory <docs/evaluation/speed>",
        "Cameras <docs/evaluation/cameras>",
        "Live <docs/evaluation/live>",
        "Detectors, exports <docs/evaluation/parts>",
        "Changelog <CHANGELOG>",
        "Contributing and support <CONTRIBUTING>",
        "Security <SECURITY>",
        "Licences <docs/licences>",
    ],
}
"""Titles of the sidebar's groups, and their pages."""


def complete(app: Any, page: str, source: list[str]) -> None:
    """Add to a page what is generated for it; links to folders lead to the repository."""
    link = r"(?<=\]\()[^):#\s]+(?=\))"
    source[0] = re.sub(link, lambda found: _outside(page, found[0]), source[0])
    parts = {
        "README": navigation,
        "docs/examples/README": scripts,
        "docs/reference/commands": commands,
        "docs/reference/settings": settings,
        "docs/reference/api": api,
    }
    if page in parts:
        source[0] = f"{source[0].rstrip()}\n\n{parts[page]()}"


def _outside(page: str, link: str) -> str:
    """A link of a page; if it leads to a folder, as its address in the repository."""
    there = (ROOT / page).parent.joinpath(link).resolve()
    if not there.is_dir():
        return link
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return f"{project['urls']['Repository']}/tree/main/{there.relative_to(ROOT).as_posix()}"


def navigation() -> str:
    """The sidebar, as hidden tables of contents."""
    return "".join(
        f"```{{toctree}}\n:hidden:\n:caption: {title}\n\n" + "\n".join(pages) + "\n```\n\n"
        for title, pages in NAVIGATION.items()
    )


def scripts() -> str:
    """The text of every example, below the gallery."""
    names = [each.name for each in sorted((ROOT / "docs/examples").glob("[0-9]*.py"))]
    return "".join(
        f"## {name}\n\n```{{literalinclude}} {name}\n:language: python\n```\n\n" for name in names
    )


def settings() -> str:
    """All settings with their defaults and meanings, from what `shapepose-fg config` prints."""
    from shapepose_fg.io.config import toml_text
    from shapepose_fg.pipeline.config import PipelineConfig

    text, meaning, table = "", [], False
    for line in ["[]", *toml_text(PipelineConfig()).splitlines()]:
        if line.startswith("#"):
            meaning.append(line.removeprefix("#").strip().replace("|", "\\|"))
        elif line.startswith("["):
            title = f"`{line}`" if line != "[]" else "Top level"
            text += f"\n## {title}\n\n{' '.join(meaning)}\n\n"
            meaning, table = [], False
        elif " = " in line:
            name, _, value = line.partition(" = ")
            text += "" if table else "| setting | default | meaning |\n|---|---|---|\n"
            text += f"| `{name}` | `{value}` | {' '.join(meaning)} |\n"
            meaning, table = [], True
    return text


def commands() -> str:
    """Every command with its arguments and options, from the program's own help."""
    import typer

    from shapepose_fg.cli.main import app

    panels: dict[str, list[str]] = {}
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        text = "".join(_command(f"shapepose-fg {name}", command, "###"))
        panels.setdefault(command.rich_help_panel or "Other", []).append(text)
    return "".join(f"## {title}\n\n" + "".join(texts) for title, texts in panels.items())


def _command(name: str, command: Any, heading: str) -> Iterator[str]:
    """The section of one command, and of the commands below it."""
    yield f"{heading} {name}\n\n{inspect.cleandoc(command.help or '')}\n\n"
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    words = [each.metavar or each.name.upper() for each in arguments]
    required = [each for each in command.params if each.required and each not in arguments]
    words += [f"{each.opts[0]} {each.metavar or each.name.upper()}" for each in required]
    yield f"```bash\n{' '.join([name, *words, '[OPTIONS]'])}\n```\n\n"
    rows = [_row(each) for each in command.params if not getattr(each, "hidden", False)]
    if rows:
        yield "| option | meaning |\n|---|---|\n" + "".join(rows) + "\n"
    for below, each in getattr(command, "commands", {}).items():
        yield from _command(f"{name} {below}", each, f"{heading}#")


def _row(option: Any) -> str:
    """A line of the table of a command's options."""
    names = [*option.opts, *option.secondary_opts]
    if option.param_type_name == "argument":
        names = [option.metavar or option.name.upper()]
    elif option.metavar:
        names[0] += f" {option.metavar}"
    text = " ".join((option.help or "").split()).replace("|", "\\|")
    if option.show_default and isinstance(option.default, (str, int, float)) and option.default:
        text += f" Default: `{getattr(option.default, 'value', option.default)}`."
    if option.required:
        text += " Required."
    first = ", ".join(f"`{each}`" for each in names).replace("|", "\\|")
    return f"| {first} | {text} |\n"


def documented() -> dict[str, list[str]]:
    """Names by module that the package exports, and those that pages and examples import."""
    found: dict[str, set[str]] = {module: set(_exported(module)) for module in PACKAGES}
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "docs/examples").glob("*.py")]
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        texts += re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for text in texts:
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and re.match(
                r"(shapepose_fg|factors)(\.|$)", node.module or ""
            ):
                found.setdefault(str(node.module), set()).update(
                    each.name
                    for each in node.names
                    if not inspect.ismodule(_get(node.module, each.name))
                )
    exported = {id(_get(module, name)) for module in PACKAGES for name in found[module]}
    return {
        module: sorted(
            name for name in names if module in PACKAGES or id(_get(module, name)) not in exported
        )
        for module, names in found.items()
    }


def _exported(module: str) -> list[str]:
    """Public names of a package that are not modules."""
    there = importlib.import_module(module)
    return [
        name
        for name in getattr(there, "__all__", None) or getattr(there, "_HOMES", ())
        if not inspect.ismodule(getattr(there, name))
    ]


def _get(module: str | None, name: str) -> Any:
    return getattr(importlib.import_module(str(module)), name)


def api() -> str:
    """The signature and the docstring of every documented name."""
    text = ""
    modules = documented()
    for module in sorted(
        modules, key=lambda each: (each not in PACKAGES, each != "shapepose_fg", each)
    ):
        if modules[module]:
            text += f"## {module}\n\n```{{eval-rst}}\n"
            text += "".join(_directive(module, name) for name in modules[module])
            text += "```\n\n"
    return text


def _directive(module: str, name: str) -> str:
    """Autodoc's directive of one name."""
    value = _get(module, name)
    if inspect.isclass(value):
        return f".. autoclass:: {module}.{name}\n   :members:\n\n"
    if inspect.isroutine(value):
        return f".. autofunction:: {module}.{name}\n\n"
    lines = _constant(module, name).splitlines()
    as_text(None, "data", name, value, None, lines)
    return f".. py:data:: {module}.{name}\n\n" + "".join(f"   {line}\n" for line in lines) + "\n"


def _constant(module: str, name: str) -> str:
    """The docstring below the assignment of a constant, in the module where it is assigned."""
    nodes = ast.parse(inspect.getsource(importlib.import_module(module))).body
    for node, below in zip(nodes, [*nodes[1:], None], strict=True):
        if isinstance(node, ast.ImportFrom) and name in [each.name for each in node.names]:
            return _constant(str(node.module), name)
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        if [getattr(each, "id", None) for each in targets] == [name]:
            match below:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    return inspect.cleandoc(text)
    return ""


def as_text(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Make plain text of a docstring safe for reStructuredText: outside code, `|` and `*` are
    themselves.
    """
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()  # what Python says of the fields of a named tuple
    for at, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
        lines[at] = "".join(parts)
