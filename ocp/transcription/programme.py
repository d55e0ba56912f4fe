"""Optimal control as a nonlinear program: Radau collocation in CasADi, solved by IPOPT.

A program is built once for each robot, form of cost, mesh size and set of hard obstacles; the
numbers of a query, the mesh and the safety margin are parameters.

Costates. With multipliers l_i of the defects sum_j D_ij x_j - h f(x_i, u_i) = 0 and quadrature
weights w_i, stationarity in u_i reads H_u = 0 for p_i = -l_i / w_i. At an interval's start the
derivative of the remaining discrete cost is exactly sum_i D_i0 l_i, of the interval ends' order.

Free final time is degenerate where W = 0 on the goal's boundary: arriving early costs only the
cube of the missing time and waiting there costs nothing, so Newton's method drifts, in and out of
the goal across the kink of Q. Three things make it converge. The points are kept outside the goal;
the motion ends `GOAL_OFFSET` outside its boundary, off the kink (which changes V by about 5e-11);
and time is given a small price, first `FIRST_TIME_PRICE`, then, from that answer and its
multipliers, `TIME_PRICE` of the mean running cost. The last changes the costate by that fraction,
and the cost by far less. No reported cost contains the price.
"""

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp import cost as costs
from ocp.kernels import parameters
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.transcription.radau import CollocatedMotion, radau
from ocp.transcription.terms import (
    Structure,
    clearance,
    effort,
    reference,
    state_cost,
    symbol,
)

Array = NDArray[np.float64]

GOAL_OFFSET = 1e-7  # metres
FIRST_TIME_PRICE = 1e-2
TIME_PRICE = 1e-6

IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-9,
    "acceptable_tol": 1e-7,
    "acceptable_iter": 0,  # stop there only when no step makes progress
}
AMONG_WALLS = {"mu_init": 1e-2}  # the default, 0.1, throws guesses through walls
PUSH = 1e-9
WARM = {
    "warm_start_init_point": "yes",
    "mu_init": 1e-7,
    "max_iter": 60,  # further away, the multipliers mislead
    "warm_start_bound_push": PUSH,
    "warm_start_bound_frac": PUSH,
    "warm_start_slack_bound_push": PUSH,
    "warm_start_slack_bound_frac": PUSH,
    "warm_start_mult_bound_push": PUSH,
}


@dataclass(frozen=True)
class Problem:
    """The numbers of one solve.

    Attributes:
        query: the query.
        start: `[n]`.
        mesh: `[k + 1]` fractions of the duration, from 0 to 1.
        duration: least and largest duration in seconds; equal for a fixed horizon.
        terminal: P_T `[n, n]`, or `None`.
        margin: metres of clearance asked of hard obstacles beyond the robot's radius.
    """

    query: Query
    start: Array
    mesh: Array
    duration: tuple[float, float]
    terminal: Array | None = None
    margin: float = 0.0


class _Clock(ca.Callback):
    """Lets IPOPT ask after each iteration whether to go on."""

    def __init__(self, sizes: dict[str, int]) -> None:
        ca.Callback.__init__(self)
        self.sizes = sizes
        self.deadline = np.inf
        self.construct("clock", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg: Any) -> list[int]:  # noqa: ARG002
        return [int(time.monotonic() > self.deadline)]


class Program:
    """The nonlinear program of a structure.

    Variables: x_0, then for each interval its states `[d, n]`, inputs `[d, m]` and duration.
    Constraints: for each interval its defects `[d, n]`; distances to the goal `[d]` if it ends
    there; clearances of hard obstacles at and between the points `[2d]` each; and, after the first
    interval, the ratio of its duration to the previous one.
    """

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        layout, d, k = structure.layout, structure.degree, structure.intervals
        n, m = layout.n, layout.m
        q = symbol("q", layout.count + 1 + layout.stride * len(structure.facets))
        shares, margin, offset, price = (symbol("s", k), *map(symbol, ("margin", "offset", "e")))
        terminal = symbol("P", n, n)
        interval = self._interval()

        start = symbol("x0", n)
        variables, constraints = [start], []
        total, before, before_duration = ca.SX(0), start, None
        for i in range(k):
            states, inputs, h = symbol(f"x{i}", n, d), symbol(f"u{i}", m, d), symbol(f"h{i}")
            held, run = interval(before, states, inputs, h, q, margin, offset)
            total += run + price * h
            variables += [ca.vec(states), ca.vec(inputs), h]
            constraints.append(held)
            if before_duration is not None:
                constraints.append(k * (h * shares[i - 1] - before_duration * shares[i]))
            before, before_duration = states[:, -1], h
        if not structure.ends_at_goal:
            period = structure.system.period
            total += costs.quadratic_cost(before, reference(structure, q), terminal, period)
        x, g = ca.vertcat(*variables), ca.vertcat(*constraints)
        numbers = ca.vertcat(q, shares, margin, offset, price, ca.vec(terminal))
        sizes = {"x": x.numel(), "f": 1, "g": g.numel()}
        sizes |= {f"lam_{name}": v.numel() for name, v in (("x", x), ("g", g), ("p", numbers))}
        self._clock = _Clock(sizes)
        nlp = {"x": x, "f": total, "g": g, "p": numbers}
        options: dict[str, Any] = {
            "print_time": False,
            "show_eval_warnings": False,
            "error_on_fail": False,
            "iteration_callback": self._clock,
        }
        ipopt = {**IPOPT, "max_iter": structure.max_iterations}
        if structure.hard:
            ipopt |= AMONG_WALLS
        self._cold = ca.nlpsol("cold", "ipopt", nlp, {**options, "ipopt": ipopt})
        derivatives = {
            "grad_f": self._cold.get_function("nlp_grad_f"),
            "jac_g": self._cold.get_function("nlp_jac_g"),
            "hess_lag": self._cold.get_function("nlp_hess_l"),
        }
        ipopt = {**ipopt, **WARM}
        self._warm = ca.nlpsol("warm", "ipopt", nlp, {**options, **derivatives, "ipopt": ipopt})

    @property
    def _at_goal(self) -> int:
        """Constraints on the distance to the goal, for each interval."""
        return self.structure.degree if self.structure.ends_at_goal else 0

    def _interval(self) -> ca.Function:
        """(start, states, inputs, h, q, margin, offset) -> (constraints, running cost)."""
        s = self.structure
        layout, d = s.layout, s.degree
        n, m, rule = layout.n, layout.m, radau(d)
        start, h, margin, offset = symbol("a", n), *map(symbol, ("h", "margin", "offset"))
        states, inputs = symbol("x", n, d), symbol("u", m, d)
        q = symbol("q", layout.count + 1 + layout.stride * len(s.facets))
        nodes = ca.horzcat(start, states)
        slopes = nodes @ ca.DM(rule.derivative.T)
        held, run = [], ca.SX(0)
        for i in range(d):
            x, u = states[:, i], inputs[:, i]
            held.append(slopes[:, i] - h * s.system.dynamics(x, u))
            run += h * rule.weights[i] * (state_cost(s, x, q) + effort(s, u, q))
        place = list(s.system.position)
        if s.ends_at_goal:
            center, radius = q[layout.goal : layout.goal + layout.d], q[layout.goal + layout.d]
            squared = ca.sum1((states[place, :] - ca.repmat(center, 1, d)) ** 2)
            held.append(squared.T - (radius + offset) ** 2)
        everywhere = ca.horzcat(states, nodes @ ca.DM(rule.between.T))[place, :]
        held += [
            clearance(o, everywhere[:, i], margin, s.inflated) for o in s.hard for i in range(2 * d)
        ]
        return ca.Function(
            "interval", [start, states, inputs, h, q, margin, offset], [ca.vertcat(*held), run]
        )

    def solve(
        self,
        problem: Problem,
        guess: Trajectory | CollocatedMotion,
        price: float,
        deadline: float,
    ) -> CollocatedMotion:
        """Solve from a guess, with its multipliers if it has costates.

        Args:
            problem: what to solve.
            guess: a motion near the answer if it has costates, else any.
            price: of time, as a fraction of the guess's mean running cost; ignored if fixed.
            deadline: the solve ends when `time.monotonic()` passes it.

        Raises:
            SolveError: NOT_CONVERGED, INFEASIBLE or TIME_LIMIT.
        """
        self._clock.deadline = deadline
        states, inputs, costates = self._sampled(problem, guess)
        duration = float(np.clip(guess.duration, *problem.duration))
        price *= guess.cost / guess.duration
        variables = self._packed(problem, states, inputs, duration)
        if costates is None:
            answer = self._run(self._cold, problem, price, variables)
        else:
            multipliers = self._multipliers(problem, states[-1, -1], costates)
            answer = self._run(self._warm, problem, price, variables, multipliers)
        return self._motion(problem, *answer)

    def _run(
        self,
        solver: ca.Function,
        problem: Problem,
        price: float,
        variables: Array,
        multipliers: Array | None = None,
    ) -> tuple[Array, Array]:
        """Variables and multipliers of the constraints at the solution."""
        query, low, high = problem.query, *problem.query.input_bounds
        n, d, k = self.structure.layout.n, self.structure.degree, self.structure.intervals
        shares = np.diff(problem.mesh)
        free = np.full(n * d, np.inf)
        lower = np.tile(np.concatenate([-free, np.tile(low, d), [0.0]]), (k, 1))
        upper = np.tile(np.concatenate([free, np.tile(high, d), [np.inf]]), (k, 1))
        lower[0, -1], upper[0, -1] = np.array(problem.duration) * shares[0]
        least, most = self._constraint_bounds()
        # The motion must not end where it starts.
        offset = min(GOAL_OFFSET, 1e-3 * max(float(query.goal_distance(problem.start)), 0.0))
        few = [query.robot_radius + problem.margin, offset]
        few.append(price if self.structure.ends_at_goal else 0.0)
        terminal = np.zeros((n, n)) if problem.terminal is None else problem.terminal
        result = solver(
            x0=variables,
            lam_g0=0.0 if multipliers is None else multipliers,
            p=np.concatenate([parameters(query), shares, few, terminal.ravel(order="F")]),
            lbx=np.concatenate([problem.start, lower.ravel()]),
            ubx=np.concatenate([problem.start, upper.ravel()]),
            lbg=least,
            ubg=most,
        )
        outcome = solver.stats()["return_status"]
        if outcome not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            statuses = {
                "Infeasible_Problem_Detected": Status.INFEASIBLE,
                "User_Requested_Stop": Status.TIME_LIMIT,
            }
            status = statuses.get(outcome, Status.NOT_CONVERGED)
            raise SolveError(status, f"IPOPT: {outcome}, {k} intervals")
        return np.array(result["x"])[:, 0], np.array(result["lam_g"])[:, 0]

    def _constraint_bounds(self) -> tuple[Array, Array]:
        s = self.structure
        n, d = s.layout.n, s.degree
        most = np.full((s.intervals, self._stride), np.inf)
        most[:, : n * d] = 0.0
        most[:, -1] = 0.0
        if s.ends_at_goal:
            most[-1, n * d + d - 1] = 0.0
        most = np.delete(most.ravel(), self._stride - 1)
        return np.zeros_like(most), most

    @property
    def _stride(self) -> int:
        """Constraints of an interval, the ratio of durations included."""
        s = self.structure
        return s.layout.n * s.degree + self._at_goal + 2 * s.degree * len(s.hard) + 1

    def _place(self, state: Array) -> Array:
        return state[list(self.structure.system.position)]

    def _sampled(
        self, problem: Problem, guess: Trajectory | CollocatedMotion
    ) -> tuple[Array, Array, Array | None]:
        """The guess at the Radau points `[k, d, ...]`, moved so that it begins at the start."""
        shares = np.diff(problem.mesh)
        points = problem.mesh[:-1, None] + shares[:, None] * radau(self.structure.degree).points
        costates: Array | None
        if isinstance(guess, CollocatedMotion):
            states, inputs, costates = guess.at(points)
            costates[-1, -1] = guess.final_costate
        else:
            at = points * guess.duration

            def sample(values: Array) -> Array:
                return np.stack([np.interp(at, guess.times, c) for c in values.T], axis=-1)

            states, inputs = sample(guess.states), sample(guess.inputs)
            costates = None if guess.costates is None else sample(guess.costates)
        shift = self.structure.system.difference(problem.start, guess.start)
        turns = problem.start - guess.start - shift  # whole periods
        return states + turns + shift * (1 - points[..., None]), inputs, costates

    def _multipliers(self, problem: Problem, end: Array, costates: Array) -> Array:
        """Multipliers of the constraints from costates `[k, d, n]`; inactive ones are 0."""
        n, d = self.structure.layout.n, self.structure.degree
        rows = np.zeros((len(costates), self._stride))
        rows[:, : n * d] = (-costates * radau(d).weights[:, None]).reshape(len(costates), -1)
        if self.structure.ends_at_goal:
            outward = 2 * (self._place(end) - problem.query.goal_position)
            push = self._place(costates[-1, -1]) @ outward
            rows[-1, n * d + d - 1] = push / (outward @ outward)
        return np.delete(rows.ravel(), self._stride - 1)

    def _packed(self, problem: Problem, states: Array, inputs: Array, duration: float) -> Array:
        shares = np.diff(problem.mesh)
        rows = (states.reshape(len(shares), -1), inputs.reshape(len(shares), -1))
        parts = np.concatenate([*rows, duration * shares[:, None]], axis=1)
        return np.concatenate([problem.start, parts.ravel()])

    def _motion(self, problem: Problem, x: Array, multipliers: Array) -> CollocatedMotion:
        s = self.structure
        n, m, d, k = s.layout.n, s.layout.m, s.degree, s.intervals
        rule, query = radau(d), problem.query
        rows = x[n:].reshape(k, -1)
        states = rows[:, : n * d].reshape(k, d, n)
        padded = np.insert(multipliers, self._stride - 1, 0.0).reshape(k, self._stride)
        dual = padded[:, : n * d].reshape(k, d, n)
        last = states[-1, -1]
        final = np.zeros(n)
        if s.ends_at_goal:
            outward = 2 * (self._place(last) - query.goal_position)
            final[list(s.system.position)] = padded[-1, n * d + d - 1] * outward
        elif problem.terminal is not None:
            final = query.terminal_gradient(last, problem.terminal)
        return CollocatedMotion(
            query,
            problem.terminal,
            starts=np.concatenate([x[None, :n], states[:-1, -1]]),
            states=states,
            inputs=np.clip(rows[:, n * d : -1].reshape(k, d, m), *query.input_bounds),
            durations=rows[:, -1],
            start_costates=np.einsum("i,kin->kn", rule.derivative[:, 0], dual),
            costates=-dual / rule.weights[:, None],
            final_costate=final,
        )


@lru_cache(maxsize=32)
def program(structure: Structure) -> Program:
    """The program of a structure, built once."""
    return Program(structure)
