"""Exceptions with messages for the user: what is wrong with the input, where, and how to correct
it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

_LONGEST = 1000
"""Maximum number of characters in a message: a file may have a text of any length in place of a
number."""


class InputError(ValueError):
    """An input cannot be used; the message is one sentence, in one line, that names file, place and
    cure.
    """

    def __init__(self, message: str):
        line = " ".join(message.splitlines())
        if len(line) > _LONGEST:
            line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 3 :]}"
        super().__init__(line)


class NotDetermined(ValueError):
    """A joint, or a body, cannot be determined; the message names person, frame, joint and what is
    missing.
    """

    def __init__(self, person: int, joint: str, frame: int, time_s: float, missing: str):
        when = f" ({time_s:.3f} s)" if time_s == time_s else ""
        super().__init__(
            f"{joint} of person {person} in frame {frame}{when} is not determined: {missing}"
        )
        self.person, self.joint, self.frame, self.time_s, self.missing = (
            person,
            joint,
            frame,
            time_s,
            missing,
        )


class WorkLost(RuntimeError):
    """A process ended before its work was done; earlier work is kept."""


def failure(error: BaseException) -> str | None:
    """The beginning of a sentence about an operating-system error, a lack of memory or a lost
    process; None for other errors.
    """
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename is not None else ""
        return f"{place}{error.strerror or error}"
    if isinstance(error, MemoryError) or "allocate memory" in str(
        error
    ):  # some libraries raise a RuntimeError
        return "there is too little memory; close other programs, or give fewer --workers"
    return str(error) if isinstance(error, WorkLost) else None


@contextmanager
def naming(
    place: object, cure: str = "", words: str = "{}", *kinds: type[Exception]
) -> Iterator[None]:
    """Context manager: a ValueError inside the block becomes an InputError that names `place`, with
    `cure` at its end.

    `words` is the sentence between them, with {} for the error. With `kinds`, errors of these
    classes, from other libraries, are converted instead; only the first line of their messages is
    used.
    """
    caught = kinds or (ValueError,)
    try:
        yield
    except InputError:
        raise
    except caught as error:
        problem = [*str(error).splitlines(), type(error).__name__][0] if kinds else error
        raise InputError(f"{place}: {words.format(problem)}{'; ' if cure else ''}{cure}") from None


def optional(module: str, extra: str) -> ModuleType:
    """A package of an extra; InputError with the install command if it is missing."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise InputError(
            f'{package} is not installed; pip install "shapepose-fg[{extra}]"'
        ) from None
