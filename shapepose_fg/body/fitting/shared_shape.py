"""One person in many frames has one shape: what all rows of a group know of it, put together."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.energy import Held


def shape_precision(factor: Tensor) -> Tensor:
    """(B, 10, 10) what each row by itself knows of its betas, from the Cholesky factor (B, P, P) of its Hessian.

    The Schur complement: the inverse of the betas' block of the Hessian's inverse.
    """
    by_betas = torch.eye(factor.shape[-1], 10, dtype=factor.dtype).expand(len(factor), -1, -1)
    half = torch.linalg.solve_triangular(factor, by_betas, upper=False)
    return torch.linalg.inv(half.mT @ half)


def pooled_betas(
    alone: Tensor, precision: Tensor, pool: NDArray[np.intp], votes: NDArray[np.bool_], held: Held
) -> Tensor:
    """Shapes (B, 10) at which the rows of each `pool` (B,) agree best, to first order; single rows keep their own.

    A row's fit is a Gaussian over its betas: `precision` S (B, 10, 10) around the shape `alone` (B, 10). Taken out
    of it, what the row was held by leaves what its joints said, so that what a pool was held by counts once, not
    once a row:

        (W + sum_i (S_i - W)) b = W c + sum_i (S_i b_i - W c_i)

    with W the stiffness and c_i where row i was held. Bone lengths that were well seen decide. Rows that do not
    vote (B,) take the shape of the others.
    """
    eye = held.stiffness[..., None] * torch.eye(10)
    centre = held.betas.expand(len(alone), 10)
    own = precision - eye
    said = (precision @ alone[..., None] - eye @ centre[..., None]).squeeze(-1)
    _, place = np.unique(pool, return_inverse=True)
    size = np.bincount(place, weights=votes)
    index, used = torch.from_numpy(place), torch.from_numpy(votes)
    count = torch.from_numpy(np.maximum(size, 1)).to(alone.dtype)

    def summed(values: Tensor) -> Tensor:
        zeros = values.new_zeros(len(size), *values.shape[1:])
        return zeros.index_add_(0, index[used], values[used])

    mean_centre = summed(centre) / count[:, None]
    weight = summed(eye.expand_as(own)) / count[:, None, None]
    weight[torch.from_numpy(size == 0)] = torch.eye(10, dtype=weight.dtype)
    right = (weight @ mean_centre[..., None]).squeeze(-1) + summed(said)
    betas = torch.linalg.solve(weight + summed(own), right)[index]
    return torch.where(shared(pool, votes)[:, None], betas, alone)


def shared(pool: NDArray[np.intp], votes: NDArray[np.bool_]) -> Tensor:
    """(B,) which rows take a shape that others of their `pool` (B,) have a part in."""
    _, place = np.unique(pool, return_inverse=True)
    return torch.from_numpy((np.bincount(place, weights=votes)[place] - votes) > 0)


def check_groups(groups: NDArray[np.intp], rows: int) -> NDArray[np.intp]:
    """`groups` if it is one whole number a row; ValueError otherwise."""
    groups = np.asarray(groups)
    if groups.shape != (rows,) or groups.dtype.kind not in "iu":
        raise ValueError(f"groups must be {rows} whole numbers, one a row, got {groups.dtype} {groups.shape}")
    return groups
