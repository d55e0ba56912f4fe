"""Drake's DirectCollocation on the same problem: a referee that shares no code with ours.

Drake transcribes with Hermite-Simpson dynamics and the trapezoid rule for the cost (Hargraves and
Paris 1987), evaluates the plant by automatic differentiation, and calls IPOPT or SNOPT. It gives no
second derivatives, so both build their own from gradients; on the acrobot IPOPT's (limited memory)
stall, SNOPT's do not.
"""

import time
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.models.multibody import MultibodyModel
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory

Array = NDArray[np.float64]


class Solver(Enum):
    """Of Drake's nonlinear programmes."""

    IPOPT = "ipopt"
    SNOPT = "snopt"


@dataclass(frozen=True)
class DrakeMotion:
    """Drake's answer.

    Attributes:
        times, states, inputs: `[k]`, `[k, n]`, `[k, m]` at the knots, states in the System's order.
        cost: running and terminal cost by Drake's quadrature.
        build_seconds, solve_seconds: wall time.
    """

    times: Array
    states: Array
    inputs: Array
    cost: float
    build_seconds: float
    solve_seconds: float


def drake_collocation(
    model: MultibodyModel,
    query: Query,
    guess: Trajectory,
    terminal: Array,
    *,
    knots: int = 61,
    tolerance: float = 1e-6,
    max_iterations: int = 1000,
    time_limit: float = np.inf,
    solver: Solver = Solver.IPOPT,
) -> DrakeMotion:
    """The motion over the guess's horizon that minimises running plus terminal cost.

    Args:
        model: the query's robot.
        query: with a quadratic cost and an `Equilibrium` as its goal; hard obstacles are kept clear
            at the knots.
        guess: from the start; its duration is the horizon.
        terminal: P `[n, n]`.
        knots: of the transcription.
        tolerance: of the solver; SNOPT minimises the cost in units of the guess's.
        max_iterations: of the solver.
        time_limit: processor seconds of the solver.
        solver: which one.

    Raises:
        SolveError: if the solver did not converge.
    """
    import pydrake.symbolic as symbolic
    from pydrake.planning import DirectCollocation
    from pydrake.solvers import IpoptSolver, SnoptSolver, SolverOptions
    from pydrake.trajectories import PiecewisePolynomial

    began = time.perf_counter()
    system, n = query.system, query.system.n
    order = model.order
    diagram = model.diagram()
    context = diagram.CreateDefaultContext()
    step = guess.duration / (knots - 1)
    programme: Any = DirectCollocation(
        diagram, context, knots, step, step, diagram.GetInputPort("u").get_index()
    )
    mathematical = programme.prog()
    inverse = np.argsort(order)

    def ours(state: Any) -> list[Any]:
        return [state[order[i]] for i in range(n)]

    start = guess.states[0]
    mathematical.AddBoundingBoxConstraint(start[inverse], start[inverse], programme.initial_state())
    lower, upper = query.input_bounds
    for k in range(knots):
        mathematical.AddBoundingBoxConstraint(lower, upper, programme.input(k))
    # The goal as our motion approaches it: whole turns away, perhaps.
    end = guess.states[-1]
    goal = end - system.difference(end, query.reference)
    weights = query.input_weights
    assert query.cost.state is not None
    M = np.array(query.cost.state)
    x, u = ours(programme.state()), list(programme.input())
    effort = sum(
        w * (a - b) ** 2 for w, a, b in zip(weights, u, query.reference_input, strict=True)
    )
    # SNOPT's tolerances are for costs of order 1; IPOPT scales by itself.
    unit = max(guess.cost, 1.0) if solver is Solver.SNOPT else 1.0
    running = _quadratic(x, goal, M, system.period, symbolic) + effort
    programme.AddRunningCost(running / unit)
    final = ours(programme.final_state())
    P = np.asarray(terminal) / unit
    mathematical.AddCost(_quadratic(final, goal, P, system.period, symbolic))
    for obstacle in query.hard_obstacles:
        gap = (obstacle.radius + query.robot_radius) ** 2
        place = [x[i] for i in system.position]
        distance = sum((a - b) ** 2 for a, b in zip(place, obstacle.center, strict=True))
        programme.AddConstraintToAllKnotPoints(distance >= gap)
    times = np.linspace(0.0, guess.duration, knots)
    states = np.stack([np.interp(times, guess.times, c) for c in guess.states.T])
    inputs = np.stack([np.interp(times, guess.times, c) for c in guess.inputs.T])
    programme.SetInitialTrajectory(
        PiecewisePolynomial.FirstOrderHold(times, inputs),
        PiecewisePolynomial.FirstOrderHold(times, states[inverse]),
    )
    options = SolverOptions()
    engine: Any = IpoptSolver() if solver is Solver.IPOPT else SnoptSolver()
    if solver is Solver.IPOPT:
        named: dict[str, Any] = {"tol": tolerance, "max_iter": max_iterations}
        limit = "max_cpu_time"
    else:
        named = {
            "Major optimality tolerance": tolerance,
            "Major iterations limit": max_iterations,
            "Iterations limit": 1000 * max_iterations,
            "Superbasics limit": knots * (n + system.m),
        }
        limit = "Time limit"
    if time_limit < np.inf:
        named[limit] = float(time_limit)
    for name, value in named.items():
        options.SetOption(engine.id(), name, value)
    built = time.perf_counter()
    result = engine.Solve(mathematical, None, options)
    ended = time.perf_counter()
    if not result.is_success():
        raise SolveError(Status.NOT_CONVERGED, f"Drake: {result.get_solution_result()}")
    found = programme.GetStateSamples(result).T[:, order]
    return DrakeMotion(
        programme.GetSampleTimes(result),
        found,
        programme.GetInputSamples(result).T,
        unit * float(result.get_optimal_cost()),
        built - began,
        ended - built,
    )


def _quadratic(x: list[Any], goal: Array, matrix: Array, period: Array, symbolic: Any) -> Any:
    """`ocp.cost.quadratic_cost`, written again in Drake's symbols: a referee's own reading."""
    total, parts = 0.0, []
    for i, p in enumerate(period):
        gap = x[i] - goal[i]
        if p == 0:
            parts.append(gap)
            continue
        scale = p / (2 * np.pi)
        parts.append(scale * symbolic.sin(gap / scale))
        chord = 2 * scale * symbolic.sin(gap / (2 * scale))
        total += matrix[i, i] * (chord**2 - parts[-1] ** 2)
    for i, a in enumerate(parts):
        for j, b in enumerate(parts):
            if matrix[i, j] != 0:
                total += matrix[i, j] * a * b
    return total
