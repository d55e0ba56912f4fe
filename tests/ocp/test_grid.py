"""Grids, and the multilinear value on them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references import typical_query

from ocp.grid import MAX_DIMENSION, Grid, GridValue
from ocp.models import MODELS, get_model
from ocp.query import Goal, Query

SMALL_MODELS = [name for name in MODELS if get_model(name).n <= MAX_DIMENSION]


def random_grid(rng: np.random.Generator, n: int) -> Grid:
    lower = rng.uniform(-3, 0, n)
    return Grid(
        tuple(lower),
        tuple(lower + rng.uniform(0.5, 4, n)),
        tuple(map(int, rng.integers(3, 7, n))),
        tuple(map(bool, rng.integers(0, 2, n))),
    )


def random_value(rng: np.random.Generator, n: int) -> GridValue:
    grid = random_grid(rng, n)
    return GridValue(grid, rng.uniform(0, 10, grid.shape))


def points_in(grid: Grid, rng: np.random.Generator, count: int = 50) -> np.ndarray:
    return rng.uniform(grid.lower, grid.upper, (count, grid.dimension))


dimensions = st.integers(1, MAX_DIMENSION)
seeds = st.integers(0, 10_000)


def test_a_periodic_axis_does_not_repeat_its_end_node() -> None:
    grid = Grid((0.0, 0.0), (1.0, 1.0), (5, 5), (False, True))
    np.testing.assert_allclose(grid.axes[0], [0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(grid.axes[1], [0, 0.2, 0.4, 0.6, 0.8])
    assert grid.size == 25
    assert grid.nodes().shape == (5, 5, 2)
    np.testing.assert_allclose(grid.nodes()[2, 3], [0.5, 0.6])


def test_strides_number_the_nodes_in_row_major_order() -> None:
    grid = Grid((0.0,) * 3, (1.0,) * 3, (3, 4, 5), (False,) * 3)
    assert grid.strides.tolist() == [20, 5, 1]


@pytest.mark.parametrize("model", SMALL_MODELS)
@pytest.mark.parametrize("nodes", [5_000, 50_000])
def test_for_query_has_about_as_many_nodes_as_asked(model: str, nodes: int) -> None:
    grid = Grid.for_query(typical_query(model), nodes)
    half = max(0.5 / n for n in grid.shape)  # what rounding one axis may change
    assert abs(grid.size / nodes - 1) < 1.1 * half * grid.dimension


def test_the_unicycle_has_as_many_radians_as_metres_a_cell_and_half_the_headings() -> None:
    query = Query("unicycle", Goal((1.0, 1.0), 0.5))
    grid = Grid.for_query(query, 60_000)
    assert grid.spacing.max() / grid.spacing.min() < 1.05
    assert grid.upper[2] - grid.lower[2] == pytest.approx(np.pi)
    bounded = Query("unicycle", Goal((1.0, 1.0), 0.5), input_lower=(-1, -1), input_upper=(1, 1))
    full = Grid.for_query(bounded, 60_000)  # V is no longer symmetric
    assert full.upper[2] - full.lower[2] == pytest.approx(2 * np.pi)


def test_margin_widens_position_axes_alone() -> None:
    system = get_model("unicycle")
    grid = Grid.of(system, (11, 11, 8), margin=0.5)
    assert grid.lower[:2] == (-5.5, -5.5)
    assert grid.upper[2] == pytest.approx(np.pi)


@given(dimensions, seeds)
def test_refining_keeps_the_nodes(n: int, seed: int) -> None:
    grid = random_grid(np.random.default_rng(seed), n)
    fine = grid.refined(2)
    np.testing.assert_allclose(fine.spacing, grid.spacing / 2)
    np.testing.assert_allclose(fine.nodes()[(slice(None, None, 2),) * n], grid.nodes())


@given(dimensions, seeds)
def test_interpolation_is_exact_for_multilinear_functions(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    free = ~np.array(grid.periodic)  # a periodic function can only be constant along its axis
    terms = [(rng.normal(), rng.integers(0, 2, n) * free) for _ in range(5)]

    def function(x: np.ndarray) -> np.ndarray:
        parts = [c * np.prod(np.where(mask, x, 1.0), axis=-1) for c, mask in terms]
        return np.sum(parts, axis=0)

    value = GridValue(grid, function(grid.nodes()))
    x = points_in(grid, rng)
    np.testing.assert_allclose(value.value(x), function(x), rtol=0, atol=1e-12)


@given(dimensions, seeds)
def test_the_value_at_a_node_is_the_nodes(n: int, seed: int) -> None:
    value = random_value(np.random.default_rng(seed), n)
    np.testing.assert_allclose(value.value(value.grid.nodes()), value.values, rtol=1e-9)


@given(dimensions, seeds)
def test_a_value_lies_between_its_nodes(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value = random_value(rng, n)
    between = value.value(points_in(value.grid, rng))
    assert (
        value.values.min() - 1e-12 <= between.min() <= between.max() <= value.values.max() + 1e-12
    )


@given(dimensions, seeds, st.integers(-3, 3))
def test_periodic_axes_wrap(n: int, seed: int, turns: int) -> None:
    rng = np.random.default_rng(seed)
    value = random_value(rng, n)
    grid = value.grid
    x = points_in(grid, rng)
    period = np.where(grid.periodic, np.subtract(grid.upper, grid.lower), 0.0)
    np.testing.assert_allclose(value.value(x + turns * period), value.value(x), atol=1e-9)


@given(dimensions, seeds)
def test_the_gradient_is_exact_for_quadratic_functions(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-3, 0, n)
    upper = lower + rng.uniform(0.5, 4, n)
    grid = Grid(tuple(lower), tuple(upper), (7,) * n, (False,) * n)
    A, b = rng.normal(size=(n, n)), rng.normal(size=n)
    nodes = grid.nodes()
    value = GridValue(grid, np.einsum("...i,ij,...j", nodes, A, nodes) + nodes @ b)
    x = rng.uniform(lower + grid.spacing, upper - grid.spacing, (50, n))
    np.testing.assert_allclose(value.gradient(x), x @ (A + A.T) + b, atol=1e-9)


def test_the_gradient_is_of_second_order_and_wraps() -> None:
    errors = []
    x = np.random.default_rng(0).uniform(0, 7, (200, 1))
    for count in (20, 40):
        grid = Grid((0.0,), (2 * np.pi,), (count,), (True,))
        value = GridValue(grid, np.sin(grid.axes[0]))
        errors.append(abs(value.gradient(x) - np.cos(x)).max())
    assert 3.5 < errors[0] / errors[1] < 4.5


@given(dimensions, seeds)
def test_infinite_nodes_never_make_nan(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value = random_value(rng, n)
    values = np.where(rng.random(value.grid.shape) < 0.3, np.inf, value.values)
    blocked = GridValue(value.grid, values)
    x = np.concatenate([points_in(value.grid, rng), value.grid.nodes().reshape(-1, n)])
    assert not np.isnan(blocked.value(x)).any()
    assert np.isfinite(blocked.gradient(x)).all()


def test_a_cell_with_an_infinite_corner_is_infinite_and_its_finite_nodes_are_not() -> None:
    grid = Grid((0.0, 0.0), (2.0, 2.0), (3, 3), (False, False))
    values = np.ones(grid.shape)
    values[0, 0] = np.inf
    value = GridValue(grid, values)
    assert value.value([0.5, 0.5]) == np.inf
    assert value.value([0.0, 1.0]) == 1.0
    assert value.value([0.0, 1.0 - 1e-13]) == 1.0  # rounding does not reach over to the corner
    assert value.value([1.5, 0.5]) == 1.0


def test_outside_the_box_the_value_is_infinite_and_the_gradient_that_of_the_edge() -> None:
    grid = Grid((0.0, 0.0), (1.0, 1.0), (3, 3), (False, False))
    value = GridValue(grid, grid.nodes()[..., 0] * 2 + grid.nodes()[..., 1])
    assert value.value([1.01, 0.5]) == np.inf
    assert value.value([1.0, 1.0]) == pytest.approx(3.0)
    np.testing.assert_allclose(value.gradient([7.0, -3.0]), [2.0, 1.0])
    assert not grid.contains([1.01, 0.5])
    assert grid.contains([1.0, 0.5])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"shape": (2, 5)}, "grid.shape"),
        ({"shape": (5,) * 5}, "grid.shape"),
        ({"lower": (0.0,)}, "grid.lower"),
        ({"upper": (0.0, 1.0)}, "bounds"),
        ({"upper": (np.inf, 1.0)}, "bounds"),
    ],
)
def test_bad_grids_are_refused(change: dict, field: str) -> None:
    good = {"lower": (0.0, 0.0), "upper": (1.0, 1.0), "shape": (5, 5), "periodic": (False, False)}
    with pytest.raises(ValueError, match=field):
        Grid(**{**good, **change})


def test_bad_requests_are_refused() -> None:
    grid = Grid((0.0, 0.0), (1.0, 1.0), (5, 5), (False, False))
    value = GridValue(grid, np.zeros(grid.shape))
    with pytest.raises(ValueError, match=r"\[\.\.\., 2\]"):
        value.value([1.0])
    with pytest.raises(ValueError, match="finite"):
        value.value([np.nan, 0.0])
    with pytest.raises(ValueError, match="shape"):
        GridValue(grid, np.zeros((5, 4)))
    with pytest.raises(ValueError, match="NaN"):
        GridValue(grid, np.full(grid.shape, np.nan))
    with pytest.raises(ValueError, match="at most 4"):
        Grid.for_query(typical_query("double-integrator-3d"), 1000)
    with pytest.raises(ValueError, match=r"grid\.nodes"):
        Grid.for_query(typical_query("unicycle"), 10)
    with pytest.raises(ValueError, match="half-turn"):
        Grid.of(get_model("rover"), (3,) * 4, half_turn=True)
