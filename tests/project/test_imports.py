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
    "factors core.arrays core.errors core.rows",
    "core.storage.files core.decompositions core.validation",
    "core.kept_kernels core.bounds",
    "core.compiling",
    "core.compiled",
    "core.skeleton core.kernel_geometry core.assignment core.lens core.trajectory core.frame_times",
    "core.joint_names",
    "core.camera",
    "core.drawing",
    "core.storage.npz",
    "core.storage.schema",
    "core.storage.output_folder core.storage.kept_arrays core.shapes core.provenance"
    " core.run_summary core.rig_file viz.rendering pipeline.workers cli.terminal cli.stopping",
    "core.result_files",
    "body.kernels",
    "body.model",
    "body.fitting body.shapes",
    "body.offsets body.joint_order",
    "core.detections core.frame_sets",
    "core.trust",
    "core.observations core.notes core.repeated_pictures",
    "core.observation_table",
    "core.reconstruction",
    "proposal",
    "estimation",
    "tracking",
    "pipeline.solve_window pipeline.keyframes",
    "pipeline.config pipeline.cluster pipeline.person_shapes",
    "pipeline.windows",
    "pipeline.runs",
    "pipeline.setup pipeline.execution",
    "pipeline.offsets pipeline.solved_windows",
    "pipeline.trajectories",
    "pipeline.pipeline",
    "io",
    "io.export.take",
    "biomechanics",
    "pipeline.solve_again",
    "pipeline.explanation",
    "pipeline.explaining",
    "live",
    "simulation viz.bodies detection2d",
    "viz.overlay cameras",
    "io.export",
    "live.outputs viz.report",
    "evaluation",
    "cli.options",
    "cli.pictures cli.found_cameras cli.setup_table",
    "cli.reconstruct",
    "cli.batch",
    "cli.tracks cli.detect cli.overlay cli.export cli.report cli.view cli.setup "
    "cli.simulate cli.train_fitter cli.batch.command cli.refine cli.synchronise cli.live "
    "cli.calibrate cli.explain cli.evaluate",
    "cli.compile cli.demo",
    "cli.main",
    "__main__",
)
"""Each level imports only from those before it; a package may import its own modules too."""

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


def imported_on_import(tree: ast.Module) -> set[str]:
    """Modules that importing the file imports: not those in functions, nor those for the type
    checker alone.
    """
    waiting, found = list(tree.body), set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            found |= imports(node)
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
        elif isinstance(node, ast.If | ast.Try | ast.With):
            waiting += [
                child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)
            ]
    return found


def room(module: str) -> str:
    """The name in `LEVELS` that a module belongs to: `body.model` for
    shapepose_fg.body.model.rotation.
    """
    first, *rest = module.split(".")
    if first != "shapepose_fg" or len(rest) == 0:
        return first
    names = [".".join(rest[:n]) for n in range(len(rest), 0, -1)]
    return next((name for name in names if name in LEVEL_OF), rest[0])


def ours(names: set[str]) -> set[str]:
    return {name for name in names if name.split(".")[0] in ("factors", "shapepose_fg")}


FOLDERS = {f"shapepose_fg{name}" for name in ("", ".body", ".cli", ".core", ".core.storage")}
FOLDERS |= {"shapepose_fg.pipeline", "shapepose_fg.viz"}


@pytest.fixture(scope="module")
def library() -> dict[str, ast.Module]:
    """All modules but folders whose files have levels of their own."""
    return {name: tree for name, tree in modules("shapepose_fg") if name not in FOLDERS}


def test_a_module_imports_only_from_levels_before_its_own(library):
    for module, tree in library.items():
        check_levels(module, tree)


def check_levels(module: str, tree: ast.Module) -> None:
    here = room(module)
    assert here in LEVEL_OF, f"{module} is new: give it a place in LEVELS"
    for other in ours(imports(tree)):
        assert other != "shapepose_fg", (
            f"{module}: import from the module itself, not from the package's front"
        )
        if room(other) != here:
            assert LEVEL_OF[room(other)] < LEVEL_OF[here], f"{module} must not import {other}"


def test_every_place_in_the_table_is_taken(library):
    assert {room(module) for module in library} | {"factors"} == set(LEVEL_OF)


def test_modules_import_each_other_in_no_circle(library):
    known = set(library)
    graph = {module: (imports(tree) & known) - {module} for module, tree in library.items()}
    order = list(TopologicalSorter(graph).static_order())  # CycleError names the circle
    assert order.index("shapepose_fg.core.camera") < order.index("shapepose_fg.pipeline.pipeline")


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
