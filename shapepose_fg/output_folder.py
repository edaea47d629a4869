"""The folder that results are written into: made and tried before the long work, and not after."""

from pathlib import Path

from shapepose_fg.errors import InputError


def prepare_output(output: Path) -> None:
    """Make the output folder and try it, before the long work and not after."""
    from shapepose_fg.files import write_atomically

    try:
        trial = output / ".trial"
        write_atomically(trial, lambda stream: stream.write(b""))
        trial.unlink()
    except OSError as error:
        raise InputError(
            f"{output}: results cannot be written here ({error.strerror}); give a folder that can be written"
        ) from None
