"""Data walks one way: who may import whom, and that a light import stays light."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

LEVELS = (
    "factors",
    "core",
    "body",
    "biomechanics proposal",
    "estimation",
    "tracking",
    "io",
    "cameras detection2d evaluation pipeline",
    "live results simulation",
    "viz",
    "cli",
    "shapepose_fg __main__",
)
"""Folders; each level imports only from those before it. Folders of one level import nothing from
each other. `shapepose_fg` is the package's own front."""

LEVEL_OF = {name: level for level, names in enumerate(LEVELS) for name in names.split()}


def modules(package: str) -> Iterator[tuple[str, ast.Module]]:
    """Every module of a package with its syntax tree, as `shapepose_fg.body.model.body_model`."""
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(parts).removesuffix(".__init__"), ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(tree: ast.AST) -> set[str]:
    """Names of all modules that are imported anywhere in a file, those inside functions
    included.
    """
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"line {node.lineno}: write imports in full"
            found.add(node.module)
            # `from shapepose_fg.core import camera` imports a module too.
            inside = ROOT / node.module.replace(".", "/")
            names = [alias.name for alias in node.names] if inside.is_dir() else []
            found |= {
                f"{node.module}.{name}"
                for name in names
                if (inside / f"{name}.py").exists() or (inside / name).is_dir()
            }
    return found


def folder(module: str) -> str:
    """The name in `LEVELS` that a module belongs to: `body` for
    shapepose_fg.body.model.rotation.
    """
    first, _, rest = module.partition(".")
    return rest.partition(".")[0] if first == "shapepose_fg" and rest else first


def ours(names: set[str]) -> set[str]:
    return {name for name in names if name.split(".")[0] in ("factors", "shapepose_fg")}


@pytest.fixture(scope="module")
def library() -> dict[str, ast.Module]:
    """All modules of the package."""
    return dict(modules("shapepose_fg"))


def test_a_folder_imports_only_from_levels_before_its_own(library):
    for module, tree in library.items():
        here = folder(module)
        assert here in LEVEL_OF, f"{here} is new: give it a place in LEVELS"
        for there in {folder(other) for other in ours(imports(tree))} - {here}:
            assert LEVEL_OF[there] < LEVEL_OF[here], f"{module} must not import from {there}"
    assert {folder(module) for module in library} | {"factors"} == set(LEVEL_OF)


def test_inside_a_folder_nothing_imports_in_a_circle(library):
    """Neither modules nor sub-folders."""
    within = {name: imports(tree) & set(library) for name, tree in library.items()}
    for parent in {name.rpartition(".")[0] for name in library} - {""}:
        order = list(TopologicalSorter(graph_of(parent, within)).static_order())
        if parent == "shapepose_fg.pipeline":
            assert order.index(f"{parent}.config") < order.index(f"{parent}.pipeline")


def graph_of(parent: str, within: dict[str, set[str]]) -> dict[str, set[str]]:
    """What the modules and sub-folders of a folder, its `__init__` among them, import from each
    other.
    """

    def child(module: str) -> str:
        return ".".join(module.split(".")[: parent.count(".") + 2])

    graph: dict[str, set[str]] = {}
    for module, others in within.items():
        if f"{module}.".startswith(f"{parent}."):
            inside = {child(other) for other in others if f"{other}.".startswith(f"{parent}.")}
            graph.setdefault(child(module), set()).update(inside - {child(module)})
    return graph


def test_factors_know_gtsam_and_numpy_only():
    allowed = set(sys.stdlib_module_names) | {"factors", "gtsam", "numpy"}
    for module, tree in modules("factors"):
        foreign = {name.split(".")[0] for name in imports(tree)} - allowed
        assert not foreign, f"{module} imports {foreign}"


def test_torch_is_imported_for_training_only(library):
    users = {name for name, tree in library.items() if "torch" in imports(tree)}
    training = {name for name in users if "simulation.training" in name}
    assert users - training <= {"shapepose_fg.cli.train_fitter", "cli.train_fitter"} and training


NOT_UNIQUE = {"eig", "eigh", "svd", "qr", "schur", "multivariate_normal"}
"""Functions whose vectors have signs, and bases of repeated values, that the processor's kernels
choose."""
WITHOUT_CHOICE = {
    "shapepose_fg.core.decompositions": "removes it",
    "shapepose_fg.cameras.moving": "makes errors whose outer products are summed",
    "factors.camera_of": "gives signs: depth and focal lengths are positive",
    "factors.lasting": "makes symmetric roots and projectors",
    "shapepose_fg.evaluation.score": "gives rotations, which have no sign",
}


def test_what_a_processor_may_choose_is_left_to_none(library):
    """Signs of eigenvectors (use `core.decompositions`) and the order of equal values (sort
    stably): a seed would give another recording on another processor.
    """
    users = set()
    for module, tree in [*library.items(), *modules("factors"), *modules("scripts")]:
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if node.func.attr in NOT_UNIQUE:
                users.add(module)
            if node.func.attr in ("argsort", "argpartition"):
                kinds = [ast.unparse(each.value) for each in node.keywords if each.arg == "kind"]
                assert kinds == ["'stable'"], (
                    f"{module}, line {node.lineno}: give argsort kind='stable'"
                )
    assert users == set(WITHOUT_CHOICE)


LIGHT = {
    "the package": "import shapepose_fg; dir(shapepose_fg)",
    "readers": (
        "from shapepose_fg import InputError, Reconstruction, read_detections, read_rig, write_rig"
    ),
    "stage I": "import shapepose_fg.proposal.stage_one",
    "stage II": "import shapepose_fg.pipeline.solve_window",
    "fits": "from shapepose_fg.body.fitting.fitters import make_fitter; make_fitter()",
    "exports": "from shapepose_fg.io.export import glb, markers, motion_files, opensim, tables",
    "processes that look": "import shapepose_fg.simulation.visibility",
    "help": (
        "from shapepose_fg.cli.main import main\n"
        "sys.argv = ['shapepose-fg', '--help']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    ),
}


@pytest.mark.slow
def test_nothing_of_this_loads_torch():
    """One after the other, in one process."""
    lines = [
        f"{code}\nassert 'torch' not in sys.modules, 'torch was loaded by {name}'"
        for name, code in LIGHT.items()
    ]
    run = [sys.executable, "-c", "\n".join(["import sys", *lines])]
    done = subprocess.run(run, capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_reconstruct_loads_only_what_every_run_needs():
    code = "import sys\nimport shapepose_fg.cli.reconstruct.run\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    loaded = set(done.stdout.split())
    assert {"numpy", "gtsam", "numba"} <= loaded, done.stderr
    assert not loaded & {"torch", "matplotlib", "distributed", "jinja2", "rerun", "PIL"}
    assert not {name for name in loaded if name.startswith("scipy.")} & {
        f"scipy.{part}" for part in ("linalg", "optimize", "sparse", "spatial", "special", "stats")
    }


def test_the_package_s_front_offers_what_it_names():
    import shapepose_fg

    assert {"read_rig", "read_detections", "reconstruct", "Reconstruction"} <= set(
        dir(shapepose_fg)
    )
    for name in ("read_rig", "InputError", "Reconstruction"):
        assert getattr(shapepose_fg, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'no_such_thing'"):
        _ = shapepose_fg.no_such_thing
