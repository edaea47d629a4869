"""One person in many frames has one shape: what all rows of a group know of it, put together."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.energy import Held


def pooled_betas(free: Tensor, hessian: Tensor, groups: NDArray[np.intp], held: Held) -> Tensor:
    """Shapes (B, 10) at which the rows of each group agree best, to first order; single rows keep their own.

    A row's fit is a Gaussian belief about its betas: precision S, the Schur complement of its `hessian` (B, P, P),
    around `free[:, :10]`. Taken out of it, what the row was held by leaves what its joints said, so that what a
    group was held by counts once, not once a row:

        (W + sum_i (S_i - W)) b = W c + sum_i (S_i b_i - W c_i)

    with W the stiffness and c_i where row i was held. Bone lengths that were well seen decide.
    """
    rest = hessian[:, 10:, 10:]
    factor, _ = torch.linalg.cholesky_ex(rest)
    across = hessian[:, 10:, :10]
    precision = hessian[:, :10, :10] - across.mT @ torch.cholesky_solve(across, factor)
    eye = held.stiffness[..., None] * torch.eye(10)
    centre = held.betas.expand(len(free), 10)
    own = precision - eye
    said = (precision @ free[:, :10, None] - eye @ centre[..., None]).squeeze(-1)
    _, place, size = np.unique(groups, return_inverse=True, return_counts=True)
    index = torch.from_numpy(place)
    count = torch.from_numpy(size).to(free.dtype)

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(len(size), *values.shape[1:]).index_add_(0, index, values)

    mean_centre = summed(centre) / count[:, None]
    weight = summed(eye.expand_as(own)) / count[:, None, None]
    right = (weight @ mean_centre[..., None]).squeeze(-1) + summed(said)
    betas = torch.linalg.solve(weight + summed(own), right)[index]
    return torch.where((count[index] > 1)[:, None], betas, free[:, :10])


def shared(groups: NDArray[np.intp]) -> Tensor:
    """(B,) which rows are not alone in their group."""
    _, place, size = np.unique(groups, return_inverse=True, return_counts=True)
    return torch.from_numpy(size[place] > 1)


def check_groups(groups: NDArray[np.intp], rows: int) -> NDArray[np.intp]:
    """`groups` if it is one whole number a row; ValueError otherwise."""
    groups = np.asarray(groups)
    if groups.shape != (rows,) or groups.dtype.kind not in "iu":
        raise ValueError(f"groups must be {rows} whole numbers, one a row, got {groups.dtype} {groups.shape}")
    return groups
