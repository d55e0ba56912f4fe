"""Collocation against closed forms, Riccati, known optima, finite differences and replays."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from references import ALL_QUERIES, TABLE_ONE_OPTIMA, aligned_value, typical_query
from scipy.integrate import solve_ivp

from ocp.collocation import solve_collocation
from ocp.compiled.batch import minimised_hamiltonians, optimal_inputs
from ocp.cost import RunningCost
from ocp.extremals.guess import default_guesses
from ocp.kernels import parameters
from ocp.models import get_model
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.riccati import LinearQuadratic, differential_riccati
from ocp.trajectory import SolveError, Status
from ocp.transcription.check import judge
from ocp.transcription.programme import Problem, program
from ocp.transcription.radau import radau
from ocp.transcription.terms import Structure, state_cost

START = np.array([-4.0, -4.0, -np.pi / 4])
TERMINAL = 0.7 * np.eye(2) + 0.1


def linear_quadratic_query(model: str = "double-integrator-1d", **changes) -> Query:
    system = get_model(model)
    M = np.diag(np.linspace(1, 2, system.n)) + 0.2
    cost = RunningCost(goal=0.0, state=tuple(map(tuple, M)), input=(0.5,) * system.m)
    return Query(model, Goal((0.0,) * len(system.position), 0.1), cost=cost, **changes)


def even_mesh(intervals: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, intervals + 1)


# The rule


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_the_rule_is_exact_for_polynomials(degree):
    rule = radau(degree)
    assert rule.points[-1] == 1.0
    for power in range(2 * degree - 1):
        assert rule.weights @ rule.points**power == pytest.approx(1 / (power + 1), abs=1e-14)
    # ... and no further: Radau quadrature has degree 2 d - 2.
    assert abs(rule.weights @ rule.points ** (2 * degree - 1) - 1 / (2 * degree)) > 1e-6
    for power in range(1, degree + 1):
        slope = power * rule.points ** (power - 1)
        assert rule.derivative @ rule.nodes**power == pytest.approx(slope, abs=1e-12)
        middles = (rule.nodes[1:] + rule.nodes[:-1]) / 2
        assert rule.between @ rule.nodes**power == pytest.approx(middles**power, abs=1e-12)
    for power in range(degree):
        integral = rule.points ** (power + 1) / (power + 1)
        assert rule.integral @ rule.points**power == pytest.approx(integral, abs=1e-13)
        coefficients = rule.powers @ rule.points**power
        assert coefficients == pytest.approx(np.eye(degree)[power], abs=1e-11)


@pytest.mark.parametrize(("model", "bounded"), ALL_QUERIES)
def test_the_programs_cost_is_the_querys(model, bounded):
    query = typical_query(model, bounded)
    structure = Structure.of(query, 2)
    q = parameters(query)
    x, symbols = ca.SX.sym("x", query.system.n), ca.SX.sym("q", len(q))
    ours = ca.Function("ours", [x, symbols], [state_cost(structure, x, symbols)])
    for state in np.random.default_rng(0).uniform(-4, 4, (20, query.system.n)):
        expected = float(query.running_cost(state, np.zeros(query.system.m)))
        assert float(ours(state, q)) == pytest.approx(expected, rel=1e-12, abs=1e-300)


# Fixed horizon: Riccati


@pytest.mark.parametrize("model", ["double-integrator-1d", "springless-rover"])
def test_linear_quadratic_answers_agree_with_riccati(model):
    query, horizon = linear_quadratic_query(model), 3.0
    n = query.system.n
    terminal, start = 0.7 * np.eye(n) + 0.1, np.linspace(1, 2, n)
    exact = differential_riccati(LinearQuadratic.of_query(query), terminal, horizon)
    motion = solve_collocation(query, start, horizon=horizon, terminal_cost=terminal)
    end = motion.states[-1]
    assert motion.cost + end @ terminal @ end == pytest.approx(exact.value(start), rel=1e-6)
    assert motion.duration == pytest.approx(horizon)
    assert motion.costates is not None
    # Interval ends are of order 5, the points between of order 3.
    ends = slice(None, None, 3)
    gradients = exact.gradient(motion.states, motion.times)
    scale = np.abs(gradients).max()
    assert motion.costates[ends] == pytest.approx(gradients[ends], abs=1e-6 * scale)
    assert motion.costates == pytest.approx(gradients, abs=1e-3 * scale)
    inputs = exact.input(motion.states, motion.times)
    assert motion.inputs == pytest.approx(inputs, abs=2e-3 * np.abs(inputs).max())


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_order_of_convergence(degree):
    """Cost and costates at interval ends: 2 d - 1; inputs and inner costates: d."""
    query, horizon, start = linear_quadratic_query(), 3.0, np.array([1.0, 2.0])
    exact = differential_riccati(LinearQuadratic.of_query(query), TERMINAL, horizon)
    guess = default_guesses(query, start, horizon)[0]
    errors = []
    for intervals in (12, 24):
        problem = Problem(query, start, even_mesh(intervals), (horizon, horizon), TERMINAL)
        ready = program(Structure.of(query, intervals, degree, ends_at_goal=False))
        motion = ready.solve(problem, guess, 0.0, np.inf)
        points = motion.trajectory()
        assert points.costates is not None
        gradients = exact.gradient(points.states, points.times)
        inputs = exact.input(points.states, points.times)
        errors.append(
            [
                abs(motion.total_cost - exact.value(start)),
                np.abs(points.costates[0] - gradients[0]).max(),
                np.abs(points.costates - gradients).max(),
                np.abs(points.inputs[1:] - inputs[1:]).max(),
            ]
        )
    orders = np.log2(np.array(errors[0]) / np.array(errors[1]))
    high, low = 2 * degree - 1, degree
    assert (np.abs(orders - [high, high, low, low]) < [0.15, 0.15, 0.25, 0.25]).all()


# Free final time


@pytest.mark.parametrize("distance", [0.6, 1.5, 4.0, 7.0])
@pytest.mark.parametrize("backward", [False, True])
def test_straight_drives_match_the_closed_form(distance, backward):
    angle = np.deg2rad(25.0)
    ray = np.array([np.cos(angle), np.sin(angle)])
    heading = angle if backward else angle - np.pi
    start = np.array([*(distance * ray - 2.0), heading])
    query = Query("unicycle", Goal((-2.0, -2.0), 0.5))
    motion = solve_collocation(query, start, tolerance=1e-8)
    # The last 1e-7 m and the price of time cost some 1e-9.
    assert motion.cost == pytest.approx(aligned_value(distance), abs=2e-8)
    assert np.allclose(motion.states[:, 2], motion.states[0, 2], atol=1e-6)


@pytest.mark.parametrize("goal", list(TABLE_ONE_OPTIMA))
def test_known_optima_of_the_papers_queries(goal):
    motion = solve_collocation(paper_query(goal), START)
    assert motion.cost == pytest.approx(TABLE_ONE_OPTIMA[goal], rel=2e-6)
    assert motion.status is Status.SOLVED


def test_trajectory_is_consistent():
    query = paper_query((1.0, 1.0))
    motion = solve_collocation(query, START)
    assert motion.times[0] == 0.0
    assert (np.diff(motion.times) > 0).all()
    assert np.array_equal(motion.start, START)
    assert query.goal_distance(motion.states[-1]) == pytest.approx(0.0, abs=1e-6)
    assert (query.goal_distance(motion.states[:-1]) > 0).all()
    assert motion.cost_so_far[0] == 0.0
    assert (np.diff(motion.cost_so_far) > 0).all()
    assert motion.costates is not None
    # H = 0 along an optimum, up to the price of time; points inside intervals are of order 3.
    hamiltonian = minimised_hamiltonians(query, motion.states, motion.costates)
    assert np.abs(hamiltonian[::3]).max() < 1e-4
    assert np.abs(hamiltonian).max() < 5e-3
    stationary = optimal_inputs(query, motion.states, motion.costates)
    assert motion.inputs == pytest.approx(stationary, abs=5e-3)


def test_the_costate_at_the_start_is_the_gradient_of_the_cost():
    query = paper_query((4.0, 4.0))
    motion = solve_collocation(query, START, tolerance=1e-8)
    assert motion.costates is not None
    step = 1e-2
    for k in range(3):
        moved = [
            solve_collocation(query, START + sign * step * np.eye(3)[k], motion, tolerance=1e-8)
            for sign in (1, -1)
        ]
        slope = (moved[0].cost - moved[1].cost) / (2 * step)
        # Central differences are wrong by step^2 / 6 times third derivatives of order 1.
        assert motion.costates[0, k] == pytest.approx(slope, abs=1e-4)


def test_cost_is_unchanged_by_a_half_turn_and_by_whole_turns():
    query = paper_query((1.0, 1.0))
    cost = solve_collocation(query, [2.5, 3.0, 0.4]).cost
    assert solve_collocation(query, [2.5, 3.0, 0.4 + np.pi]).cost == pytest.approx(cost, rel=2e-6)
    assert solve_collocation(query, [2.5, 3.0, 0.4 - 4 * np.pi]).cost == pytest.approx(
        cost, rel=1e-9
    )


def test_a_warm_start_finds_the_same_answer():
    query = paper_query((1.0, 4.0))
    cold = solve_collocation(query, START)
    warm = solve_collocation(query, START, cold)
    assert warm.cost == pytest.approx(cold.cost, rel=3e-6)


def test_a_start_in_the_goal_costs_nothing():
    motion = solve_collocation(paper_query((4.0, 4.0)), [4.1, 4.2, 1.0])
    assert motion.cost == 0.0
    assert motion.duration == 0.0


@pytest.mark.parametrize("distance", [1e-3, 1e-2, 0.1])
@pytest.mark.parametrize("heading", [0.0, np.pi / 2])
def test_starts_beside_the_goal(distance, heading):
    """Seen from the goal at an angle `heading`: no cheaper than aligned, and H = 0 at the start."""
    query = Query("unicycle", Goal((0.0, 0.0), 0.5))
    motion = solve_collocation(query, [0.5 + distance, 0.0, heading])
    assert motion.cost >= aligned_value(0.5 + distance) * (1 - 1e-5)
    if heading == 0.0:
        assert motion.cost == pytest.approx(aligned_value(0.5 + distance), rel=1e-4)
    assert motion.costates is not None
    hamiltonian = minimised_hamiltonians(query, motion.start, motion.costates[0])
    assert abs(float(hamiltonian)) < 1e-3 * float(query.running_cost(motion.start, np.zeros(2)))


# Limits


@pytest.mark.parametrize("model", ["unicycle", "double-integrator-2d"])
def test_input_bounds_hold_and_cost(model):
    limits = (-0.4,) * 2, (0.5,) * 2
    free = Query(model, Goal((2.0, 2.0), 0.5))
    bounded = replace(free, input_lower=limits[0], input_upper=limits[1])
    start = np.array([-2.0, -1.0, 0.3, 0.1])[: free.system.n]
    motion = solve_collocation(bounded, start, tolerance=1e-5)
    assert (motion.inputs >= -0.4).all()
    assert (motion.inputs <= 0.5).all()
    assert (np.abs(motion.inputs - 0.5) < 1e-6).any()
    assert motion.cost > solve_collocation(free, start).cost * 1.002


@pytest.mark.parametrize("radius", [0.0, 0.3])
@pytest.mark.parametrize(
    "wall",
    [
        Obstacle.circle((0.0, 0.0), 1.5, hard=True),
        Obstacle.polygon([(-1, -1), (1.5, -1), (1.5, 1), (-1, 1)], hard=True),
    ],
    ids=["circle", "block"],
)
def test_hard_obstacles_hold_between_the_points(wall, radius):
    """The obstacle's soft cost is off, so that the optimum touches it."""
    query = Query(
        "double-integrator-2d",
        Goal((4.0, 4.0), 0.5),
        (wall,),
        RunningCost(obstacle=0.0),
        robot_radius=radius,
    )
    start = np.array([-4.0, -4.0, 0.0, 0.0])
    motion = solve_collocation(query, start)
    assert motion.cost > solve_collocation(replace(query, obstacles=()), start).cost * 1.001
    # p'' = u, and u is a quadratic on each interval of 3 points: integrate again, finely.
    fine = between_points(query, motion)
    assert fine[-1] == pytest.approx(motion.states[-1], abs=1e-4)
    clearance = query.clearance(fine, hard_only=True)
    assert clearance.min() >= -1e-5
    assert clearance.min() < 0.02


def between_points(query: Query, motion) -> np.ndarray:
    """States at many times under the motion's input polynomials, by scipy."""
    state, found = motion.start, []
    for k in range(0, len(motion.times) - 1, 3):
        at, u = motion.times[k + 1 : k + 4], motion.inputs[k + 1 : k + 4]
        fit = np.polynomial.polynomial.polyfit(at - motion.times[k], u, 2)

        def rate(t, x, fit=fit):
            u = np.polynomial.polynomial.polyval(t, fit)
            return np.array(query.system.dynamics(x, u))[:, 0]

        span = motion.times[k + 3] - motion.times[k]
        times = np.linspace(0, span, 100)
        run = solve_ivp(rate, (0, span), state, t_eval=times, rtol=1e-9, atol=1e-11)
        found.append(run.y.T)
        state = run.y[:, -1]
    return np.concatenate(found)


def test_global_replay_by_scipy_agrees():
    query = paper_query((4.0, 4.0))
    motion = solve_collocation(query, START)
    assert between_points(query, motion)[-1] == pytest.approx(motion.states[-1], abs=1e-4)


# Honesty


def test_a_replay_catches_a_transcription_that_cheats():
    """Two long intervals claim a ninth of the true cost: the nodes wait on the goal's boundary."""
    query = Query("unicycle", Goal((4.0, 4.0), 0.5))
    start = np.array([3.4, 4.0, 0.3])
    exact = solve_collocation(query, start)
    guess = default_guesses(query, start)[0]
    slow = replace(
        guess,
        times=guess.times * 10 / guess.duration,
        inputs=guess.inputs * guess.duration / 10,
    )
    problem = Problem(query, start, even_mesh(2), (10.0, 30.0))
    cheat = program(Structure.of(query, 2)).solve(problem, slow, 1e-6, np.inf)
    assert cheat.total_cost < exact.cost / 5
    verdict = judge(cheat, ends_at_goal=True)
    assert np.abs(verdict.errors).sum() > exact.cost / 2
    honest = solve_collocation(query, start, slow, intervals=2)
    assert honest.cost == pytest.approx(exact.cost, rel=1e-5)


def test_the_error_estimate_is_the_error():
    query, horizon, start = linear_quadratic_query(), 3.0, np.array([1.0, 2.0])
    exact = differential_riccati(LinearQuadratic.of_query(query), TERMINAL, horizon)
    guess = default_guesses(query, start, horizon)[0]
    problem = Problem(query, start, even_mesh(12), (horizon, horizon), TERMINAL)
    motion = program(Structure.of(query, 12, ends_at_goal=False)).solve(problem, guess, 0, np.inf)
    estimate = judge(motion, ends_at_goal=False).errors.sum()
    assert estimate == pytest.approx(exact.value(start) - motion.total_cost, rel=0.1)


def test_no_admissible_motion_is_reported():
    """The bounded rover is too weak for its spring; a goal in a hard obstacle is out of reach."""
    weak = typical_query("rover", bounded=True)
    with pytest.raises(SolveError) as caught:
        solve_collocation(weak, [-3.0, -3.0, 0.0, 0.0])
    assert caught.value.status is Status.INFEASIBLE
    buried = Query("unicycle", Goal((2.0, 2.0), 0.3), (Obstacle.circle((2, 2), 1.5, hard=True),))
    with pytest.raises(SolveError) as caught:
        solve_collocation(buried, START, max_iterations=100)
    assert caught.value.status in (Status.INFEASIBLE, Status.NOT_CONVERGED)


def test_a_cost_that_never_ends_the_motion_is_reported():
    """With no state cost, slower is always cheaper."""
    query = Query("single-integrator-1d", Goal((4.0,), 0.5), cost=RunningCost(goal=0.0))
    with pytest.raises(SolveError, match="duration grows without bound") as caught:
        solve_collocation(query, [-4.0])
    assert caught.value.status is Status.NOT_CONVERGED


def test_limits_are_kept():
    query = paper_query((1.0, 4.0))
    with pytest.raises(SolveError) as caught:
        solve_collocation(query, START, max_iterations=3)
    assert caught.value.status is Status.NOT_CONVERGED
    with pytest.raises(SolveError) as caught:
        solve_collocation(query, START, time_limit=0.0)
    assert caught.value.status is Status.TIME_LIMIT
    with pytest.raises(SolveError, match="replayed on 20 intervals, costs differ by") as caught:
        solve_collocation(query, START, max_intervals=20, tolerance=1e-9)
    assert caught.value.status is Status.NOT_CONVERGED


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0.0}, r"^horizon: must be a positive"),
        ({"horizon": np.inf}, r"^horizon: must be a positive"),
        ({"terminal_cost": np.eye(3)}, r"^terminal_cost: needs a horizon"),
        ({"horizon": 1.0, "terminal_cost": np.eye(2)}, r"^terminal_cost: must be a symmetric 3"),
        ({"horizon": 1.0, "terminal_cost": -np.eye(3)}, r"^terminal_cost: must be positive"),
        ({"intervals": 1}, r"^intervals: must be between"),
        ({"degree": 1}, r"^degree: must be between"),
        ({"degree": 9}, r"^degree: must be between"),
        ({"max_intervals": 5}, r"^max_intervals: must be between"),
        ({"max_iterations": 0}, r"^max_iterations: must be between"),
        ({"tolerance": 0.0}, r"^tolerance: must be between"),
        ({"tolerance": np.nan}, r"^tolerance: must be between"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve_collocation(paper_query((4.0, 4.0)), START, **arguments)


def test_bad_starts_are_named():
    wall = Obstacle.circle((0.0, 0.0), 1.0, hard=True)
    query = Query("unicycle", Goal((4.0, 4.0), 0.5), (wall,))
    for start in ([0.0, 0.0], [9.0, 0.0, 0.0], [0.2, 0.1, 0.0], [np.nan, 0.0, 0.0]):
        with pytest.raises(ValueError, match=r"^start: "):
            solve_collocation(query, start)
