"""The cubic spline through a grid's values: exact on lines, of fourth order, smooth, periodic."""

import numpy as np
import pytest

from ocp.grid import Grid, GridValue
from ocp.grids.spline import SplineValue


def wave(states: np.ndarray) -> np.ndarray:
    x, y, angle = np.moveaxis(states, -1, 0)
    return np.sin(x) * np.cos(0.7 * y) + np.cos(angle) * (1 + 0.3 * x)


def spline(count: int, field=wave) -> SplineValue:
    grid = Grid(
        (-2.0, -2.0, -np.pi), (2.0, 2.0, np.pi), (count, count, count), (False, False, True)
    )
    return SplineValue(GridValue(grid, field(grid.nodes())))


def inner(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([-1.2, -1.2, -9.0], [1.2, 1.2, 9.0], (count, 3))


def test_it_passes_through_the_nodes() -> None:
    found = spline(9)
    np.testing.assert_allclose(found.value(found.grid.nodes()), found.on_grid.values, atol=1e-12)


def test_it_is_exact_for_lines_inside_the_box_and_beyond_it() -> None:
    found = spline(8, lambda s: 2 * s[..., 0] - 3 * s[..., 1] + 1)
    states = np.random.default_rng(0).uniform(-4, 4, (50, 3))
    np.testing.assert_allclose(
        found.value(states), 2 * states[:, 0] - 3 * states[:, 1] + 1, atol=1e-7
    )


def test_value_and_gradient_converge_with_orders_four_and_three() -> None:
    states = inner(np.random.default_rng(1), 300)
    values, slopes = [], []
    for count in (24, 48, 96):
        found, h = spline(count), 1e-6
        values.append(np.abs(found.value(states) - wave(states)).max())
        shift = h * np.eye(3)
        exact = [(wave(states + s) - wave(states - s)) / (2 * h) for s in shift]
        slopes.append(np.abs(found.gradient(states) - np.stack(exact, axis=-1)).max())
    np.testing.assert_allclose(np.log2(np.divide(values[:-1], values[1:])), 4.0, atol=0.6)
    np.testing.assert_allclose(np.log2(np.divide(slopes[:-1], slopes[1:])), 3.0, atol=0.6)


def test_the_gradient_belongs_to_the_value_across_cells() -> None:
    found, h = spline(9), 1e-5
    states = np.concatenate(
        [found.grid.nodes().reshape(-1, 3)[::11], inner(np.random.default_rng(2), 50)]
    )
    states = states[(np.abs(states[:, :2]) < 1.99).all(axis=1)]
    for i, shift in enumerate(h * np.eye(3)):
        difference = (found.value(states + shift) - found.value(states - shift)) / (2 * h)
        np.testing.assert_allclose(found.gradient(states)[:, i], difference, atol=1e-8)


def test_it_is_periodic() -> None:
    found, states = spline(9), inner(np.random.default_rng(3), 20)
    turned = states + np.array([0, 0, 2 * np.pi])
    np.testing.assert_allclose(found.value(turned), found.value(states), atol=1e-12)


def test_infinite_values_are_refused() -> None:
    grid = Grid((0.0,), (1.0,), (9,), (False,))
    values = np.zeros(9)
    values[3] = np.inf
    with pytest.raises(ValueError, match="finite values"):
        SplineValue(GridValue(grid, values))
