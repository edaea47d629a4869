"""Batches of 3x3 matrices, for which LAPACK goes one by one."""

import torch
from torch import Tensor


def inverse_3x3(matrix: Tensor) -> Tensor:
    """Inverses (..., 3, 3) by cross products of the rows; a singular matrix gives infinities, not an error."""
    a, b, c = matrix.unbind(-2)
    columns = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    determinant = (a * columns[..., 0]).sum(-1)
    return columns / determinant[..., None, None]
