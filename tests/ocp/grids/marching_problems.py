"""Robots and grids that the tests of fast marching share."""

import numpy as np

from ocp.grid import Grid
from ocp.models.linear import linear_system
from ocp.query import Query
from ocp.system import Coordinate, Input, System


def steered(matrix) -> System:
    """p' = B u in a box of 10 m."""
    B = np.asarray(matrix, dtype=float)
    d = len(B)
    coordinates = tuple(Coordinate(f"x{i}", "m", -5.0, 5.0) for i in range(d))
    inputs = tuple(Input(f"u{i}", "1") for i in range(d))
    return linear_system("steered", np.zeros((d, d)), B, coordinates, inputs, tuple(range(d)))


def half(query: Query, *shape: int) -> Grid:
    return Grid.of(query.system, shape, half_turn=True)
