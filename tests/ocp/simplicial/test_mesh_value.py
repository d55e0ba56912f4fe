"""Values on a mesh: linear on leaves, infinite where nothing is known; the policy off them."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ocp.grid import Grid
from ocp.grids.bellman import bellman_addresses
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.refmm import uniform_mesh
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.mesh_value import MeshPolicy, MeshValue
from ocp.simplicial.solution import MeshSolution, solve_on_mesh
from sims.closed_loop import rollout

PLANE = Query("single-integrator-2d", Goal((1.0, 1.0), 0.5))
WALL = Obstacle.polygon([(-0.3, -4.0), (0.3, -4.0), (0.3, 3.0), (-0.3, 3.0)], hard=True)
WALLED = Query("unicycle", Goal((3.0, 0.0), 0.5), (WALL,))
PAPER = paper_query((1.0, 1.0))


@cache
def solved(query: Query, simplices: int) -> MeshSolution:
    return solve_on_mesh(query, uniform_mesh(query, simplices))


def patchy(query: Query) -> Mesh:
    mesh = uniform_mesh(query, 600)
    rng = np.random.default_rng(0)
    for _ in range(4):
        mesh = mesh.refined(rng.choice(mesh.size, mesh.size // 6, replace=False))
    return mesh


def test_a_linear_function_is_reproduced_with_its_gradient() -> None:
    mesh = patchy(PLANE)
    slope = np.array([0.7, -0.4])
    value = MeshValue(PLANE, mesh, 9.0 + mesh.vertices @ slope)
    states = np.random.default_rng(1).uniform(-4.9, 4.9, (300, 2))
    states = states[PLANE.goal_distance(states) > 0]
    np.testing.assert_allclose(value.value(states), 9.0 + states @ slope, atol=1e-12)
    np.testing.assert_allclose(value.gradient(states), np.tile(slope, (len(states), 1)), atol=1e-9)
    assert value.value(states[:0]).shape == (0,)
    assert value.value(states[0]).shape == ()


def test_value_is_zero_in_the_goal_and_infinite_outside_the_box() -> None:
    value = solved(PLANE, 2_000).value
    assert value.value([1.1, 1.1]) == 0.0
    assert (value.gradient([1.1, 1.1]) == 0.0).all()
    assert np.isinf(value.value([5.1, 0.0]))
    with pytest.raises(ValueError, match="expected"):
        value.value([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="finite"):
        value.value([np.nan, 2.0])
    with pytest.raises(ValueError, match="values"):
        MeshValue(PLANE, value.mesh, value.values[:-1])


def test_half_a_turn_changes_nothing() -> None:
    value = solved(PAPER, 6_000).value
    states = np.random.default_rng(0).uniform([-5, -5, -np.pi], [5, 5, 0], (50, 3))
    turned = states + np.array([0.0, 0.0, np.pi])
    np.testing.assert_allclose(value.value(states), value.value(turned), rtol=1e-9)


def test_a_mesh_over_the_whole_turn_gives_the_same_value() -> None:
    """Half-turn symmetry is an economy, not an approximation: same spacings, same values."""
    half = Mesh.kuhn(Grid.of(PAPER.system, (15, 15, 5), half_turn=True))
    whole = Mesh.kuhn(Grid.of(PAPER.system, (15, 15, 10)))
    a, b = (solve_on_mesh(PAPER, m, tolerance=1e-9) for m in (half, whole))
    np.testing.assert_allclose(a.value.value(whole.vertices), b.values, rtol=1e-7)


def test_the_policy_leaves_those_on_grids_alone() -> None:
    """The functions of a query's policies are looked up once, for all of them."""
    before = bellman_addresses(PAPER).copy()
    solved(PAPER, 6_000).policy()(np.array(PAPER_START))
    np.testing.assert_array_equal(bellman_addresses(PAPER), before)


def test_the_policy_reaches_the_goal_and_travels_to_other_processes() -> None:
    policy = solved(PAPER, 6_000).policy()
    copy = pickle.loads(pickle.dumps(policy))
    states = np.random.default_rng(0).uniform([-5, -5, -np.pi], [5, 5, np.pi], (20, 3))
    np.testing.assert_array_equal(policy(states), copy(states))
    assert policy(states[0]).shape == (2,)
    assert (policy([1.0, 1.0, 0.3]) == 0.0).all()
    loop = rollout(policy, PAPER_START)
    assert loop.cost is not None
    assert loop.cost < 1.1 * 15.57723
    with pytest.raises(ValueError, match="expected"):
        MeshPolicy(policy.value)(np.zeros(2))


def test_hard_obstacles_are_never_entered() -> None:
    solution = solved(WALLED, 12_000)
    value, policy = solution.value, solution.policy(margin=0.02)
    inside = np.array([[0.0, 0.0, 0.0], [0.2, -3.9, 1.0]])
    assert np.isinf(value.value(inside)).all()
    free = solve_on_mesh(replace(WALLED, obstacles=()), solution.mesh)
    known = np.isfinite(solution.values)
    assert (solution.values[known] >= free.values[known] * (1 - 2e-2)).all()
    for start in [(-3.0, 0.0, 0.0), (-4.0, -4.0, 0.0), (-2.0, 3.0, 2.0)]:
        loop = rollout(policy, start)
        assert loop.reached
        assert loop.min_clearance > 0
        # The way round is longer than through the wall; so is the value.
        assert value.value(start) > 1.05 * free.value.value(start)


def test_a_goal_behind_walls_is_not_reached_through_them() -> None:
    """However thin the walls: values do not leak."""
    box = [((2.0, -1.0), (2.05, 1.0)), ((3.95, -1.0), (4.0, 1.0))]
    box += [((2.0, -1.0), (4.0, -0.95)), ((2.0, 0.95), (4.0, 1.0))]
    walls = tuple(
        Obstacle.polygon([(a, b), (c, b), (c, d), (a, d)], hard=True) for (a, b), (c, d) in box
    )
    query = Query("unicycle", Goal((3.0, 0.0), 0.5), walls)
    solution = solve_on_mesh(query, uniform_mesh(query, 12_000))
    outside = (abs(solution.mesh.vertices[:, :2] - [3.0, 0.0]) > 1.0).any(axis=1)
    assert np.isinf(solution.values[outside]).all()
    assert np.isfinite(solution.values).any()
