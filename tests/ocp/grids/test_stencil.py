"""The stencil of the semi-Lagrangian scheme."""

from collections import Counter

import numpy as np
import pytest
from references import typical_query

from ocp.grid import Grid
from ocp.grids.input_samples import unit_directions
from ocp.grids.stencil import cost_stencil, flat_strides, simplices, stencil
from ocp.query import Goal, Query

MODELS = ["unicycle", "single-integrator-1d", "single-integrator-2d", "single-integrator-3d"]


def made(model: str, reach: int = 2):
    query = typical_query(model)
    grid = Grid.for_query(query, 3000)
    return query, grid, stencil(query, grid, 16, reach)


@pytest.mark.parametrize("reach", [1, 2])
@pytest.mark.parametrize("model", MODELS)
def test_feet_are_the_ends_of_motions(model: str, reach: int) -> None:
    """Each lies on a face of the box of `reach` cells (one cell along a single input) and is the
    mean of its corners; a straight motion's length is its displacement's in the R-norm."""
    query, _, feet = made(model, reach)
    mean = (feet.node_weight[..., None] * feet.corners).sum(axis=2)
    np.testing.assert_allclose(mean, feet.foot, atol=1e-6)
    np.testing.assert_allclose(feet.node_weight.sum(axis=2), 1.0, atol=1e-12)
    longest = np.full(len(feet.directions), float(reach))
    if reach > 1:
        longest[-2 * query.system.m :] = 1.0
    np.testing.assert_allclose(abs(mean).max(axis=2), np.broadcast_to(longest, mean.shape[:2]))


def test_unicycle_feet_are_arcs() -> None:
    """Under (v, w) for an arc length s, the chord is 2 v/w sin(w s / 2) long, half-turned."""
    query = Query("unicycle", Goal((1.0, 1.0), 0.5))
    grid = Grid.for_query(query, 9000)
    feet = stencil(query, grid, 16, 2)
    foot = feet.foot * grid.spacing
    v, w = feet.directions.T
    s = feet.length
    half_turn = w * s / 2
    chord = v * s * np.sinc(half_turn / np.pi)
    heading = grid.axes[2][:, None] + half_turn
    np.testing.assert_allclose(foot[..., 0], chord * np.cos(heading), atol=1e-5)
    np.testing.assert_allclose(foot[..., 1], chord * np.sin(heading), atol=1e-5)
    np.testing.assert_allclose(foot[..., 2], w * s, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_readers_are_the_nodes_with_a_foot_beside(model: str) -> None:
    _, _, feet = made(model)
    strides = flat_strides(feet.shape)
    reads = set()
    for g in range(len(feet.index)):
        there = feet.index[g] + feet.corners[g]
        periodic = feet.shape > 1  # in these models the axes that matter are the periodic ones
        target = np.where(periodic, there % feet.shape, 0) @ strides
        reads |= {
            (int(t), -int(o)) for t, o in zip(target.flat, feet.node_offset[g].flat, strict=True)
        }
    listed = {
        (g, int(feet.readers[g, r]))
        for g in range(len(feet.index))
        for r in range(feet.reader_count[g])
    }
    assert listed == reads


@pytest.mark.parametrize("finer", [1, 2])
@pytest.mark.parametrize("model", MODELS)
def test_the_cost_along_a_motion_is_exact_for_linear_costs(model: str, finer: int) -> None:
    """Simpson's rule and linear interpolation both are, on straight motions."""
    _, grid, feet = made(model, 1)
    axes = (True,) + (False,) * (grid.dimension - 1)
    offset, weight, own = cost_stencil(feet, grid, axes, finer)
    mean = (weight * offset).sum(axis=2) / finer  # the first coordinate in cells, 0 at the start
    expected = (4 * feet.middle[..., 0] + feet.foot[..., 0]) / 6
    np.testing.assert_allclose(mean, expected, atol=1e-6)
    np.testing.assert_allclose(weight.sum(axis=2) + own, 1.0, atol=1e-12)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_directions_are_joined_to_a_closed_surface(m: int) -> None:
    """Euler's characteristic of the (m - 1)-sphere, and each facet's side belongs to two facets."""
    faces = simplices(m, 16)
    counts = [len(unit_directions(m)), *(len(f) for f in faces)]
    assert sum((-1) ** k * c for k, c in enumerate(counts)) == 1 + (-1) ** (m - 1)
    sides = [tuple(sorted(set(facet) - {v})) for facet in faces[-1].tolist() for v in facet]
    assert set(Counter(sides).values()) == {2}


def test_a_family_shares_its_stencil() -> None:
    grid = Grid.for_query(typical_query("unicycle"), 3000)
    first = Query("unicycle", Goal((1.0, 1.0), 0.5))
    second = Query("unicycle", Goal((3.0, -1.0), 0.7))
    assert stencil(first, grid, 16, 2) is stencil(second, grid, 16, 2)
