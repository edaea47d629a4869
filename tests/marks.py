"""Marks that several files of tests share."""

import pytest


def slow(*values: object) -> list:
    """Values of `parametrize` that only `make test-all` tries."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow)
        for value in values
    ]
