"""Stencils and the march: feet obey the dynamics, the fixed point is that of value iteration, label
setting is exact where the scheme is causal and not where it is not, repairs forget nothing."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from ocp.closed_form import straight_value
from ocp.compiled.batch import rates, state_costs
from ocp.cost import RunningCost
from ocp.grid import Grid
from ocp.models import MODELS
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.refmm import uniform_mesh
from ocp.simplicial.feet import GOAL
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.solution import MeshSolution, solve_on_mesh
from ocp.simplicial.stencils import merged, stencils
from ocp.trajectory import SolveError, Status

UNICYCLE = paper_query((1.0, 1.0))
ISOTROPIC = {d: Query(f"single-integrator-{d}d", Goal((1.0,) * d, 0.8)) for d in (1, 2, 3)}
SIZES = {1: 40, 2: 2_000, 3: 6_000}
TIGHT = 1e-9


@cache
def isotropic(d: int) -> MeshSolution:
    query = ISOTROPIC[d]
    return solve_on_mesh(query, uniform_mesh(query, SIZES[d]), tolerance=TIGHT)


@cache
def unicycle(table: bool) -> MeshSolution:
    """On a mesh that is refined in places."""
    mesh = uniform_mesh(UNICYCLE, 3_000)
    mesh = mesh.refined(np.arange(0, mesh.size, 3))
    return solve_on_mesh(UNICYCLE, mesh, table=table, tolerance=TIGHT)


def gap(a: MeshSolution, b: MeshSolution) -> float:
    """Largest relative difference of values; infinite values must agree."""
    known = np.isfinite(a.values)
    np.testing.assert_array_equal(known, np.isfinite(b.values))
    away = known & (a.fixed == 0)
    return float(abs(a.values[away] / b.values[away] - 1).max())


# Stencils


def test_feet_of_the_unicycle_are_reached_by_their_inputs() -> None:
    """y - x = G((x + y) / 2) u, with y on the edge that the foot names."""
    mesh = unicycle(False).mesh
    s = unicycle(False).stencils
    owner = np.repeat(np.arange(len(s.span)), s.span[:, 1] - s.span[:, 0])
    through = s.nodes[:, 0] != GOAL
    x = mesh.vertices[owner[through]]
    ends = mesh.difference(mesh.vertices[s.nodes[through]], x[:, None])
    share = s.weight[through][:, None]
    moved = (1 - share) * ends[:, 0] + share * ends[:, 1]
    driven = rates(UNICYCLE, x + moved / 2, s.effort[through])  # R = 1
    np.testing.assert_allclose(driven, moved, atol=1e-6 * abs(moved).max())


def test_inner_vertices_see_a_closed_curve_of_feet() -> None:
    s, mesh = unicycle(False).stencils, unicycle(False).mesh
    inner = (abs(mesh.vertices[:, :2]) < 4.99).all(axis=1) & (unicycle(False).fixed == 0)
    feet, pieces = s.span[inner, 1] - s.span[inner, 0], s.span[inner, 3] - s.span[inner, 2]
    assert feet.min() >= 4
    np.testing.assert_array_equal(feet, pieces)


def test_stencils_of_changed_vertices_are_those_made_anew() -> None:
    mesh = uniform_mesh(UNICYCLE, 3_000)
    old = stencils(UNICYCLE, mesh)
    finer = mesh.refined(np.arange(0, mesh.size, 50))
    touched = np.unique(finer.simplices[len(mesh.simplices) :])
    assert len(touched) < len(finer.vertices)
    joined, anew = (
        merged(old, stencils(UNICYCLE, finer, touched), touched),
        stencils(UNICYCLE, finer),
    )

    def listed(s, v):
        feet, pieces = slice(*s.span[v, :2]), slice(*s.span[v, 2:])
        rows = [s.nodes[feet, 0], s.nodes[feet, 1], s.weight[feet], *s.effort[feet].T, s.cost[feet]]
        return np.array([*rows, s.alone[feet]]), s.pieces[pieces][:, :2] - s.span[v, 0]

    for v in range(len(finer.vertices)):
        for a, b in zip(listed(joined, v), listed(anew, v), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)


def test_queries_that_do_not_fit_are_refused() -> None:
    applicable = {"unicycle", *(f"single-integrator-{d}d" for d in (1, 2, 3))}
    for name in applicable:
        d = len(MODELS[name]().position)
        uniform_mesh(Query(name, Goal((0.0,) * d, 0.5)), 500)
    for query in (
        Query("double-integrator-1d", Goal((0.0,), 0.5)),
        replace(UNICYCLE, input_lower=(-1.0, -1.0), input_upper=(1.0, 1.0)),
    ):
        with pytest.raises(SolveError) as error:
            uniform_mesh(query, 500)
        assert error.value.status is Status.NOT_APPLICABLE
    plane = uniform_mesh(ISOTROPIC[2], 500)
    with pytest.raises(ValueError, match="mesh"):
        solve_on_mesh(UNICYCLE, plane)
    with pytest.raises(ValueError, match="tolerance"):
        solve_on_mesh(ISOTROPIC[2], plane, tolerance=0.0)


# The fixed point


def brute_force(solution: MeshSolution, v: int) -> float:
    """T V at a vertex, by a numerical minimum over each piece: an oracle for the closed form."""
    s, values = solution.stencils, solution.values
    feet = range(*s.span[v, :2])

    def at(f):
        i, j = s.nodes[f]
        return 0.0 if i == GOAL else (1 - s.weight[f]) * values[i] + s.weight[f] * values[j]

    best = min(at(f) + s.cost[f] for f in feet)
    for f, g, h in s.pieces[s.span[v, 2] : s.span[v, 3]]:
        if h >= 0:
            continue
        mean = (
            s.cost[f] / np.linalg.norm(s.effort[f]) + s.cost[g] / np.linalg.norm(s.effort[g])
        ) / 2

        def cost(t, f=f, g=g, mean=mean):
            effort = (1 - t) * s.effort[f] + t * s.effort[g]
            return mean * np.linalg.norm(effort) + (1 - t) * at(f) + t * at(g)

        found = minimize_scalar(cost, bounds=(0, 1), method="bounded", options={"xatol": 1e-9})
        if 1e-6 < found.x < 1 - 1e-6:
            best = min(best, float(found.fun))  # pyright: ignore[reportAttributeAccessIssue]
    return best


@pytest.mark.parametrize("which", ["isotropic", "unicycle"])
def test_values_solve_the_scheme_as_a_numerical_minimum_finds_it(which: str) -> None:
    solution = isotropic(2) if which == "isotropic" else unicycle(False)
    rng = np.random.default_rng(0)
    for v in rng.choice(np.flatnonzero(solution.fixed == 0), 40, replace=False):
        assert brute_force(solution, v) == pytest.approx(solution.values[v], rel=1e-7)


@pytest.mark.parametrize("d", ISOTROPIC)
def test_label_setting_is_exact_for_isotropic_motion(d: int) -> None:
    """No obtuse angles: each vertex is accepted once, and value iteration agrees to rounding."""
    solution = isotropic(d)
    assert solution.effort.again == 0
    assert solution.effort.acceptances == (solution.fixed == 0).sum()
    assert gap(solution.by_label_setting(), solution) == 0.0
    assert gap(solution.by_value_iteration(), solution) < 1e-12


@pytest.mark.parametrize("table", [False, True])
def test_the_unicycle_needs_repair_and_gets_the_fixed_point_of_value_iteration(table: bool) -> None:
    solution = unicycle(table)
    swept = solution.by_value_iteration()
    # Both are within the tolerance of the fixed point, see `march`.
    assert gap(swept, solution) <= 2 * TIGHT
    assert solution.residual() <= TIGHT * (1 + 1e-6)
    free = solution.fixed == 0
    assert solution.effort.again > 0.05 * free.sum()
    once = solution.by_label_setting()
    assert once.effort.again == 0
    excess = once.values[free] / solution.values[free] - 1
    assert excess.min() > -2 * TIGHT  # nothing is lost, values are only too high
    assert excess.max() > 0.01
    assert excess.mean() < 0.1


@settings(max_examples=5)
@given(tolerance=st.sampled_from([1e-2, 1e-3, 1e-4, 1e-6]))
def test_the_tolerance_bounds_the_distance_from_the_fixed_point(tolerance: float) -> None:
    loose = replace(unicycle(False), tolerance=tolerance).from_scratch()
    assert gap(loose, unicycle(False)) <= tolerance + TIGHT


# Repair


@settings(max_examples=6)
@given(seed=st.integers(0, 10**6), table=st.booleans())
def test_a_repair_gives_what_a_new_solve_gives(seed: int, table: bool) -> None:
    rng = np.random.default_rng(seed)
    solution = unicycle(table)
    for _ in range(2):
        count = int(rng.integers(1, 200))
        solution = solution.refined(rng.choice(solution.mesh.size, count, replace=False))
        assert not solution.effort.from_scratch
    # In units of the least cost of a step the repair may differ by the tolerance.
    assert gap(solution, solution.from_scratch()) <= 4 * TIGHT


def test_a_repair_far_from_the_goal_touches_little() -> None:
    """No optimal motion of many passes through a corner: few values depend on it."""
    solution = replace(unicycle(False), tolerance=1e-4).from_scratch()
    corner = (
        np.abs(solution.mesh.vertices[solution.mesh.cells][..., :2] + 5.0).sum(axis=2).max(axis=1)
    )
    repaired = solution.refined(np.flatnonzero(corner < 1.0))
    assert 0 < repaired.effort.updates < 0.1 * repaired.from_scratch().effort.updates


@settings(max_examples=4)
@given(seed=st.integers(0, 10**6))
def test_any_finite_values_lead_to_the_fixed_point(seed: int) -> None:
    """From below and from above: rises are passed on as falls are."""
    solution = isotropic(2)
    rng = np.random.default_rng(seed)
    noise = np.where(solution.fixed, 1.0, rng.uniform(0.5, 1.5, len(solution.values)))
    disturbed = replace(solution, values=solution.values * noise)
    restored = disturbed._marched(np.arange(len(noise)))
    assert restored.effort.rises > 0
    assert gap(restored, solution) <= 2 * TIGHT


# Isotropic fast marching as a special case


def test_isotropic_values_converge_to_the_closed_form() -> None:
    """First order, like interpolation on a step: errors at given states over four meshes."""
    query = ISOTROPIC[2]
    rng = np.random.default_rng(0)
    states = rng.uniform(-5, 5, (100, 2))
    states = states[query.goal_distance(states) > 0.3]
    exact = np.array([straight_value(query, s) for s in states])
    errors = []
    for nodes in (17, 33, 65, 129):
        mesh = Mesh.kuhn(Grid.of(query.system, (nodes, nodes)))
        errors.append(abs(solve_on_mesh(query, mesh).value.value(states) / exact - 1).mean())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.02
    assert ((orders > 0.8) & (orders < 1.6)).all()


def test_isotropic_values_approach_those_of_scikit_fmm() -> None:
    """Another fast marching on the same nodes, W far from constant: differences fall with h."""
    skfmm = pytest.importorskip("skfmm")
    soft = (Obstacle.circle((-1.0, -1.0), 1.0),)
    query = replace(ISOTROPIC[2], obstacles=soft)
    errors = []
    for nodes in (41, 81, 161):
        grid = Grid.of(query.system, (nodes, nodes))
        solution = solve_on_mesh(query, Mesh.kuhn(grid), tolerance=TIGHT)
        distance = query.goal_distance(grid.nodes())
        slowness = 2 * np.sqrt(np.maximum(state_costs(query, grid.nodes()), 1e-6))
        peer = skfmm.travel_time(distance, 1 / slowness, dx=float(grid.spacing[0]), order=1)
        away = distance > 0
        errors.append(abs(solution.values.reshape(grid.shape) - np.asarray(peer))[away].mean())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.01 * solution.values.max()
    assert ((orders > 0.7) & (orders < 1.3)).all()


def test_a_uniform_metric_gives_distances() -> None:
    """W = 1 outside the goal: V is twice the distance, exact along the mesh's axes."""
    query = replace(ISOTROPIC[2], cost=RunningCost(goal_steepness=1e6))
    mesh = Mesh.kuhn(Grid.of(query.system, (101, 101)))
    solution = solve_on_mesh(query, mesh, tolerance=TIGHT)
    distance = np.maximum(query.goal_distance(mesh.vertices), 0.0)
    error = solution.values - 2 * distance
    on_axis = abs(mesh.vertices[:, 1] - 1.0) < 1e-9
    np.testing.assert_allclose(error[on_axis], 0.0, atol=1e-4)
    assert error.min() > -1e-3  # a feasible motion costs no less than the distance
    assert error.max() < 2 * 0.1
