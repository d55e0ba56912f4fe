"""Shorter ways over the corners of a way."""

import numpy as np
from numpy.typing import NDArray

from planners.world import World


def shortest_over_corners(
    world: World, points: NDArray[np.float64], padding: float
) -> NDArray[np.float64]:
    """The shortest certified way from the first to the last of `points` `[k, d]` over some of them.

    Every straight line between two of the points is certified: k (k - 1) / 2 questions.
    """
    k = len(points)
    first, second = np.triu_indices(k, 1)
    free = world.certify(points[first], points[second], padding)
    length = np.full((k, k), np.inf)
    length[first[free], second[free]] = np.linalg.norm(
        points[first[free]] - points[second[free]], axis=1
    )
    cost, following = np.full(k, np.inf), np.full(k, -1)
    cost[-1] = 0.0
    for i in range(k - 2, -1, -1):
        through = length[i] + cost
        following[i] = int(np.argmin(through))
        cost[i] = through[following[i]]
    way = [0]
    while following[way[-1]] >= 0:
        way.append(int(following[way[-1]]))
    return points[way]
