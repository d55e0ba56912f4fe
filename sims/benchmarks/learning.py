"""What learning buys: closed loops on fresh queries against exact costs.

Three families: the paper's, the general one, and the general one with seven to ten obstacles, which
no network was trained on. The queries' seeds are far from those of training. Reached means within
the loop's time limit; excess is over the exact cost; a collision is new if the optimum has none.
With `--out` each query is kept as it is finished, and a run that was stopped goes on.
"""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from learning.meta_planner import MetaPlanner
from ocp.eikonal import solve_eikonal
from ocp.extremals.extremal import find_extremal
from ocp.extremals.warm_start import rollouts as rough
from ocp.family_file import load_family, with_obstacle_count
from ocp.planning import Planner, Until, iterations, plan, trajectories
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import QueryFamily, sample_start
from ocp.query_file import read_toml
from ocp.trajectory import SolveError, Trajectory
from ocp.value import Policy
from ocp.version import code_version
from sims.benchmarks import Report
from sims.closed_loop import LoopSettings, rollouts
from sims.parts import Parts

SEED = 1_000_000  # added to the benchmark's seed: no training or selection saw these queries
QUERIES, STARTS = 100, 20
FIGURES = (
    "reached",
    "aggregate_excess",
    "median_excess",
    "excess_95",
    "largest_excess",
    "least_excess",
    "new_collisions",
    "reaction_median_s",
    "reaction_95_s",
)
TIME_LIMIT = 40.0  # seconds of a closed loop
UNDERCUT = 0.002  # a loop so much cheaper, as a part, shows that the search missed the optimum
notes = Console(stderr=True)

Solver = Callable[[Query, list[NDArray[np.float64]]], tuple[Policy, float]]


@dataclass(frozen=True)
class Problem:
    """A query, starts, and the optimal motion from each."""

    query: Query
    starts: list[NDArray[np.float64]]
    optima: list[Trajectory]


@dataclass
class Score:
    """Closed loops of one method."""

    costs: list[float] = field(default_factory=list)
    optima: list[float] = field(default_factory=list)
    new_collisions: list[bool] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(
        self, problem: Problem, policy: Policy, seconds: float, period: float = LoopSettings.period
    ) -> None:
        """Close the loop from every start, each input held for `period` seconds."""
        self.seconds.append(seconds)
        loops = rollouts(policy, problem.starts, LoopSettings(period, TIME_LIMIT))
        for loop, optimum in zip(loops, problem.optima, strict=True):
            clear = float(problem.query.clearance(optimum.states).min()) >= 0
            self.costs.append(np.nan if loop.cost is None else loop.cost)
            self.optima.append(optimum.cost)
            self.new_collisions.append(loop.collided and clear)

    def add_failure(self, problem: Problem) -> None:
        """There was no policy: no start reaches the goal."""
        self.costs += [np.nan] * len(problem.starts)
        self.optima += [optimum.cost for optimum in problem.optima]

    def record(self) -> dict[str, list[Any]]:
        """Everything as plain data for JSON: a cost is `None` where the goal was not reached."""
        costs = [None if np.isnan(c) else c for c in self.costs]
        return {**vars(self), "costs": costs}

    def extend(self, record: dict[str, list[Any]]) -> None:
        """Add what `record` told of another score."""
        for name, more in record.items():
            getattr(self, name).extend(np.nan if m is None else m for m in more)

    def figures(self) -> dict[str, float | None]:
        """Everything measured, as fractions and seconds; `None` where there was nothing."""
        cost, optimum = np.array(self.costs), np.array(self.optima)
        reached = np.isfinite(cost)
        cost, optimum = cost[reached], optimum[reached]
        excess = cost / optimum - 1
        figures: dict[str, float | None] = dict.fromkeys(FIGURES)
        figures["reached"] = float(reached.mean())
        if reached.any():
            figures |= {
                "aggregate_excess": float(cost.sum() / optimum.sum() - 1),
                "median_excess": float(np.median(excess)),
                "excess_95": float(np.quantile(excess, 0.95)),
                "largest_excess": float(excess.max()),
                "least_excess": float(excess.min()),
                "new_collisions": float(np.mean(self.new_collisions)),
            }
        if self.seconds:
            figures["reaction_median_s"] = float(np.median(self.seconds))
            figures["reaction_95_s"] = float(np.quantile(self.seconds, 0.95))
        return figures


def families() -> dict[str, QueryFamily]:
    """The three families by name."""
    table = read_toml(Path(str(resources.files("ocp.families") / "general.toml")))
    crowded = with_obstacle_count(table, 7, 10)
    return {"paper": load_family("paper"), "general": load_family("general"), "crowded": crowded}


def run(seed: int, out: Path | None, queries: int = QUERIES, starts: int = STARTS) -> Report:
    """A table for each family."""
    report = Report()
    parts = kept("learning", seed, out)
    for name in families():
        compare(report, parts, name, fixed_methods(name), seed, queries, starts)
    return report


def compare(
    report: Report,
    parts: Parts,
    name: str,
    methods: dict[str, Solver],
    seed: int,
    queries: int,
    starts: int,
) -> None:
    """Add a family's figures and table to `report`: every method on the same fresh problems.

    Args:
        report: where to.
        parts: where each query is kept as it is finished.
        name: of the family.
        methods: by name.
        seed: of the problems.
        queries: how many.
        starts: of each.
    """
    family = families()[name]
    scores = {method: Score() for method in methods}
    warm: set[str] = set()
    for k in range(queries):
        records = parts.get(
            f"{name}-{k}",
            {"starts": starts, "methods": sorted(methods)},
            lambda k=k: _judged(problem(family, seed, k, starts), methods, warm),
        )
        notes.print(f"{name}: query {k + 1} of {queries}", highlight=False)
        for method, record in records.items():
            scores[method].extend(record)
    missed = correct_optima([*scores.values()])
    figures = {method: score.figures() for method, score in scores.items()}
    report.figures[name] = {**figures, "optima_missed": missed}
    title = f"{name}: {queries} queries x {starts} starts; {missed} optima by a loop"
    report.tables.append(_table(title, figures))


class Loops(Protocol):
    """Costs of closed loops, NaN where the goal was not reached, and the optima."""

    costs: list[float]
    optima: list[float]


def correct_optima(scores: Sequence[Loops], least: float = 1.0) -> int:
    """Where a method's loop undercuts the least extremal found, hold all against that loop.

    Not where the optimum is below `least`: beside a goal ball a loop's end 1 mm early counts.

    Returns:
        the number of such starts.
    """
    costs = np.array([score.costs for score in scores])
    optima = np.array(scores[0].optima)
    cheapest = np.where(np.isfinite(costs), costs, np.inf).min(axis=0)
    missed = (cheapest < (1 - UNDERCUT) * optima) & (optima > least)
    for score in scores:
        score.optima = np.where(missed, cheapest, optima).tolist()
    return int(missed.sum())


def kept(name: str, seed: int, out: Path | None) -> Parts:
    """Where a benchmark keeps its queries: nowhere without a folder for results."""
    if out is None:
        return Parts(None, {})
    return Parts(
        out / name, {"seed": seed, "code": code_version(), "learning": _learning_version()}
    )


def _learning_version() -> str:
    """Digest of the learning code and of the weights that come with it."""
    room = Path(str(resources.files("learning")))
    digest = hashlib.sha256()
    for path in sorted([*room.rglob("*.py"), *room.rglob("*.safetensors")]):
        digest.update(path.relative_to(room).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def problem(family: QueryFamily, seed: int, k: int, starts: int) -> Problem:
    """The k-th fresh query, starts and optima; starts without an established one are dropped."""
    rng = np.random.default_rng([SEED + seed, k])
    query = family.sample(rng)
    known: list[tuple[NDArray[np.float64], Trajectory]] = []
    drawn = [sample_start(query, rng) for _ in range(starts)]
    fine = solve_eikonal(query).policy()
    for start, guess in zip(drawn, rough(query, fine, np.array(drawn)), strict=True):
        try:
            best = exact_trajectory(query, start)
        except SolveError as error:
            notes.print(f"{family.name} {k}: no optimum from {start}: {error}")
            continue
        # The search may miss a class of motions that a fine grid finds.
        other = None if guess is None else find_extremal(query, start, guess).trajectory
        known.append((start, other if other and other.cost < best.cost else best))
    return Problem(query, [s for s, _ in known], [t for _, t in known])


def fixed_methods(family: str) -> dict[str, Solver]:
    """Those that are not given a deadline."""
    network = "paper" if family == "paper" else "general"
    alone = MetaPlanner.pretrained(network, grids=False)
    whole = MetaPlanner.pretrained(network)
    return {
        "network": partial(planned, alone, iterations(0)),
        "network, 8 trajectories": partial(planned, alone, trajectories(8)),
        "adapt, 8 trajectories": partial(planned, whole, trajectories(8)),
        **{f"eikonal, {n:,} nodes": partial(eikonal, n) for n in (4_500, 18_000, 60_000)},
    }


def planned(
    planner: Planner, until: Until, query: Query, starts: list[NDArray[np.float64]]
) -> tuple[Policy, float]:
    """A plan's policy, and the seconds until it was ready."""
    answer = plan(planner, query, starts, until)
    return answer.policy, answer.reaction_time


def eikonal(nodes: int, query: Query, _starts: list[NDArray[np.float64]]) -> tuple[Policy, float]:
    """The policy of one grid, and the seconds that it took."""
    begun = time.perf_counter()
    policy = solve_eikonal(query, nodes=nodes).policy()
    return policy, time.perf_counter() - begun


def _judged(
    posed: Problem, methods: dict[str, Solver], warm: set[str]
) -> dict[str, dict[str, list[Any]]]:
    """Each method's score on one problem; `warm` are those whose code is loaded already."""
    records = {}
    for method, solver in methods.items():
        if method not in warm:
            solver(posed.query, posed.starts)
            warm.add(method)
        score = Score()
        score.add(posed, *solver(posed.query, posed.starts))
        records[method] = score.record()
    return records


def shown(figure: float | None, form: str, unit: float = 1.0) -> str:
    """A figure in a table; a dash where there is none."""
    return "-" if figure is None else form.format(unit * figure)


def _table(title: str, figures: dict[str, dict[str, float | None]]) -> Table:
    """Methods' figures for reading."""
    table = Table(title=title)
    columns = ("method", "reached", "aggregate", "median", "95 %", "largest", "new collisions")
    for column in (*columns, "median ms", "95 % ms"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, row in figures.items():
        table.add_row(
            name,
            shown(row["reached"], "{:.2%}"),
            shown(row["aggregate_excess"], "{:.3%}"),
            shown(row["median_excess"], "{:.4%}"),
            shown(row["excess_95"], "{:.3%}"),
            shown(row["largest_excess"], "{:.2%}"),
            shown(row["new_collisions"], "{:.2%}"),
            shown(row["reaction_median_s"], "{:.1f}", 1e3),
            shown(row["reaction_95_s"], "{:.1f}", 1e3),
        )
    return table
