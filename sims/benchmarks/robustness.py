"""Closed loops when the robot is not as modelled: reached, and excess over the exact cost.

Every method plans with the right model and is then driven through `sims.disturbance`. The exact
cost is that of the undisturbed robot: what excess cannot be avoided (a saturated robot is slower)
is in the figures of all methods alike. All hold their inputs equally long.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ocp.planning import Planner, plan, trajectories
from ocp.query_family import PAPER_FAMILY
from ocp.value import Policy
from sims.benchmarks import Report
from sims.benchmarks.learning import Problem, notes, problem
from sims.closed_loop import LoopSettings, rollouts
from sims.disturbance import Disturbance
from sims.methods import METHODS

QUERIES, STARTS = 20, 5
SLOW_QUERIES, SLOW_STARTS = 10, 1
"""Likewise for methods that optimise at every instant."""
LOOP = LoopSettings(period=0.1, time_limit=60.0)
TRACK = 0.4
"""Metres between the wheels of the differential drive behind the unicycle's inputs."""
WHEELS = ((0.5, 0.5), (-1.0 / TRACK, 1.0 / TRACK))
DEGREE = float(np.pi / 180)
EIGHT = trajectories(8)

_ERRORS: dict[str, Any] = {"gain": 0.1, "slip": 0.2, "wheels": WHEELS}
_PROCESS = (0.05, 0.05, 3 * DEGREE)
_SENSORS = (0.03, 0.03, 3 * DEGREE)
DISTURBANCES: dict[str, Disturbance] = {
    "none": Disturbance(),
    "inputs wrong by up to 10 %": Disturbance(gain=0.1),
    "wheels slip by up to 20 %": Disturbance(slip=0.2, wheels=WHEELS),
    "process noise": Disturbance(process=_PROCESS),
    "measurement noise": Disturbance(measurement=_SENSORS),
    "five times that": Disturbance(measurement=tuple(5 * s for s in _SENSORS)),
    "1 period of delay": Disturbance(delay=1),
    "2 periods of delay": Disturbance(delay=2),
    "3 periods of delay": Disturbance(delay=3),
    "10 periods of delay": Disturbance(delay=10),
    "inputs of at most 0.5": Disturbance(limit=0.5),
    "all of these, 2 periods": Disturbance(
        **_ERRORS, process=_PROCESS, measurement=_SENSORS, delay=2, limit=0.5
    ),
}
"""Process noise is 5 cm and 3 degrees a root second, measurement noise 3 cm and 3 degrees."""

Solver = Callable[[Problem], Policy]


@dataclass
class Trials:
    """Closed loops of one method under one disturbance.

    Attributes:
        costs: of each, NaN where the goal was not reached.
        optima: the undisturbed optimum from the same start.
        new_collisions: whether it entered an obstacle that the optimum avoids.
    """

    costs: list[float] = field(default_factory=list)
    optima: list[float] = field(default_factory=list)
    new_collisions: list[bool] = field(default_factory=list)

    def add(self, policy: Policy, problem: Problem, disturbance: Disturbance, seed: int) -> None:
        """Close the loop from every start of a problem."""
        loops = rollouts(policy, problem.starts, LOOP, disturbance, seed)
        for loop, optimum in zip(loops, problem.optima, strict=True):
            clear = float(problem.query.clearance(optimum.states).min()) >= 0
            self.costs.append(np.nan if loop.cost is None else loop.cost)
            self.optima.append(optimum.cost)
            self.new_collisions.append(loop.collided and clear)

    def figures(self) -> dict[str, float | None]:
        """Shares and excesses; an excess is of the loops that reached, absent without any."""
        costs, optima = np.array(self.costs), np.array(self.optima)
        reached = np.isfinite(costs)
        excess = costs[reached] / optima[reached] - 1
        some = bool(reached.any())
        return {
            "trials": len(costs),
            "reached": float(reached.mean()),
            "median_excess": float(np.median(excess)) if some else None,
            "excess_95": float(np.quantile(excess, 0.95)) if some else None,
            "aggregate_excess": float(costs[reached].sum() / optima[reached].sum() - 1)
            if some
            else None,
            "new_collisions": float(np.mean(self.new_collisions)),
        }


@dataclass(frozen=True)
class Contender:
    """A method.

    Attributes:
        label: in the table.
        solver: a problem's policy.
        slow: whether it is driven on `SLOW_QUERIES` with `SLOW_STARTS` of each only.
    """

    label: str
    solver: Solver
    slow: bool = False


def _planned(planner: Callable[[], Planner]) -> Solver:
    return lambda problem: plan(planner(), problem.query, problem.starts, EIGHT).policy


def _registered(name: str) -> Solver:
    return _planned(METHODS[name].planner)


def _network(problem: Problem) -> Policy:
    """The network's own policy: no grid, no exact trajectory."""
    from learning.meta_planner import MetaPlanner

    planner = MetaPlanner.pretrained("paper", grids=False)
    return planner.policy(planner.start(problem.query, []))


def _tubes(problem: Problem) -> Policy:
    """Neighbouring extremals of the exact optima, an eikonal grid's policy off them."""
    from learning.conditioned.tube import TubePolicy, Tubes
    from ocp.eikonal import solve_eikonal
    from ocp.extremals.extremal import find_extremal

    query = problem.query
    found = [
        find_extremal(query, start, optimum)
        for start, optimum in zip(problem.starts, problem.optima, strict=True)
    ]
    solved = [extremal for extremal in found if extremal.trajectory is not None]
    return TubePolicy(Tubes.around(query, solved), solve_eikonal(query).policy())


CONTENDERS = (
    Contender("network alone", _network),
    Contender("adapt", _registered("adapt")),
    Contender("exact tubes", _tubes),
    Contender("eikonal", _registered("eikonal")),
    Contender("set-valued", _registered("set-valued")),
    Contender("mpc-value", _registered("mpc-value"), slow=True),
    Contender("mpc", _registered("mpc"), slow=True),
    Contender("trpo", _registered("trpo")),
)


def run(
    seed: int,
    _out: Path | None,
    queries: int = QUERIES,
    starts: int = STARTS,
    contenders: tuple[Contender, ...] = CONTENDERS,
) -> Report:
    """Every contender under every disturbance."""
    trials = {c.label: {name: Trials() for name in DISTURBANCES} for c in contenders}
    for k in range(queries):
        posed = problem(PAPER_FAMILY, seed, k, starts)
        notes.print(f"query {k + 1} of {queries}", highlight=False)
        for contender in contenders:
            if contender.slow and k >= SLOW_QUERIES:
                continue
            count = SLOW_STARTS if contender.slow else starts
            part = Problem(posed.query, posed.starts[:count], posed.optima[:count])
            policy = contender.solver(part)
            for i, (name, disturbance) in enumerate(DISTURBANCES.items()):
                noise = int(np.random.default_rng([seed, k, i]).integers(2**31))
                trials[contender.label][name].add(policy, part, disturbance, noise)
    figures = {
        label: {name: found.figures() for name, found in rows.items()}
        for label, rows in trials.items()
    }
    tables = [
        _table("Reached", figures, lambda f: f"{f['reached']:.0%}"),
        _table("Excess over the undisturbed optimum: median (95 %)", figures, _excess),
    ]
    return Report({"period_s": LOOP.period, "contenders": figures}, tables)


def _excess(figures: dict[str, float | None]) -> str:
    median, most = figures["median_excess"], figures["excess_95"]
    if median is None or most is None:
        return "-"
    return f"{100 * median:.1f} ({100 * most:.0f}) %"


def _table(title: str, figures: dict[str, Any], text: Callable[[Any], str]) -> Table:
    table = Table(title=title)
    table.add_column("disturbance")
    for label in figures:
        table.add_column(label, justify="right")
    for name in DISTURBANCES:
        table.add_row(name, *(text(rows[name]) for rows in figures.values()))
    return table
