"""The referee of routes: shortest ways whose length is known in closed form."""

import numpy as np
import pytest

from planners.solids import Solid
from sims.benchmarks.visibility_graph import shortest_way


def test_an_empty_plane_is_crossed_straight() -> None:
    length, way = shortest_way([], [0, 0], [3, 4])
    assert length == 5
    assert way.tolist() == [[0, 0], [3, 4]]


def test_round_a_disc_two_tangents_and_an_arc() -> None:
    radius, far = 1.5, 4.0
    length, _ = shortest_way([Solid.ball([0, 0], 1.0)], [-far, 0], [far, 0], 0.5, 720)
    tangent = np.sqrt(far**2 - radius**2)
    arc = radius * (np.pi - 2 * np.arccos(radius / far))
    assert length == pytest.approx(2 * tangent + arc, rel=1e-5)
    assert length <= 2 * tangent + arc


def test_round_the_corners_of_a_square() -> None:
    square = Solid.box([-1, -1], [1, 1])
    length, way = shortest_way([square], [-3, 0], [3, 0])
    assert length == pytest.approx(2 * np.sqrt(5) + 2)
    assert len(way) == 4
    padded, _ = shortest_way([square], [-3, 0], [3, 0], 0.5, 720)
    # Tangents from (-3, 0) to the disc of 0.5 m at (-1, 1), the arc there, and the top.
    tangent = np.sqrt(5 - 0.25)
    turn = np.arctan2(1, 2) + np.arcsin(0.5 / np.sqrt(5))
    assert padded == pytest.approx(2 * tangent + 2 * 0.5 * turn + 2, rel=1e-5)


def test_a_barred_way_is_infinite() -> None:
    walls = [Solid.box([-1, -10], [0, 10])]
    bounds = ([-5, -5], [5, 5])
    assert np.isinf(shortest_way(walls, [-3, 0], [3, 0], bounds=bounds)[0])
    assert np.isfinite(shortest_way(walls, [-3, 0], [3, 0])[0])
    assert np.isinf(shortest_way(walls, [-0.5, 0], [3, 0])[0])
