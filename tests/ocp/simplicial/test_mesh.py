"""Meshes: they fill the box, stay conforming under any refinement, and find their leaves."""

import math
from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp.grid import Grid
from ocp.simplicial.mesh import Mesh

GRIDS = {
    "line": Grid((-1.0,), (2.0,), (5,), (False,)),
    "ring": Grid((-1.0,), (2.0,), (5,), (True,)),
    "plane": Grid((0.0, -1.0), (2.0, 3.0), (4, 5), (False, False)),
    "cylinder": Grid((0.0, -1.0), (2.0, 3.0), (4, 5), (False, True)),
    "space": Grid((0.0, -1.0, 2.0), (2.0, 3.0, 2.5), (3, 4, 4), (False, False, False)),
    "turns": Grid((0.0, -1.0, 2.0), (2.0, 3.0, 2.5), (3, 4, 4), (False, False, True)),
}


def randomly_refined(grid: Grid, seed: int, rounds: int) -> Mesh:
    mesh, rng = Mesh.kuhn(grid), np.random.default_rng(seed)
    for _ in range(rounds):
        mesh = mesh.refined(rng.choice(mesh.size, max(1, mesh.size // 8), replace=False))
    return mesh


def box_volume(grid: Grid) -> float:
    return float(np.prod(np.subtract(grid.upper, grid.lower)))


def lonely_facets(mesh: Mesh) -> list[tuple[int, ...]]:
    """Facets of one leaf alone; every other facet must belong to exactly two."""
    n = mesh.dimension
    facets = Counter(
        tuple(sorted(map(int, facet))) for cell in mesh.cells for facet in combinations(cell, n)
    )
    assert max(facets.values()) == 2
    return [facet for facet, count in facets.items() if count == 1]


@pytest.mark.parametrize("name", GRIDS)
def test_kuhn_mesh_has_n_factorial_simplices_a_cell_and_fills_the_box(name: str) -> None:
    grid = GRIDS[name]
    mesh = Mesh.kuhn(grid)
    cells = np.prod([c if p else c - 1 for c, p in zip(grid.shape, grid.periodic, strict=True)])
    assert mesh.size == cells * math.factorial(grid.dimension)
    assert len(mesh.vertices) == grid.size
    assert mesh.volumes.sum() == pytest.approx(box_volume(grid), rel=1e-12)
    np.testing.assert_allclose(mesh.volumes, mesh.volumes[0], rtol=1e-12)


@pytest.mark.parametrize("name", GRIDS)
@settings(max_examples=6)
@given(seed=st.integers(0, 10**6))
def test_any_refinement_is_conforming(name: str, seed: int) -> None:
    """A hanging vertex would leave a facet alone inside the box."""
    grid = GRIDS[name]
    mesh = randomly_refined(grid, seed, 3)
    assert mesh.volumes.min() > 0
    assert mesh.volumes.sum() == pytest.approx(box_volume(grid), rel=1e-12)
    if grid.dimension == 1:
        return
    closed = np.flatnonzero(~np.array(grid.periodic))
    for facet in lonely_facets(mesh):
        corners = mesh.vertices[list(facet)][:, closed]
        on_lower = (corners == np.array(grid.lower)[closed]).all(axis=0)
        on_upper = (corners == np.array(grid.upper)[closed]).all(axis=0)
        assert (on_lower | on_upper).any()


@pytest.mark.parametrize("name", GRIDS)
def test_marked_leaves_are_bisected_and_vertices_keep_their_places(name: str) -> None:
    mesh = randomly_refined(GRIDS[name], 3, 2)
    marked = np.arange(0, mesh.size, 5)
    finer = mesh.refined(marked)
    assert (finer.child[mesh.leaves[marked]] >= 0).all()
    np.testing.assert_array_equal(finer.vertices[: len(mesh.vertices)], mesh.vertices)
    assert len(np.unique(finer.vertices.round(12), axis=0)) == len(finer.vertices)
    assert mesh.refined([]).size == mesh.size


@pytest.mark.parametrize("name", GRIDS)
def test_n_rounds_of_bisection_give_the_nodes_of_the_refined_grid(name: str) -> None:
    grid = GRIDS[name]
    mesh = Mesh.kuhn(grid).uniformly_refined()
    assert mesh.size == 2**grid.dimension * Mesh.kuhn(grid).size
    expected = grid.refined().nodes().reshape(-1, grid.dimension)

    def ordered(points):
        return points[np.lexsort(points.round(9).T)]

    np.testing.assert_allclose(ordered(mesh.vertices), ordered(expected), atol=1e-12)


def test_bisection_makes_few_shapes_only() -> None:
    """Maubach: the volumes halve, and the shapes do not degenerate."""
    mesh = Mesh.kuhn(Grid((0.0,) * 3, (1.0,) * 3, (3, 3, 3), (False,) * 3))
    shapes = set()
    for level in range(9):
        lengths = np.linalg.norm(mesh.edge_vectors, axis=2).max(axis=1)
        quality = mesh.volumes / lengths**3
        if level >= 3:
            shapes |= set(quality.round(10))
        mesh = mesh.refined(np.arange(mesh.size))
    assert len(shapes) <= 3
    assert min(shapes) > 0.01


@pytest.mark.parametrize("name", GRIDS)
@settings(max_examples=6)
@given(seed=st.integers(0, 10**6))
def test_the_leaf_at_a_point_gives_the_point_back(name: str, seed: int) -> None:
    grid = GRIDS[name]
    mesh = randomly_refined(grid, seed, 4)
    rng = np.random.default_rng(seed)
    points = rng.uniform(grid.lower, grid.upper, (200, grid.dimension))
    vertices, weights = mesh.locate(points)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    gap = mesh.difference(mesh.vertices[vertices], points[:, None])
    np.testing.assert_allclose((weights[..., None] * gap).sum(axis=1), 0.0, atol=1e-12)
    leaves = {tuple(sorted(map(int, cell))) for cell in mesh.cells}
    assert all(tuple(sorted(map(int, row))) in leaves for row in vertices)


def test_points_outside_have_no_leaf_and_periodic_axes_hold_everything() -> None:
    mesh = randomly_refined(GRIDS["turns"], 0, 2)
    vertices, weights = mesh.locate([[2.1, 0.0, 2.1], [1.0, 0.0, 2.1 + 7 * 0.5], [1.0, 0.0, 2.1]])
    assert (vertices[0] == -1).all()
    assert (weights[0] == 0).all()
    np.testing.assert_array_equal(vertices[1], vertices[2])
    np.testing.assert_allclose(weights[1], weights[2], atol=1e-9)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="at most 3 dimensions"):
        Mesh.kuhn(Grid((0.0,) * 4, (1.0,) * 4, (3,) * 4, (False,) * 4))
    with pytest.raises(ValueError, match="marked"):
        Mesh.kuhn(GRIDS["plane"]).refined([10**6])
