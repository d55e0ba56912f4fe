"""ReFMM: converges to exact values, refines better than uniformly, keeps the planner's laws."""

from functools import cache

import numpy as np
import pytest
from references import TABLE_ONE_OPTIMA

from ocp.closed_form import straight_value
from ocp.grid import Grid
from ocp.grids.goal_table import goal_table
from ocp.planning import iterations, plan
from ocp.query import Goal, Query
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query
from ocp.refmm import Refmm, RefmmSettings, RefmmState, solve_refmm, uniform_mesh
from ocp.simplicial.indicator import error_indicator, marked_leaves
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.solution import solve_on_mesh
from sims.closed_loop import rollout

BARE = Query("unicycle", Goal((1.0, 0.5), 0.8))
SETTINGS = RefmmSettings(first=1_500, last=6_000, table=False)


@cache
def refined(goal: tuple[float, float], table: bool, last: int) -> RefmmState:
    settings = RefmmSettings(first=last // 2, last=last, table=table)
    return solve_refmm(paper_query(goal), [np.array(PAPER_START)], settings)


def states_and_values(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random states without obstacles, and exact values from the table of extremals."""
    rng = np.random.default_rng(0)
    states = rng.uniform([-5, -5, -np.pi], [5, 5, np.pi], (count, 3))
    states = states[BARE.goal_distance(states) > 1.0]
    return states, goal_table(BARE, 14.0).value(states)


def test_plain_values_converge_to_the_exact_ones_off_the_axis() -> None:
    """First order, monotone from above on the whole: four meshes, no exact value used."""
    states, exact = states_and_values(600)
    errors = []
    for cells in (12, 18, 27, 40):
        grid = Grid.of(BARE.system, (cells + 1, cells + 1, round(0.315 * cells)), half_turn=True)
        solution = solve_on_mesh(BARE, Mesh.kuhn(grid), table=False)
        errors.append(float(np.mean(solution.value.value(states) / exact - 1)))
    orders = np.log(np.array(errors[:-1]) / errors[1:]) / np.log(1.5)
    assert errors[-1] < 0.05
    assert ((orders > 0.6) & (orders < 1.5)).all()


def test_with_the_table_values_without_obstacles_are_exact_at_the_vertices() -> None:
    """Where the factor that makes them exact is within its bounds."""
    solution = solve_on_mesh(BARE, uniform_mesh(BARE, 6_000), tolerance=1e-7)
    exact = goal_table(BARE, 14.0).value(solution.mesh.vertices)
    free = (solution.fixed == 0) & (BARE.goal_distance(solution.mesh.vertices) > 0.5)
    error = abs(solution.values[free] / exact[free] - 1)
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.9) < 0.02


def test_values_on_the_ray_approach_the_closed_form() -> None:
    state = np.array([-3.0, 0.5, 0.0])
    exact = straight_value(BARE, state)
    errors = [
        solve_on_mesh(BARE, uniform_mesh(BARE, n), table=False).value.value(state) / exact - 1
        for n in (3_000, 24_000)
    ]
    assert 0 < errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.05


def test_refinement_beats_a_uniform_mesh_of_the_same_size() -> None:
    states, exact = states_and_values(600)
    uniform = solve_on_mesh(BARE, uniform_mesh(BARE, 12_000), table=False)
    settings = RefmmSettings(first=3_000, last=uniform.mesh.size, table=False)
    state = solve_refmm(BARE, (), settings)
    assert state.solution.mesh.size <= 1.03 * uniform.mesh.size

    def error(solution):
        return float(np.median(abs(solution.value.value(states) / exact - 1)))

    assert error(state.solution) < 0.75 * error(uniform)


def test_refinement_for_a_start_finds_its_value() -> None:
    """More so than a uniform mesh: the mesh is fine where motions from the start pass."""
    query = paper_query((1.0, 1.0))
    exact = TABLE_ONE_OPTIMA[1.0, 1.0]
    uniform = solve_on_mesh(query, uniform_mesh(query, 12_000), table=False)
    own = refined((1.0, 1.0), False, 12_000).solution

    def error(solution):
        return abs(float(solution.value.value(PAPER_START)) / exact - 1)

    assert error(own) < 0.7 * error(uniform)


@pytest.mark.parametrize("goal", PAPER_GOALS)
@pytest.mark.parametrize("table", [False, True])
def test_coarse_meshes_drive_within_four_per_cent_of_the_optimum(
    goal: tuple[float, float], table: bool
) -> None:
    loop = rollout(refined(goal, table, 12_000).solution.policy(), PAPER_START)
    assert loop.cost is not None
    assert -1e-4 < loop.cost / TABLE_ONE_OPTIMA[goal] - 1 < 0.04


def test_the_indicator_is_large_where_values_bend_and_motions_pass() -> None:
    solution = solve_on_mesh(BARE, uniform_mesh(BARE, 6_000), table=False)
    indicator = error_indicator(solution)
    assert indicator.shape == (solution.mesh.size,)
    assert (indicator >= 0).all()
    middle = solution.mesh.vertices[solution.mesh.cells[:, 0]]
    near = abs(BARE.goal_distance(middle)) < 0.7
    assert np.median(indicator[near]) > 3 * np.median(indicator[~near])
    start = np.array([[-4.5, 4.5, 0.0]])
    at = np.linalg.norm(middle[:, :2] - start[0, :2], axis=1) < 0.7
    assert error_indicator(solution, start)[at].mean() > 2 * indicator[at].mean()


def test_marked_leaves_hold_their_share() -> None:
    indicator = np.array([1.0, 5.0, 0.0, 3.0, 1.0])
    assert marked_leaves(indicator, 0.5).tolist() == [1]
    assert sorted(marked_leaves(indicator, 0.8).tolist()) == [1, 3]
    assert len(marked_leaves(indicator, 1.0)) >= 4


def test_the_planner_refines_until_its_last_size_and_leaves_old_states_alone() -> None:
    planner, start = Refmm(SETTINGS), np.array(PAPER_START)
    state = planner.start(BARE, [start])
    assert not state.finished
    while not state.finished:
        mesh, values = state.solution.mesh, state.solution.values.copy()
        better = planner.refine(state)
        assert better.solution.mesh.size > mesh.size
        np.testing.assert_array_equal(state.solution.values, values)
        assert better.next_seconds > 0
        assert better.solution.residual() <= SETTINGS.tolerance * (1 + 1e-6)
        state = better
    assert 0.9 * SETTINGS.last < state.solution.mesh.size < 1.1 * SETTINGS.last
    assert len(state.rounds) > 2
    assert planner.policy(state).query == BARE
    answer = plan(planner, BARE, [start], iterations(1))
    assert answer.value.value(start) > 0
    assert answer.trajectories == 0


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="first"):
        RefmmSettings(first=100, last=50)
    with pytest.raises(ValueError, match="share"):
        RefmmSettings(share=0.0)
    with pytest.raises(ValueError, match="growth"):
        RefmmSettings(growth=1.0)
