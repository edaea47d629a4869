"""Probabilities of the states of hidden Markov models, by the forward-backward algorithm."""

import numpy as np

from shapepose_fg.core.arrays import Array


def state_probabilities(
    likelihood: Array, first: Array, turns: Array
) -> tuple[Array, Array, Array]:
    """(T, C, K) probabilities of K states at T moments of C sequences, given the observations of
    all moments; those given the observations up to each moment; and likelihoods of the
    observations after it. The last two are up to a factor.

    `likelihood` (T, C, K) of each moment's observation, up to a factor; `first` (K,) probabilities
    of the first state, `turns` (T - 1, K, K) of the next state (last axis) given the present one.
    """
    forward, later = np.empty_like(likelihood), np.ones_like(likelihood)
    forward[0] = first * likelihood[0]
    for t in range(1, len(likelihood)):
        unnormalised = forward[t - 1] @ turns[t - 1] * likelihood[t]
        forward[t] = unnormalised / unnormalised.sum(axis=1, keepdims=True)
    for t in range(len(likelihood) - 2, -1, -1):
        unnormalised = (likelihood[t + 1] * later[t + 1]) @ turns[t].T
        later[t] = unnormalised / unnormalised.sum(axis=1, keepdims=True)
    both = forward * later
    return both / both.sum(axis=2, keepdims=True), forward, later
