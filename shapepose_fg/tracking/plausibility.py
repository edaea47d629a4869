"""Find joints that cannot belong to a person: farther from their neighbours than any
bone is long.
"""

import numpy as np

from shapepose_fg.core.compiled import part


@part
def find_implausible(
    places, trusted, views, longest_m, parents, reach_m, above, way_m, count, too_long, implausible
):
    """Fill in `implausible` (J,): joints to remove so that no bone of the person is longer than
    `longest_m` (J,).

    `places` (J, S) begin with positions; only `trusted` (J,) joints are checked. Of a bone that is
    too long, the end with the larger share of too long bones is removed; on a tie, the one seen by
    fewer `views` (J,). This repeats until no bone is too long. `above`, `way_m`, `count` and
    `too_long` (J,) are workspace.

    If its parent is not checked, a joint is compared with the next checked joint above it, over the
    sum of the bones between; without one, with the first checked joint of the person, since legs
    below an unseen pelvis may be another person's. Such a joint is removed if it is `reach_m`
    farther than the bones allow; a smaller excess is left to the body fit.
    """
    joints, worst = len(trusted), 0
    implausible[:] = False
    while worst >= 0:
        _judged_above(trusted, implausible, longest_m, parents, above, way_m, count, too_long)
        for j in range(joints):
            i = above[j]
            if i == j or not trusted[j] or implausible[j]:
                continue
            bone, squared = i == parents[j], 0.0
            for x in range(3):
                squared += (places[j, x] - places[i, x]) ** 2
            long = np.sqrt(squared) > way_m[j] + (0.0 if bone else reach_m)
            if bone or long:
                count[j] += 1
                too_long[j] += long
            if bone:
                count[i] += 1
                too_long[i] += long
        worst, most = -1, 0.0
        for j in range(joints):
            # This term only breaks ties: shares of a joint's few bones differ by more.
            share = too_long[j] / count[j] + 0.1 / (1.0 + views[j])
            if too_long[j] > 0 and share > most:
                worst, most = j, share
        if worst >= 0:
            implausible[worst] = True


@part
def _judged_above(trusted, implausible, longest_m, parents, above, way_m, count, too_long):
    """For each joint, the nearest checked joint `above` it (J,), and the longest possible distance
    to it, m (J,).

    A joint with none above it gets the first checked one, by way of the root; that one gets itself.
    """
    first, top_m = -1, 0.0
    for j in range(len(parents)):
        above[j], way_m[j], count[j], too_long[j] = j, 0.0, 0.0, 0.0
        while above[j] >= 0 and (above[j] == j or not trusted[above[j]] or implausible[above[j]]):
            if parents[above[j]] >= 0:
                way_m[j] += longest_m[above[j]]
            above[j] = parents[above[j]]
        if above[j] < 0 and first < 0 and trusted[j] and not implausible[j]:
            first, top_m = j, way_m[j]
    for j in range(len(parents)):
        if above[j] < 0:
            above[j] = first
            way_m[j] += top_m
