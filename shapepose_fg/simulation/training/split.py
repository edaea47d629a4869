"""Which recorded subjects train, which choose settings, and on which figures are reported: fixed for good."""

import hashlib
from typing import Literal, get_args

Split = Literal["train", "validation", "test"]

SPLITS: tuple[Split, ...] = get_args(Split)
"""The three parts: learn from the first, choose by the second, report the third."""

TEST_SUBJECTS = ("60", "61", "02", "08", "16", "43", "94", "139")
"""CMU subjects for reported figures only: salsa (both partners), sports and chores, walks, runs and jumps, a bar,
Indian dance, getting up."""
VALIDATION_SUBJECTS = ("06", "12", "127", "140")
"""CMU subjects on which settings are chosen: basketball, walks, runs and ducks, getting up from the floor."""
UNKNOWN_SUBJECT = "?"
"""A recording without a subject: used for training, never for what is reported."""

_CMU_LAST_SUBJECT = 144
_TENTHS: tuple[Split, ...] = ("train",) * 8 + ("validation", "test")


def split_of(subject: str) -> Split:
    """Which part a `subject` belongs to.

    CMU's subjects are known by their numbers, written as CMU writes them ("02", "139"): a copy of the same
    recordings in another collection keeps its place. Everybody else goes by a stable hash of the name, 8 : 1 : 1.
    """
    if subject in TEST_SUBJECTS:
        return "test"
    if subject in VALIDATION_SUBJECTS:
        return "validation"
    if subject == UNKNOWN_SUBJECT or _is_cmu(subject):
        return "train"
    return _TENTHS[hashlib.sha256(subject.encode()).digest()[0] % 10]


def _is_cmu(subject: str) -> bool:
    """Whether the name is one of CMU's numbers: two digits at least, 144 at most."""
    return subject.isascii() and subject.isdigit() and len(subject) >= 2 and int(subject) <= _CMU_LAST_SUBJECT
