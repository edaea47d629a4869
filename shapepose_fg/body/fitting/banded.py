"""Linear systems of a chain: rows that hang together with the next two and the one after, batched over chains."""

import torch
from torch import Tensor


def solve_banded(diagonal: Tensor, next_one: Tensor, next_two: Tensor, right: Tensor) -> Tensor:
    """X (T, G, N, K) with H X = `right`, for G symmetric positive definite H of T blocks each.

    Block elimination along the chain: time and memory grow with T, not with its square. A chain that is shorter
    than T has identity blocks and no coupling at its end.

    Parameters
    ----------
    diagonal: (T, G, N, N) blocks H_tt; is overwritten.
    next_one: (T, G, N) diagonal of H_t,t+1, which is a diagonal matrix; of the last row nothing is used.
    next_two: (T, G, N) the same of H_t,t+2.
    right: (T, G, N, K); is overwritten.
    """
    T, _, N, _ = diagonal.shape
    lower, upper = [], []
    coupling = torch.diag_embed(next_one[0])
    for t in range(T):
        factor = torch.linalg.cholesky_ex(diagonal[t])[0]
        beyond = torch.diag_embed(next_two[t])
        solved = torch.linalg.solve_triangular(factor, torch.cat((coupling, beyond, right[t]), -1), upper=False)
        right[t] = solved[..., 2 * N :]
        lower.append(factor)
        upper.append(solved[..., : 2 * N])
        if t + 1 < T:
            fill = solved[..., : 2 * N].mT @ solved
            diagonal[t + 1] -= fill[:, :N, :N]
            right[t + 1] -= fill[:, :N, 2 * N :]
            coupling = torch.diag_embed(next_one[t + 1]) - fill[:, :N, N : 2 * N]
        if t + 2 < T:
            diagonal[t + 2] -= fill[:, N:, N : 2 * N]
            right[t + 2] -= fill[:, N:, 2 * N :]
    nothing = torch.zeros_like(right[0])
    for t in range(T - 1, -1, -1):
        ahead = [right[s] if s < T else nothing for s in (t + 1, t + 2)]
        rest = right[t] - upper[t] @ torch.cat(ahead, -2)
        right[t] = torch.linalg.solve_triangular(lower[t].mT, rest, upper=True)
    return right
