"""Exact trajectories: closed form, known optima, symmetry, dynamic programming, and honesty."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from references import TABLE_ONE_OPTIMA, aligned_value, typical_query
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from ocp.collocation import solve_collocation
from ocp.compiled.batch import minimised_hamiltonians
from ocp.cost import RunningCost
from ocp.extremals.extremal import find_extremal
from ocp.extremals.transversality import GOAL_AT_REST, GOAL_PUSHED, goal_condition
from ocp.obstacle import Obstacle
from ocp.pontryagin import ExactValue, exact_trajectories, exact_trajectory, solve_pmp
from ocp.query import Goal, Query
from ocp.query_family import PAPER_FAMILY, PAPER_START, paper_query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.value import greedy

FREE = Query("unicycle", Goal((1.0, 1.0), 0.5))
CIRCLE = paper_query((1.0, 1.0))
COURSE = paper_query((1.0, 4.0))
# The circle at (-1, -1) reaches over this goal: the running cost on its boundary is up to 9.
COVERED = paper_query((0.2, 0.0))
# ... and here it is some 1e-4 to 1e-7: between the two terminal conditions.
BRUSHED = paper_query((0.9, 0.7))

angle = st.floats(-np.pi, np.pi)


def replayed_cost(query: Query, motion: Trajectory) -> tuple[float, np.ndarray]:
    """Cost and end of the open loop, dynamics and running cost written out on their own."""
    spline = CubicSpline(motion.times, motion.inputs)
    goal, radius = query.goal_position, query.goal.radius

    def rate(t: float, y: np.ndarray) -> list[float]:
        v, omega = spline(t)
        W = max(np.tanh(1.5 * (((y[:2] - goal) ** 2).sum() - radius**2)), 0.0)
        for o in query.obstacles:
            order = 1 if o.shape == "diamond" else 2
            distance = np.linalg.norm(y[:2] - o.center, order)
            W += np.exp(-4 * (distance**2 - o.radius**2))
        return [v * np.cos(y[2]), v * np.sin(y[2]), omega, W + v**2 + omega**2]

    end = solve_ivp(
        rate, (0, motion.duration), np.append(motion.start, 0.0), rtol=1e-10, atol=1e-10,
        max_step=0.02,
    ).y[:, -1]  # fmt: skip
    return float(end[3]), end[:3]


# Truth


@settings(max_examples=20)
@given(bearing=angle, distance=st.floats(0.52, 5.0), away=st.booleans())
def test_the_closed_form(bearing: float, distance: float, away: bool) -> None:
    start = np.array([1 + distance * np.cos(bearing), 1 + distance * np.sin(bearing), bearing])
    start[2] += np.pi * away
    assume(np.abs(start[:2]).max() <= 5)
    assert exact_trajectory(FREE, start).cost == pytest.approx(aligned_value(distance), rel=1e-6)


@pytest.mark.parametrize(("goal", "cost"), TABLE_ONE_OPTIMA.items())
def test_the_papers_four_queries(goal: tuple[float, float], cost: float) -> None:
    assert exact_trajectory(paper_query(goal), PAPER_START).cost == pytest.approx(cost, abs=1e-5)


@pytest.mark.parametrize("query", [FREE, CIRCLE, COURSE, COVERED, BRUSHED])
def test_the_open_loop_replayed_costs_what_is_said(query: Query) -> None:
    motion = exact_trajectory(query, [-4.0, -2.5, 0.7])
    cost, end = replayed_cost(query, motion)
    assert cost == pytest.approx(motion.cost, rel=1e-5)
    assert_allclose(end, motion.states[-1], atol=1e-4)
    assert query.goal_distance(motion.states[-1]) == pytest.approx(0.0, abs=1e-9)
    assert (query.goal_distance(motion.states[:-1]) > -1e-9).all()


@pytest.mark.parametrize("query", [FREE, CIRCLE, COURSE, COVERED, BRUSHED])
def test_the_hamiltonian_vanishes_along_it(query: Query) -> None:
    motion = exact_trajectory(query, [-4.0, -2.5, 0.7])
    assert motion.costates is not None
    assert np.abs(minimised_hamiltonians(query, motion.states, motion.costates)).max() < 1e-6


def test_both_terminal_conditions() -> None:
    """At rest p = 0; pushed, p is normal to the goal and answers the cost on its boundary."""
    rest, pushed = (exact_trajectory(q, [-4.0, -2.5, 0.7]) for q in (FREE, COVERED))
    assert goal_condition(FREE).kind == GOAL_AT_REST
    assert rest.costates is not None
    assert_allclose(rest.costates[-1], 0.0, atol=1e-4)
    assert goal_condition(COVERED).kind == GOAL_PUSHED
    assert pushed.costates is not None
    normal = (pushed.states[-1, :2] - COVERED.goal_position) / COVERED.goal.radius
    p = pushed.costates[-1]
    assert p[:2] @ normal > 0.1
    assert p[:2] @ [-normal[1], normal[0]] == pytest.approx(0.0, abs=1e-6)
    assert p[2] == pytest.approx(0.0, abs=1e-6)


def test_the_two_conditions_meet_where_the_cost_on_the_boundary_is_negligible() -> None:
    """An obstacle drawn away from the goal: V changes smoothly through the change of condition."""
    start = [-3.0, 2.0, -0.5]
    kinds, costs = [], []
    for x in (2.5, 2.6, 2.7, 2.8, 2.9, 3.0):
        query = Query("unicycle", Goal((0.0, 0.0), 0.5), (Obstacle.circle((x, 0.0), 0.8),))
        kinds.append(goal_condition(query).kind)
        costs.append(exact_trajectory(query, start).cost)
    assert kinds[0] == GOAL_PUSHED
    assert kinds[-1] == GOAL_AT_REST
    assert np.ptp(costs) < 1e-7 * costs[0]


def test_random_problems_of_the_papers_family_agree_with_collocation() -> None:
    """Neither is cheaper than the other's answer when warm-started from it."""
    rng = np.random.default_rng(11)
    for _ in range(6):
        query, start = PAPER_FAMILY.sample_with_start(rng)
        motion = exact_trajectory(query, start)
        direct = solve_collocation(query, start, motion)
        assert motion.cost == pytest.approx(direct.cost, rel=1e-4)


def test_one_shooting_from_a_rollout_succeeds_nearly_always() -> None:
    """The candidates' first guess, the closed loop of a coarse value: 39 of 40 at least."""
    from ocp.extremals.candidates import coarse_value
    from ocp.extremals.warm_start import policy_of, rollouts

    rng, solved = np.random.default_rng(2), 0
    for _ in range(40):
        query, start = PAPER_FAMILY.sample_with_start(rng)
        value = coarse_value(query)
        assert value is not None
        guess = rollouts(query, policy_of(query, value), start)[0]
        solved += guess is not None and find_extremal(query, start, guess).trajectory is not None
    assert solved >= 39


# Structure of the value


@settings(max_examples=8)
@given(st.floats(-4, 4), st.floats(-4, 4), angle)
def test_half_turns_leave_the_value_alone(x: float, y: float, heading: float) -> None:
    assume(CIRCLE.goal_distance(np.array([x, y, heading])) > 0.05)
    there, turned = (exact_trajectory(CIRCLE, [x, y, heading + turn]).cost for turn in (0.0, np.pi))
    assert turned == pytest.approx(there, rel=1e-6)


@settings(max_examples=8)
@given(st.floats(-4, 4), st.floats(-4, 4), angle)
def test_mirrored_queries_have_mirrored_values(x: float, y: float, heading: float) -> None:
    """Reflection at the diagonal swaps the coordinates and turns heading into pi/2 - heading."""
    assume(COURSE.goal_distance(np.array([x, y, heading])) > 0.05)
    mirrored = paper_query((4.0, 1.0))
    assume(mirrored.goal_distance(np.array([y, x, 0.0])) > 0.05)
    there = exact_trajectory(COURSE, [x, y, heading]).cost
    assert exact_trajectory(mirrored, [y, x, np.pi / 2 - heading]).cost == pytest.approx(
        there, rel=1e-6
    )


@settings(max_examples=8)
@given(angle, angle, st.floats(1.0, 3.5))
def test_turning_the_whole_query(turn: float, heading: float, distance: float) -> None:
    def rotated(point: tuple[float, float]) -> np.ndarray:
        c, s = np.cos(turn), np.sin(turn)
        return np.array([[c, -s], [s, c]]) @ point

    goal = Goal((0.0, 0.0), 0.5)
    plain = Query("unicycle", goal, (Obstacle.circle((-1.5, 0.4), 0.6),))
    turned = Query("unicycle", goal, (Obstacle.circle(rotated((-1.5, 0.4)), 0.6),))
    first = exact_trajectory(plain, [-distance, 1.0, heading]).cost
    second = exact_trajectory(turned, [*rotated((-distance, 1.0)), heading + turn]).cost
    assert second == pytest.approx(first, rel=1e-6)


@pytest.mark.parametrize("query", [FREE, CIRCLE, COURSE, COVERED])
def test_dynamic_programming(query: Query) -> None:
    """From a state on the way the optimum is the rest of the motion."""
    motion = exact_trajectory(query, [-4.0, -2.5, 0.7])
    for k in (40, 90, 140):
        rest = exact_trajectory(query, query.system.wrap(motion.states[k]))
        assert rest.cost == pytest.approx(motion.cost_to_go[k], rel=1e-6)


@pytest.mark.parametrize("query", [FREE, CIRCLE, COURSE, COVERED])
def test_costate_and_hessian_are_derivatives_of_the_value(query: Query) -> None:
    start, step = np.array([-4.0, -2.5, 0.7]), 1e-3
    extremal = find_extremal(query, start, exact_trajectory(query, start))
    motion = extremal.trajectory
    assert motion is not None
    assert motion.costates is not None
    assert extremal.hessian is not None
    for i, e in enumerate(np.eye(3)):
        ahead, behind = (solve_pmp(query, start + sign * step * e, motion) for sign in (1, -1))
        slope = (ahead.cost - behind.cost) / (2 * step)
        assert motion.costates[0, i] == pytest.approx(slope, abs=1e-4)
        assert ahead.costates is not None
        assert behind.costates is not None
        bend = (ahead.costates[0] - behind.costates[0]) / (2 * step)
        assert_allclose(extremal.hessian[i], bend, atol=1e-3 * (1 + np.abs(bend).max()))


def test_at_the_cut_locus_two_motions_cost_the_same() -> None:
    """Goal straight abeam: turning left or right is equal, by reflection at the ray to it."""
    motions = exact_trajectories(paper_query((4.0, 4.0)), PAPER_START)
    assert len(motions) >= 2
    assert motions[1].cost == pytest.approx(motions[0].cost, rel=1e-6)
    first, second = motions[0].costates, motions[1].costates
    assert first is not None
    assert second is not None
    assert first[0, 2] == pytest.approx(-second[0, 2], rel=1e-4)
    assert abs(first[0, 2]) > 0.1


def test_the_list_is_sorted_and_its_members_differ() -> None:
    motions = exact_trajectories(COURSE, PAPER_START)
    costs = [m.cost for m in motions]
    assert costs == sorted(costs)
    assert len(costs) >= 2
    assert costs[1] > costs[0] * (1 + 1e-6)


@pytest.mark.parametrize("distance", [1e-4, 1e-3, 1e-2, 0.1])
def test_close_to_the_goal_at_any_heading(distance: float) -> None:
    """Not below the aligned heading's cost; symmetric in the heading."""
    bound = aligned_value(0.5 + distance)
    for offset in (0.0, 0.5, 1.2, 1.5):
        costs = [
            exact_trajectory(FREE, [1.5 + distance, 1.0, sign * offset]).cost for sign in (1, -1)
        ]
        assert costs[0] >= bound * (1 - 1e-6)
        assert costs[1] == pytest.approx(costs[0], rel=1e-5)


# Other robots


@pytest.mark.parametrize(
    "model", ["single-integrator-1d", "single-integrator-2d", "single-integrator-3d"]
)
def test_single_integrators_go_straight(model: str) -> None:
    """Without obstacles V = 2 integral sqrt(Q), from any state."""
    d = int(model[-2])
    query = Query(model, Goal((0.5,) * d, 0.5))
    start = np.linspace(-3.0, 2.0, d)
    distance = float(np.linalg.norm(start - 0.5))
    assert exact_trajectory(query, start).cost == pytest.approx(aligned_value(distance), rel=1e-6)


def test_a_double_integrator_agrees_with_collocation() -> None:
    query = typical_query("double-integrator-1d")
    start = np.array([2.3, -0.2])
    motion = exact_trajectory(query, start)
    assert motion.cost == pytest.approx(solve_collocation(query, start, motion).cost, rel=1e-5)
    assert motion.costates is not None
    assert motion.costates[-1, 1] == pytest.approx(0.0, abs=1e-6)  # speed at the end is free


def test_active_bounds_are_reported_and_kept() -> None:
    query = typical_query("unicycle", bounded=True)
    start = np.array([-1.7, 2.9, -1.2])
    motion = exact_trajectory(query, start)
    lower, upper = query.input_bounds
    assert ((motion.inputs >= lower) & (motion.inputs <= upper)).all()
    again = find_extremal(query, start, motion)
    assert again.bounds_active
    assert again.cost == pytest.approx(solve_collocation(query, start, motion).cost, rel=1e-5)
    assert not find_extremal(FREE, start, exact_trajectory(FREE, start)).bounds_active


# Warm starts and feedback


def test_warm_start_from_a_neighbour_and_from_a_value() -> None:
    start = np.array([-4.0, -2.5, 0.7])
    motion = exact_trajectory(CIRCLE, start)
    near = start + np.array([0.1, -0.1, 0.05])
    exact = exact_trajectory(CIRCLE, near).cost
    assert solve_pmp(CIRCLE, near, motion).cost == pytest.approx(exact, rel=1e-7)
    from ocp.extremals.candidates import coarse_value

    value = coarse_value(CIRCLE)
    assert value is not None
    assert solve_pmp(CIRCLE, near, value).cost == pytest.approx(exact, rel=1e-7)
    assert exact_trajectory(CIRCLE, near, value).cost == pytest.approx(exact, rel=1e-7)


def test_the_exact_value_is_exact_feedback() -> None:
    """The closed loop that is greedy for it costs V, up to the holding of inputs."""
    value = ExactValue(CIRCLE)
    policy = greedy(CIRCLE, value)
    start = np.array([-4.0, -2.5, 0.7])
    optimum, state, cost, step = float(value.value(start)), start.copy(), 0.0, 0.02
    while CIRCLE.goal_distance(state) > 1e-3:
        v, omega = policy(state)
        middle = state[2] + omega * step / 2
        state = state + step * np.array([v * np.cos(middle), v * np.sin(middle), omega])
        cost += step * float(CIRCLE.running_cost(state, [v, omega]))  # pyright: ignore
        assert cost < 2 * optimum
    assert cost == pytest.approx(optimum, rel=2e-2)
    assert value.value(np.append(CIRCLE.goal_position, 0.0)) == 0.0
    assert_allclose(value.gradient(np.append(CIRCLE.goal_position, 0.0)), 0.0)


def test_the_exact_value_takes_many_states_and_whole_turns() -> None:
    value = ExactValue(FREE)
    states = np.array([[-2.0, 0.5, 0.3], [-2.0, 0.5, 0.3 + 2 * np.pi], [-2.1, 0.5, 0.3]])
    values = value.value(states[:, None])
    assert values.shape == (3, 1)
    assert values[1, 0] == pytest.approx(values[0, 0], rel=1e-7)
    slope = value.gradient(states[0])[0]
    assert values[2, 0] == pytest.approx(values[0, 0] - 0.1 * slope, abs=0.02)


# Honesty


def test_a_bad_guess_raises_with_its_status() -> None:
    start = np.array([-4.0, -2.5, 0.7])
    times = np.linspace(0, 0.3, 5)
    nonsense = Trajectory(
        times, np.tile([4.0, -4.0, 2.0], (5, 1)) + times[:, None], np.zeros((5, 2)),
        np.tile([30.0, -30.0, 40.0], (5, 1)), times,
    )  # fmt: skip
    with pytest.raises(SolveError) as caught:
        solve_pmp(CIRCLE, start, nonsense, max_iterations=3)
    assert caught.value.status in (Status.NOT_CONVERGED, Status.WRONG_EXTREMAL)


def test_too_few_iterations_are_not_called_success() -> None:
    start = np.array([-4.0, -2.5, 0.7])
    guess = exact_trajectory(CIRCLE, start)
    with pytest.raises(SolveError) as caught:
        solve_pmp(CIRCLE, [-3.5, -2.0, 0.9], guess, max_iterations=1)
    assert caught.value.status is Status.NOT_CONVERGED


def test_a_motion_through_a_hard_obstacle_does_not_count() -> None:
    """The soft optimum crosses the obstacle; hard, it is refused, and the way round costs more."""
    goal, faint = Goal((2.0, 0.0), 0.5), RunningCost(obstacle=0.1)
    soft, hard = (
        Query("unicycle", goal, (Obstacle.circle((-1.0, 0.0), 0.3, wall),), faint)
        for wall in (False, True)
    )
    start = np.array([-3.0, 0.0, 0.0])
    straight = exact_trajectory(soft, start)
    assert soft.clearance(straight.states).min() < 0
    assert find_extremal(hard, start, straight).status is Status.NOT_APPLICABLE
    round_it = exact_trajectory(hard, start)
    assert hard.clearance(round_it.states, hard_only=True).min() > -1e-6
    assert round_it.cost > straight.cost


def test_a_distant_hard_obstacle_changes_nothing() -> None:
    far = Query("unicycle", Goal((1.0, 1.0), 0.5), (Obstacle.circle((4.5, -4.5), 0.3, True),))
    soft = Query("unicycle", Goal((1.0, 1.0), 0.5), (Obstacle.circle((4.5, -4.5), 0.3),))
    start = [-3.0, 0.5, 0.4]
    assert exact_trajectory(far, start).cost == pytest.approx(
        exact_trajectory(soft, start).cost, rel=1e-9
    )


def test_a_start_in_the_goal_costs_nothing() -> None:
    motion = exact_trajectory(FREE, [1.1, 1.0, 0.3])
    assert motion.cost == 0.0
    assert motion.duration == 0.0
    assert solve_pmp(FREE, [1.1, 1.0, 0.3]).cost == 0.0


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="start"):
        exact_trajectory(FREE, [9.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="segments"):
        solve_pmp(FREE, [0.0, 0.0, 0.0], segments=1)
    with pytest.raises(ValueError, match="tolerance"):
        solve_pmp(FREE, [0.0, 0.0, 0.0], tolerance=1.0)
    times = np.zeros(3)
    still = Trajectory(times, np.zeros((3, 3)), np.zeros((3, 2)), None, times)
    with pytest.raises(ValueError, match="guess"):
        solve_pmp(FREE, [-3.0, 0.0, 0.0], still)
    with pytest.raises(ValueError, match="states"):
        ExactValue(FREE).value([1.0, 2.0])
