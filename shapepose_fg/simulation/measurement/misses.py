"""Why joints are missed: hidden people are missed as wholes, and some are lost without anybody before them.

Misses are told on a probit scale, on which causes add up.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, owens_t

BURIED = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.7])
"""Lower edges of classes: the share of a person's joints in a view that others hide."""
FREE = 0.1
"""Of whom less than this is hidden by others stands free."""
ENOUGH = 8
"""Visible joints of a person in a view that tell whether the person is lost there."""
LOST = (0.5, 0.8)
"""A person of whom more than this share of the visible joints is missed is half lost, or wholly."""
PRIOR = 20
"""All joints together count as this many cases of each of them."""
STATES = 3


def is_lost(expected: dict[str, NDArray], state: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """(M,) whether a joint's person is half lost in its view; shares (2,) of people half, and wholly, lost."""
    key = expected["person"] * 64 + expected["view"]
    rows, row = np.unique(key, return_inverse=True)
    free = (state == 0) & (expected["buried"] < FREE)
    count = np.bincount(row[free], minlength=len(rows))
    missed = np.bincount(row[free & ~expected["hit"]], minlength=len(rows)) / np.maximum(count, 1)
    known = count >= ENOUGH
    shares = [float((missed[known] > least).mean()) for least in LOST]
    return (known & (missed > LOST[0]))[row], np.array(shares)


def miss_tables(expected: dict[str, NDArray], state: NDArray, group: NDArray, groups: int) -> dict[str, Any]:
    """Share missed (G, 3) by joint and state of people who stand free; how much more where others hide them.

    Joint and state have one probit, the hidden share adds `buried` (B,) to it where the joint is visible or hidden
    by another; the two are fitted in turns. Lost people are told separately: `lost` (2,), half and wholly.
    """
    lost, shares = is_lost(expected, state)
    kept = (state >= 0) & ~lost
    which = np.searchsorted(BURIED, expected["buried"], side="right") - 1
    cell = (group * STATES + state) * len(BURIED) + which
    size = (groups, STATES, len(BURIED))
    count = np.bincount(cell[kept], minlength=int(np.prod(size))).reshape(size).astype(float)
    missed = np.bincount(cell[kept & ~expected["hit"]], minlength=int(np.prod(size))).reshape(size).astype(float)
    cases = np.maximum(count.sum(axis=(0, 2)), 1.0)[:, None]
    missed, count = (table + PRIOR * table.sum(axis=0) / cases for table in (missed, count))
    shift, used = np.zeros(len(BURIED)), np.array([1.0, 0.0, 1.0])
    own = np.zeros(size[:2])
    for _ in range(8):
        added = used[:, None] * shift
        own = _solve(lambda x, add=added: (count * ndtr(x[..., None] + add)).sum(axis=-1), missed.sum(axis=-1))
        both = count * used[:, None]
        shift = _solve(
            lambda x, at=own, n=both: (n * ndtr(at[..., None] + x)).sum(axis=(0, 1)),
            (missed * used[:, None]).sum(axis=(0, 1)),
        )
        shift = np.maximum.accumulate(shift - shift[0])
    inside = [expected["buried"][kept & (which == b)] for b in range(len(BURIED))]
    return {
        "miss": np.round(ndtr(own), 4).tolist(),
        "buried_share": [0.0] + [round(float(part.mean()), 3) for part in inside[1:]],
        "buried": np.round(shift, 3).tolist(),
        "lost": np.round(shares, 4).tolist(),
    }


def _solve(rising, wanted: NDArray) -> NDArray[np.float64]:
    """Where each rising function takes its wanted value, between -4 and 4, by halving."""
    low, high = np.full(wanted.shape, -4.0), np.full(wanted.shape, 4.0)
    for _ in range(40):
        middle = (low + high) / 2
        above = rising(middle) > wanted
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return (low + high) / 2


def tetrachoric(correlation: NDArray, share: float) -> NDArray[np.float64]:
    """Of two normal values, when being among the lowest `share` correlates so."""
    at = np.concatenate([np.linspace(0.0, 0.9, 19), [0.93, 0.96, 0.98, 0.99, 0.999]])
    low = ndtri(share)
    # Both below the same `low`: Owen (1956).
    both = share - 2 * owens_t(low, np.sqrt((1 - at) / (1 + at)))
    phi = (both - share**2) / (share * (1 - share))
    return np.interp(correlation, phi, at)
