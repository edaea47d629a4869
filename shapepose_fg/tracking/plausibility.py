"""Which joints cannot be a person's own: those that are farther from their neighbours than any bone is long."""

import numpy as np

from shapepose_fg.core.compiled import part


@part
def tear(places, trusted, views, longest_m, parents, reach_m, above, way_m, count, too_long, torn):
    """Fill in `torn` (J,): joints without which no bone of a person is longer than `longest_m` (J,).

    `places` (J, S) begin with positions; only joints that are `trusted` (J,) are judged. Of two ends of a bone
    the one goes of which the larger share of bones is too long, of equals the one that fewer `views` (J,) see; and
    so on until nothing is too long. `above`, `way_m`, `count` and `too_long` (J,) are room to work in.

    A joint whose parent is not judged is judged by the next such joint above it, with the bones between added up;
    where there is none, by the first of the person: legs below a pelvis that nobody sees may be another's. It goes
    where it is `reach_m` farther than bones are long: nearer, whole bodies put it right.
    """
    joints, worst = len(trusted), 0
    torn[:] = False
    while worst >= 0:
        _judged_above(trusted, torn, longest_m, parents, above, way_m, count, too_long)
        for j in range(joints):
            i = above[j]
            if i == j or not trusted[j] or torn[j]:
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
            # The doubt is less than any difference of shares of a joint's few bones.
            share = too_long[j] / count[j] + 0.1 / (1.0 + views[j])
            if too_long[j] > 0 and share > most:
                worst, most = j, share
        if worst >= 0:
            torn[worst] = True


@part
def _judged_above(trusted, torn, longest_m, parents, above, way_m, count, too_long):
    """For each joint the nearest one `above` (J,) it that is judged, and the longest way there, metres (J,).

    Joints with none above them have the first of these, by way of the root; that one has itself.
    """
    first, top_m = -1, 0.0
    for j in range(len(parents)):
        above[j], way_m[j], count[j], too_long[j] = j, 0.0, 0.0, 0.0
        while above[j] >= 0 and (above[j] == j or not trusted[above[j]] or torn[above[j]]):
            if parents[above[j]] >= 0:
                way_m[j] += longest_m[above[j]]
            above[j] = parents[above[j]]
        if above[j] < 0 and first < 0 and trusted[j] and not torn[j]:
            first, top_m = j, way_m[j]
    for j in range(len(parents)):
        if above[j] < 0:
            above[j] = first
            way_m[j] += top_m
