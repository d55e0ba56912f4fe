"""Solids: bad input is refused with a clear error before Drake sees it."""

import numpy as np
import pytest

from ocp.obstacle import Obstacle
from planners.solids import Shape, Solid

SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Solid.ball([0, np.nan], 1), "center"),
        (lambda: Solid.ball([0, np.inf], 1), "center"),
        (lambda: Solid.ball([0], 1), "center"),
        (lambda: Solid.ball([0, 0], 0), "radius"),
        (lambda: Solid.ball([0, 0], -1), "radius"),
        (lambda: Solid.ball([0, 0], np.nan), "radius"),
        (lambda: Solid.polygon([]), "vertices"),
        (lambda: Solid.polygon([[0, 0], [1, 0]]), "vertices"),
        (lambda: Solid.polygon([[0, 0], [1, 0], [np.nan, 1]]), "vertices"),
        (lambda: Solid.polygon([[0, 0], [2, 0], [1, 0.2], [1, 2]]), "convex"),
        (lambda: Solid.polygon([[0, 0], [1, 1], [1, 0], [0, 1]]), "convex"),
        (lambda: Solid.polygon([[0, 0], [1, 0], [2, 0]]), "convex"),
        (lambda: Solid.box([0, 0, 0], [1, 1, 0]), "upper"),
        (lambda: Solid.box([0, 0, 0], [1, 1]), "upper"),
        (lambda: Solid.box([0, 0, 0], [1, 1, np.inf]), "upper"),
        (lambda: Solid.hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), "interior"),
        (lambda: Solid.hull([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), "points"),
        (lambda: Solid.hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, np.nan]]), "points"),
        (lambda: Solid.of("wall"), "obstacle"),  # pyright: ignore[reportArgumentType]
        (lambda: Solid.ball([0, 0], 1).moved([1, np.nan]), "translation"),
        (lambda: Solid.ball([0, 0], 1).moved([1, 0, 0]), "translation"),
        (lambda: Solid.ball([0, 0], 1).moved([1, 0], np.inf), "rotation"),
        (lambda: Solid.ball([0, 0, 0], 1).moved([1, 0, 0], 2 * np.eye(3)), "rotation"),
        (lambda: Solid.ball([0, 0, 0], 1).moved([1, 0, 0], 0.3), "rotation"),
    ],
)
def test_what_is_no_solid_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_query_s_obstacles_become_solids() -> None:
    diamond = Solid.of(Obstacle.diamond([1, 2], 0.5))
    assert diamond.shape is Shape.POLYGON
    assert np.allclose(diamond.vertices.mean(axis=0), [1, 2])
    assert Solid.of(Obstacle.circle([1, 2], 0.5)).reach == 0.5


def test_moving_turns_about_the_centre() -> None:
    moved = Solid.polygon(SQUARE).moved([1, 0], np.pi / 4)
    assert np.allclose(moved.center, [1.5, 0.5])
    assert np.isclose(moved.vertices[:, 1].max(), 0.5 + np.sqrt(0.5))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    box = Solid.box([0, 0, 0], [4, 2, 1]).moved([0, 0, 0], quarter)
    assert np.allclose(box.vertices.min(axis=0), [1, -1, 0])


def test_sides_and_facets_of_a_box() -> None:
    box = Solid.box([0, 0, 0], [1, 2, 3])
    lengths = np.linalg.norm(box.sides[:, 1] - box.sides[:, 0], axis=1)
    assert {1.0, 2.0, 3.0} <= set(lengths.round(12))
    inside = box.facets @ np.array([0.5, 1.0, 1.5, 1.0])
    assert inside.max() == pytest.approx(-0.5)
