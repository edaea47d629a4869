"""The one exception that a user is meant to read: what is wrong with the input, where, and the cure."""


class InputError(ValueError):
    """An input cannot be used; the message is one sentence that names the file, the place and the cure."""
