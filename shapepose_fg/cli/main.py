"""The command line: registers all commands, and reports errors."""

import os
import sys
from collections.abc import Sequence
from typing import Any, cast

import typer

from shapepose_fg.cli.batch.command import batch
from shapepose_fg.cli.calibrate import calibrate
from shapepose_fg.cli.compile import compile_kernels
from shapepose_fg.cli.demo import demo
from shapepose_fg.cli.detect import detect
from shapepose_fg.cli.evaluate import evaluate
from shapepose_fg.cli.explain import explain
from shapepose_fg.cli.export import export
from shapepose_fg.cli.live import live
from shapepose_fg.cli.options import (
    Preset,
    flowing,
    grouped,
    preset_option,
)
from shapepose_fg.cli.overlay import overlay
from shapepose_fg.cli.reconstruct.command import reconstruct
from shapepose_fg.cli.refine import refine_calibration
from shapepose_fg.cli.report import report
from shapepose_fg.cli.setup import check_calibration
from shapepose_fg.cli.simulate import simulate
from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.cli.synchronise import synchronise
from shapepose_fg.cli.terminal import forget_notes, note_log, say, use_any_streams
from shapepose_fg.cli.tracks import tracks
from shapepose_fg.cli.train_fitter import train_fitter
from shapepose_fg.cli.view import view
from shapepose_fg.core.errors import InputError, failure

# All other modules are imported inside the commands, so that `--help` does not wait for GTSAM and
# Numba.

_NAME = "shapepose-fg"
app = typer.Typer(
    name=_NAME,
    help="Reconstruct several people in 3D, with bodies, from several calibrated cameras.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
_RECORDING, _RESULT, _TRY = "Reconstruct a recording", "Use a result", "Try and evaluate"
for _panel, _commands in {
    _RECORDING: (
        detect,
        calibrate,
        check_calibration,
        refine_calibration,
        synchronise,
        reconstruct,
        live,
        batch,
    ),
    _RESULT: (report, overlay, view, explain, export, tracks),
    _TRY: (evaluate, train_fitter),
}.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
app.command("compile", rich_help_panel=_TRY)(flowing(compile_kernels))
for _command in (demo, simulate):
    app.command(rich_help_panel=_TRY)(_command)

_UsageProblem = cast("type[Exception]", typer.BadParameter.__mro__[2])
"""typer's exception for an invalid command line; its place differs between versions."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. An error is one sentence on stderr and exit code 2."""
    use_any_streams()
    note_log()
    forget_notes()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        arguments = ["version"]
    try:
        with stoppable():
            code = app(arguments or ["--help"], standalone_mode=False, prog_name=_NAME)
            sys.stdout.flush()
    except _UsageProblem as error:
        message = cast(Any, error).format_message().rstrip(".").replace("Value error, ", "")
        path = getattr(getattr(error, "ctx", None), "command_path", _NAME)
        code = _fail(f"{message}; see {path} --help")
    except InputError as error:
        code = _fail(str(error))
    except BrokenPipeError:  # the reader of our output, such as `head`, has ended
        _drop_unwritten()
        code = 1
    except (OSError, MemoryError, RuntimeError) as error:
        if (what := failure(error)) is None:
            raise
        is_file = isinstance(error, OSError)
        _drop_unwritten()
        code = _fail(
            f"{what}; "
            f"{'check the path, permissions and free disk space' if is_file else 'start it again'}"
        )
    except Stopped as stop:
        say("stopped", stop.message or "no incomplete files are left", "bold yellow")
        code = stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


@app.command("config", rich_help_panel=_RECORDING)
@grouped
def config(preset: Preset = preset_option(Preset.ACCURATE)) -> None:
    """Print every setting with its value, as TOML."""
    from shapepose_fg.io.config import toml_text

    print(toml_text(preset.settings()), end="")


@app.command(rich_help_panel=_TRY)
def version() -> None:
    """Print the versions of this program and of the packages that it uses."""
    from shapepose_fg.core.provenance import versions

    for name, number in versions().items():
        print(name, number)


def _drop_unwritten() -> None:
    """Drop output that cannot be written; at exit Python would report it, with a code of its
    own.
    """
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str) -> int:
    """Print an error, in one line on stderr."""
    say("error", " ".join(message.split()), "bold red")
    return 2


if __name__ == "__main__":
    main()
