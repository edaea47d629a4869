"""The one exception that a user is meant to read: what is wrong with the input, where, and the cure."""

_LONGEST = 1000
"""Characters of a message: what a file holds in place of a number can be of any length."""


class InputError(ValueError):
    """An input cannot be used; the message is one sentence, in one line, that names file, place and cure."""

    def __init__(self, message: str):
        line = " ".join(message.splitlines())
        if len(line) > _LONGEST:
            line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 3 :]}"
        super().__init__(line)
