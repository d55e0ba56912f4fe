"""A fixed horizon of steps with held inputs, as a nonlinear program that is built once.

Multiple shooting: each step is one Runge-Kutta step of the dynamics and of the running cost, so
that the programme's cost is that of the closed loop to fourth order. The numbers of a query and the
start are parameters. The cost at the end is any function with two derivatives, evaluated outside
CasADi: the quadratic one of the textbooks, a grid's value, a network's.

A horizon often ends just where the goal cost Q begins to count, and there Q has a kink that
Newton's method does not settle on. Q^3 / (Q^2 + delta^2) stands for Q, delta = `SMOOTHING`: it has
two derivatives at the goal's boundary and is lower by at most delta / 2, by delta^2 / Q far off.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp import cost as costs
from ocp.kernels import parameters
from ocp.query import Query
from ocp.trajectory import SolveError, Status
from ocp.transcription.terms import Structure, clearance, effort, state_cost, symbol

Array = NDArray[np.float64]

SMOOTHING = 0.02
IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "acceptable_tol": 1e-6,
    "acceptable_iter": 0,  # stop there only when no step makes progress
    "mu_init": 1e-2,
}
PUSH = 1e-9
WARM = {
    "warm_start_init_point": "yes",
    "mu_init": 1e-6,
    "warm_start_bound_push": PUSH,
    "warm_start_bound_frac": PUSH,
    "warm_start_slack_bound_push": PUSH,
    "warm_start_slack_bound_frac": PUSH,
    "warm_start_mult_bound_push": PUSH,
}


class EndCost(Protocol):
    """A cost of the state at the horizon's end."""

    def derivatives(self, state: Array) -> tuple[float, Array, Array]:
        """Its value, gradient `[n]` and symmetric second derivative `[n, n]` at `state` `[n]`."""
        ...


@dataclass(frozen=True, eq=False)
class HorizonPlan:
    """An optimal motion over the horizon of `k` steps.

    Attributes:
        states: `[k + 1, n]`.
        inputs: `[k, m]`, each held for a step.
        multipliers: `[k, ...]` of each step's constraints.
        cost: running cost plus the cost at the end.
        costate: `[n]`, the derivative of that cost by the start.
        iterations: of IPOPT.
    """

    states: Array
    inputs: Array
    multipliers: Array
    cost: float
    costate: Array
    iterations: int


class _End(ca.Callback):
    """The cost at the end as a CasADi function x -> (value, gradient, second derivative)."""

    def __init__(self, n: int) -> None:
        ca.Callback.__init__(self)
        self._n = n
        self.cost: EndCost | None = None
        self._last: tuple[bytes, list[Any]] | None = None
        self.construct("end", {})

    def set(self, cost: EndCost) -> None:
        self.cost, self._last = cost, None

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 3

    def get_sparsity_in(self, i: int) -> ca.Sparsity:  # noqa: ARG002
        return ca.Sparsity.dense(self._n, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1 if i == 0 else self._n, self._n if i == 2 else 1)

    def eval(self, arg: Any) -> list[Any]:
        state = np.array(arg[0])[:, 0]
        key = state.tobytes()
        if self._last is None or self._last[0] != key:
            assert self.cost is not None
            self._last = key, list(self.cost.derivatives(state))
        return self._last[1]


class HorizonProgram:
    """The program of a structure. Variables: for each step its input and the state at its end.

    Constraints: for each step its defect `[n]`, then the clearances of hard obstacles at its end.
    """

    def __init__(self, structure: Structure, step: float) -> None:
        layout = structure.layout
        n, m, k = layout.n, layout.m, structure.intervals
        self.structure = structure
        q = symbol("q", layout.count + 1 + layout.stride * len(structure.facets))
        start, radius = symbol("start", n), symbol("radius")
        self.step = _runge_kutta(structure, step)
        variables, held, total, before = [], [], ca.SX(0), start
        for i in range(k):
            u, x = symbol(f"u{i}", m), symbol(f"x{i + 1}", n)
            reached, run = self.step(before, u, q)
            position = x[list(structure.system.position)]
            total += run
            variables += [u, x]
            held.append(x - reached)
            held += [clearance(o, position, radius, structure.inflated) for o in structure.hard]
            before = x
        z, g = ca.vertcat(*variables), ca.vertcat(*held)
        p = ca.vertcat(q, start, radius)
        self._solvers = self._build(z, p, total, g)
        prices = symbol("l", g.numel())
        lagrangian = total + ca.dot(prices, g)
        self._costate = ca.Function("costate", [z, p, prices], [ca.gradient(lagrangian, start)])

    def _build(self, z: ca.SX, p: ca.SX, total: ca.SX, g: ca.SX) -> tuple[ca.Function, ca.Function]:
        """The cold and the warm solver; the cost at the end joins the derivatives by hand."""
        n, size = self.structure.layout.n, z.numel()
        price, prices = symbol("s", 1), symbol("l", g.numel())
        run = ca.Function("run", [z, p], [total, ca.gradient(total, z)])
        held = ca.Function("held", [z, p], [g, ca.jacobian(g, z)])
        curvature, _ = ca.hessian(price * total + ca.dot(prices, g), z)
        curve = ca.Function("curve", [z, p, price, prices], [curvature])
        self._end = _End(n)
        Z, P, S, L = (
            ca.MX.sym(name, s.numel())  # pyright: ignore[reportArgumentType]
            for name, s in (("z", z), ("p", p), ("s", price), ("l", prices))
        )
        value, gradient, second = self._end(Z[size - n :])
        rest = size - n
        f = run(Z, P)[0] + value
        slope = run(Z, P)[1] + ca.vertcat(ca.MX(rest, 1), gradient)
        bend = curve(Z, P, S, L) + ca.diagcat(ca.MX(rest, rest), S * second)
        names = ["x", "p"]
        derivatives = {
            "grad_f": ca.Function("grad_f", [Z, P], [f, slope], names, ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [Z, P], list(held(Z, P)), names, ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "hess_lag",
                [Z, P, S, L],
                [ca.triu(bend)],
                [*names, "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            ),
        }
        nlp = {"x": Z, "p": P, "f": f, "g": held(Z, P)[0]}
        options: dict[str, Any] = {
            "print_time": False,
            "show_eval_warnings": False,
            "error_on_fail": False,
            "calc_lam_p": False,
            "no_nlp_grad": True,
            **derivatives,
        }
        ipopt = {**IPOPT, "max_iter": self.structure.max_iterations}
        cold = ca.nlpsol("cold", "ipopt", nlp, {**options, "ipopt": ipopt})
        warm = ca.nlpsol("warm", "ipopt", nlp, {**options, "ipopt": {**ipopt, **WARM}})
        return cold, warm

    def solve(
        self,
        query: Query,
        start: Array,
        end: EndCost,
        states: Array,
        inputs: Array,
        multipliers: Array | None = None,
    ) -> HorizonPlan:
        """The motion from `start` `[n]` near the guess `states` `[k, n]`, `inputs` `[k, m]`.

        Args:
            query: of the program's structure.
            start: where the motion begins.
            end: the cost at its end.
            states: a guess of the states at the steps' ends.
            inputs: a guess of the held inputs.
            multipliers: `[k, ...]`, of a neighbouring solution, if there is one.

        Raises:
            SolveError: NOT_CONVERGED or INFEASIBLE.
        """
        s = self.structure
        n, k = s.layout.n, s.intervals
        low, high = query.input_bounds
        free = np.full(n, np.inf)
        most = np.zeros((k, n + len(s.hard)))
        most[:, n:] = np.inf
        numbers = np.concatenate([parameters(query), start, [query.robot_radius]])
        self._end.set(end)
        solver = self._solvers[0 if multipliers is None else 1]
        result = solver(
            x0=np.concatenate([inputs, states], axis=1).ravel(),
            lam_g0=0.0 if multipliers is None else multipliers.ravel(),
            p=numbers,
            lbx=np.tile(np.concatenate([low, -free]), k),
            ubx=np.tile(np.concatenate([high, free]), k),
            lbg=np.zeros(most.size),
            ubg=most.ravel(),
        )
        stats = solver.stats()
        outcome = stats["return_status"]
        if outcome not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            infeasible = outcome == "Infeasible_Problem_Detected"
            status = Status.INFEASIBLE if infeasible else Status.NOT_CONVERGED
            raise SolveError(status, f"IPOPT: {outcome}, {k} steps from {start}")
        z, prices = np.array(result["x"])[:, 0], np.array(result["lam_g"])[:, 0]
        rows = z.reshape(k, -1)
        return HorizonPlan(
            np.concatenate([start[None], rows[:, -n:]]),
            np.clip(rows[:, :-n], low, high),
            prices.reshape(k, -1),
            float(result["f"]),
            np.array(self._costate(z, numbers, prices))[:, 0],
            int(stats["iter_count"]),
        )


def _runge_kutta(structure: Structure, step: float) -> ca.Function:
    """(x, u, q) -> (state after a step of held input, running cost of the step)."""
    layout, system = structure.layout, structure.system
    x, u = symbol("x", layout.n), symbol("u", layout.m)
    q = symbol("q", layout.count + 1 + layout.stride * len(structure.facets))
    moved, total = x, ca.SX(0)
    rate = ca.SX.zeros(layout.n, 1)
    for weight, share in ((1, 0.0), (2, 0.5), (2, 0.5), (1, 1.0)):
        at = x + share * step * rate
        rate = system.dynamics(at, u)
        moved += step * weight / 6 * rate
        total += (
            step * weight / 6 * (_smooth_state_cost(structure, at, q) + effort(structure, u, q))
        )
    return ca.Function("step", [x, u, q], [moved, total])


def _smooth_state_cost(structure: Structure, x: ca.SX, q: ca.SX) -> ca.SX:
    goal = structure.layout.goal
    radius = goal + structure.layout.d
    Q = costs.goal_cost(
        x[list(structure.system.position)], q[goal:radius], *q[radius : radius + 3].elements()
    )
    return state_cost(structure, x, q) - Q + Q**3 / (Q**2 + SMOOTHING**2)


@lru_cache(maxsize=32)
def horizon_program(structure: Structure, step: float) -> HorizonProgram:
    """The program of a structure, built once."""
    return HorizonProgram(structure, step)
