"""Inputs to try: where a search over controls begins before it is refined."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from ocp.query import Query

CIRCLE = 16  # directions sampled in a plane of inputs
SIZES = 5  # of an input along a ray
RATIO = 3.0  # between one size and the next


def unit_directions(m: int, count: int = CIRCLE) -> NDArray[np.float64]:
    """Unit vectors `[k, m]` spread over the sphere: `count` in the plane, else 3^m - 1."""
    if m == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.column_stack([np.cos(angles), np.sin(angles)]).round(15)  # zeros are zeros
    lattice = np.array([c for c in product((-1.0, 0.0, 1.0), repeat=m) if any(c)])
    return lattice / np.linalg.norm(lattice, axis=1, keepdims=True)


def sampled_inputs(
    query: Query, circle: int = CIRCLE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inputs to try `[k, m]`, and how far a refinement should first look to their sides, `[m]`.

    For a time-free query: on u' R u = 1, sides as angles. Otherwise 0 and rays of geometric sizes
    within the bounds; an unbounded input is sampled up to 16 sqrt(goal weight / R). In a plane of
    inputs there are `circle` directions.
    """
    weights = query.input_weights
    m = len(weights)
    directions = unit_directions(m, circle)
    if query.is_time_free:
        gap = 2 * np.pi / circle if m == 2 else 0.6
        return np.ascontiguousarray(directions / np.sqrt(weights)), np.full(m, gap)
    lower, upper = query.input_bounds
    reach = np.maximum(abs(lower), abs(upper))
    unbounded = 16 * np.sqrt(max(query.cost.goal, 1e-6) / weights)
    largest = np.where(np.isfinite(reach), reach, unbounded)
    corners = directions / abs(directions).max(axis=1, keepdims=True)
    rays = [corners * largest * RATIO**-k for k in range(SIZES)]
    inputs = np.clip(np.concatenate([np.zeros((1, m)), *rays]), lower, upper)
    return np.unique(inputs, axis=0), largest * RATIO ** (1 - SIZES)
