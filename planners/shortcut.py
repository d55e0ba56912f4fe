"""Shorter ways over the corners of a way."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from planners.world import World


def shortest_over_corners(
    world: World, points: NDArray[np.float64], padding: float
) -> NDArray[np.float64]:
    """The shortest certified way from the first to the last of `points` `[k, d]` over some of them.

    Lines are taken for free until the shortest way uses them; only then are they certified.
    """
    k = len(points)
    length = np.linalg.norm(points[:, None] - points, axis=2)
    length[np.tril_indices(k)] = np.inf
    known = np.zeros((k, k), dtype=bool)
    while True:
        way = _shortest(length)
        unknown = [(a, b) for a, b in pairwise(way) if not known[a, b]]
        if not unknown:
            return points[way]
        first, second = np.array(unknown).T
        free = world.certify(points[first], points[second], padding)
        known[first, second] = True
        length[first[~free], second[~free]] = np.inf


def _shortest(length: NDArray[np.float64]) -> list[int]:
    """The shortest way from the first node to the last; `length` `[k, k]` is upper triangular."""
    k = len(length)
    cost, following = np.full(k, np.inf), np.full(k, -1)
    cost[-1] = 0.0
    for i in range(k - 2, -1, -1):
        through = length[i] + cost
        following[i] = int(np.argmin(through))
        cost[i] = through[following[i]]
    way = [0]
    while way[-1] != k - 1:
        way.append(int(following[way[-1]]))
    return way
