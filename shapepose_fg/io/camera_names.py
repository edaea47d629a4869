"""Which of several names is which camera's."""

import re
from collections.abc import Sequence

_NUMBERS = re.compile(r"\d+")


def match_names(cameras: Sequence[str], names: Sequence[str]) -> list[int] | None:
    """For each camera the place of its name among `names`, which are longer or written differently.

    A camera is told by its own name as a word in another (`walk_Miqus_1_23087` is camera `23087`), or by the
    only number in both (`cam01` is camera `int_cam1`). None where it is not so for every camera, or something else
    could be meant too: then nothing is guessed.
    """
    chosen = _within(cameras, names)
    if chosen is not None:
        return chosen
    wanted, there = _one_number_each(cameras), _one_number_each(names)
    if wanted is None or there is None or not set(wanted) <= set(there):
        return None
    return [there.index(number) for number in wanted]


def _within(cameras: Sequence[str], names: Sequence[str]) -> list[int] | None:
    """For each camera the only name in which its own stands as a word; None where one has none or several."""
    chosen = []
    for camera in cameras:
        word = re.compile(rf"(?<![A-Za-z0-9]){re.escape(camera)}(?![A-Za-z0-9])")
        found = [index for index, name in enumerate(names) if word.search(name) is not None]
        if len(found) != 1:
            return None
        chosen += found
    return chosen if len(set(chosen)) == len(chosen) else None


def _one_number_each(names: Sequence[str]) -> list[int] | None:
    """The only number in each name; None where one has none or several, or two have the same."""
    found = [_NUMBERS.findall(name) for name in names]
    if any(len(each) != 1 for each in found):
        return None
    numbers = [int(each[0]) for each in found]
    return numbers if len(set(numbers)) == len(numbers) else None
