"""`zermelo bench causality-free`: values learned from exact trajectories alone, on fresh queries.

Each family's shipped network meets queries that no training saw: as trained, and adapted to 16
exact trajectories of the query; the linear regulator and model predictive control beside it, closed
loops from the same starts. The exact cost is the least of the extremals found from the regulator's,
the network's and the adapted network's closed loops, and from guesses that pass each obstacle on
either side (collocation's where there is none); what the obstacles add to it is reported. On a
share of the queries collocation, which knows none of them, is asked too, and by how much it finds
cheaper motions is reported.
Processor seconds of one core; input held for 0.02 s (the receding horizon's for 0.1 s).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from learning.causality_free.exact import exact_trajectories
from learning.causality_free.families import FAMILIES, RegulationFamily
from learning.causality_free.planner import TRAJECTORIES, CausalityFreePlanner
from ocp.grid import Grid
from ocp.grids.regulation_grid import solve_regulation_grid
from ocp.mpc import QuadraticEnd, receding_horizon
from ocp.query import Query
from ocp.regulation import RegulatorValue, regulator, solve_regulation
from ocp.system import Coordinate
from ocp.trajectory import SolveError
from ocp.value import Policy, greedy
from sims.benchmarks import Report
from sims.benchmarks.learning import correct_optima
from sims.closed_loop import LoopSettings, rollouts

Floats = NDArray[np.float64]

SEED = 1_000_000  # added to the benchmark's seed: no training saw these queries
QUERIES, STARTS = 50, 4
CHECKED = 6  # queries of which collocation and the receding horizon are asked, 2 starts each
LOOP = LoopSettings(time_limit=20.0)
HORIZON_LOOP = LoopSettings(period=0.1, time_limit=20.0, substeps=20)
AXIS_NODES = (21, 41, 61)
GRID_NODES = (31, 41)  # of the pendulum, on which a grid's time a node is measured
MAP_ACROSS = {"quadrotor": (0, 2), "car": (1, 2), "traffic": (0, 1)}
"""Coordinates of the map: position and tilt; sideways position and heading; both positions."""
MAP_NODES = 25
notes = Console(stderr=True)


@dataclass
class Score:
    """Closed loops of one method: their costs, and the exact ones."""

    costs: list[float] = field(default_factory=list)
    optima: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, policy: Policy, starts: Floats, optima: Floats, loop: LoopSettings) -> None:
        """Close the loop from every start."""
        for closed, optimum in zip(rollouts(policy, list(starts), loop), optima, strict=True):
            self.costs.append(np.nan if closed.cost is None else closed.cost)
            self.optima.append(float(optimum))

    def figures(self) -> dict[str, float | None]:
        """Everything measured, as fractions and seconds."""
        cost, optimum = np.array(self.costs), np.array(self.optima)
        reached = np.isfinite(cost)
        excess = (cost / optimum)[reached] - 1
        seconds = self.seconds
        return {
            "loops": float(len(cost)),
            "reached": float(reached.mean()),
            "aggregate_excess": float(cost[reached].sum() / optimum[reached].sum() - 1),
            "mean_excess": float(excess.mean()),
            "median_excess": float(np.median(excess)),
            "excess_95": float(np.quantile(excess, 0.95)),
            "largest_excess": float(excess.max()),
            "least_excess": float(excess.min()),
            "ready_median_s": float(np.median(seconds)) if seconds else None,
            "ready_95_s": float(np.quantile(seconds, 0.95)) if seconds else None,
        }


def run(
    seed: int,
    out: Path | None,
    queries: int = QUERIES,
    starts: int = STARTS,
    checked: int = CHECKED,
) -> Report:
    """Every family, then what grids would need."""
    report = Report()
    for name, family in FAMILIES.items():
        figures = _family(family, seed, queries, starts, checked)
        report.figures[name] = figures
        report.tables.append(_table(name, figures))
        if out is not None:
            _figure(name, figures["excesses"], out)
            _map(family, seed, out)
    report.figures["grids"] = grid_needs()
    report.tables.append(_grid_table(report.figures["grids"]))
    return report


def _family(
    family: RegulationFamily, seed: int, queries: int, count: int, checked: int
) -> dict[str, Any]:
    planner = CausalityFreePlanner.pretrained(family.name)
    scores = {n: Score() for n in ("network", "adapted", "regulator")}
    horizon, horizon_rivals = Score(), {n: Score() for n in scores}
    names = ("adopted", "solved", "cheaper", "missing", "obstacles")
    parts: dict[str, list[float]] = {name: [] for name in names}
    _warm(planner, family, seed)
    for k in range(queries):
        rng = np.random.default_rng([SEED + seed, k])
        query = family.sample(rng)
        drawn = family.starts(query, count, rng)
        begun = time.thread_time()
        state = planner.start(query, [])
        scores["network"].seconds.append(time.thread_time() - begun)
        while not state.finished:
            state = planner.refine(state)
        scores["adapted"].seconds.append(time.thread_time() - begun)
        parts["solved"].append(len(state.optima) / TRAJECTORIES)
        parts["adopted"].append(float(state.value is not state.trained))
        linear = RegulatorValue(query)
        optima = _optima(query, (linear, state.trained, state.value), drawn)
        parts["missing"].append(float(np.isnan(optima).mean()))
        drawn, optima = drawn[np.isfinite(optima)], optima[np.isfinite(optima)]
        if query.obstacles:
            bare = replace(query, obstacles=())
            parts["obstacles"].extend(optima / _optima(bare, (RegulatorValue(bare),), drawn) - 1)
        values = {"network": state.trained, "adapted": state.value, "regulator": linear}
        some = slice(0, 2 if k < checked else 0)
        for start, optimum in zip(drawn[some], optima[some], strict=True):
            try:
                parts["cheaper"].append(1 - solve_regulation(query, start).cost / float(optimum))
            except SolveError as error:
                notes.print(f"{family.name} {k}: collocation from {start}: {error}")
        for name, value in values.items():
            scores[name].add(greedy(query, value), drawn, optima, LOOP)
        if k < checked:
            end = QuadraticEnd(regulator(query).matrix, query.reference)
            horizon.add(receding_horizon(query, end), drawn[some], optima[some], HORIZON_LOOP)
            for name in scores:
                for kept, every in (("costs", scores[name].costs), ("optima", scores[name].optima)):
                    getattr(horizon_rivals[name], kept).extend(every[-len(drawn) :][some])
        notes.print(f"{family.name}: query {k + 1} of {queries}", highlight=False)
    missed = correct_optima([*scores.values()], least=0.0)
    figures: dict[str, Any] = {name: score.figures() for name, score in scores.items()}
    figures["queries"] = queries
    figures["optima_missed"] = missed
    figures["trajectories_solved"] = float(np.mean(parts["solved"]))
    figures["adaptation_adopted"] = float(np.mean(parts["adopted"]))
    figures["without_exact_cost"] = float(np.mean(parts["missing"]))
    if parts["obstacles"]:
        figures["obstacles_add_mean"] = float(np.nanmean(parts["obstacles"]))
        figures["obstacles_add_median"] = float(np.nanmedian(parts["obstacles"]))
    if checked:
        figures["receding horizon"] = horizon.figures()
        for name, score in horizon_rivals.items():
            figures[f"{name}, on its starts"] = score.figures()
        figures["collocation_cheaper_by"] = float(np.max(parts["cheaper"], initial=-1.0))
    figures["excesses"] = {
        name: (np.array(s.costs) / np.array(s.optima) - 1).tolist() for name, s in scores.items()
    }
    return figures


def _warm(planner: CausalityFreePlanner, family: RegulationFamily, seed: int) -> None:
    """A query of the family that is not measured: loads weights and compiled code."""
    query = family.sample(np.random.default_rng([SEED + seed, 1 << 20]))
    state = planner.start(query, [])
    planner.policy(planner.refine(state))(query.reference)


def _optima(query: Query, values: tuple[Any, ...], starts: Floats) -> Floats:
    """The least exact cost `[k]` that any value's closed loop leads to; NaN if none was found."""
    best = np.full(len(starts), np.inf)
    for value in values:
        first = value is values[0]
        found = exact_trajectories(query, [value], starts, continuation=first, ways=first)
        costs = [np.inf if optimum is None else optimum.cost for optimum in found]
        best = np.minimum(best, costs)
    for i in np.flatnonzero(np.isinf(best)):
        try:
            best[i] = solve_regulation(query, starts[i]).cost
        except SolveError as error:
            notes.print(f"no exact cost from {starts[i]}: {error}")
            best[i] = np.nan
    return best


def grid_needs() -> dict[str, Any]:
    """What value iteration would need in five and six dimensions: extrapolated, never run.

    The time a node is measured on the pendulum at two sizes; a node interpolates among 2^n
    corners, so in n dimensions it takes 2^(n - 2) times as long, and the number of sweeps is
    taken not to grow, which favours the grid.
    """
    query = Query.load(Path(__file__).parent.parent / "queries" / "pendulum.toml")
    measured = []
    solve_regulation_grid(query, Grid.of(query.system, (9, 9)))  # loads compiled code
    for axis in GRID_NODES:
        grid = Grid.of(query.system, (axis, axis))
        begun = time.thread_time()
        solve_regulation_grid(query, grid)
        measured.append((time.thread_time() - begun) / grid.size)
    a_node = min(measured)
    rows = []
    for name, n in (("car", 5), ("quadrotor", 6)):
        for axis in AXIS_NODES:
            nodes = float(axis) ** n
            hours = nodes * a_node * 2.0 ** (n - 2) / 3600
            rows.append(
                {"family": name, "states": n, "axis_nodes": axis, "nodes": nodes,
                 "gigabytes": 8e-9 * nodes * (1 + query.system.m), "core_hours_a_query": hours}
            )  # fmt: skip
    return {"pendulum_node_us": 1e6 * a_node, "rows": rows}


def _percent(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{100 * value:.{digits}f} %"


def _table(name: str, figures: dict[str, Any]) -> Table:
    title = f"{name}: {figures['queries']} fresh queries, excess over the exact cost"
    table = Table(title=title)
    columns = ("method", "loops", "reached", "aggregate", "mean", "median", "95 %", "largest")
    for column in (*columns, "least", "ready s", "95 % s"):
        table.add_column(column, justify="left" if column == "method" else "right")
    shown: list[tuple[str, Callable[[float | None], str]]] = [
        ("loops", lambda x: f"{x:.0f}"),
        ("reached", lambda x: _percent(x, 1)),
        ("aggregate_excess", lambda x: _percent(x, 2)),
        ("mean_excess", lambda x: _percent(x, 2)),
        ("median_excess", lambda x: _percent(x, 3)),
        ("excess_95", lambda x: _percent(x, 2)),
        ("largest_excess", lambda x: _percent(x, 1)),
        ("least_excess", lambda x: _percent(x, 3)),
        ("ready_median_s", lambda x: "-" if x is None else f"{x:.3f}"),
        ("ready_95_s", lambda x: "-" if x is None else f"{x:.3f}"),
    ]
    for method, row in figures.items():
        if isinstance(row, dict) and "reached" in row:
            label = f"adapted, {TRAJECTORIES} trajectories" if method == "adapted" else method
            table.add_row(label, *(write(row[key]) for key, write in shown))
    return table


def _grid_table(needs: dict[str, Any]) -> Table:
    title = f"what a grid would need, extrapolated ({needs['pendulum_node_us']:.0f} us a 2-D node)"
    table = Table(title=title)
    for column in ("family", "states", "nodes an axis", "nodes", "GB", "core hours a query"):
        table.add_column(column, justify="left" if column == "family" else "right")
    for row in needs["rows"]:
        table.add_row(
            row["family"], str(row["states"]), str(row["axis_nodes"]), f"{row['nodes']:.1e}",
            f"{row['gigabytes']:.3g}", f"{row['core_hours_a_query']:.3g}",
        )  # fmt: skip
    return table


def _map(family: RegulationFamily, seed: int, out: Path) -> None:
    """The value's relative error on the plane of two coordinates through a fresh query's goal."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle

    from sims.pictures.plan_figure import save

    query = family.sample(np.random.default_rng([SEED + seed, 0]))
    value = CausalityFreePlanner.pretrained(family.name).start(query, []).value
    linear, system = RegulatorValue(query), query.system
    reach, across = np.array(family.reach), MAP_ACROSS[family.name]
    axes_ = [np.linspace(-reach[i], reach[i], MAP_NODES) for i in across]
    offsets = np.zeros((MAP_NODES**2, system.n))
    for i, column in zip(across, np.meshgrid(*axes_, indexing="ij"), strict=True):
        offsets[:, i] = column.ravel()
    away = np.abs(offsets).max(axis=1) > 1e-6  # in the goal itself there is nothing to divide by
    states = query.reference + offsets[away]
    exact = _optima(query, (linear, value), states)
    place = list(system.position)
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 4.0), layout="constrained", sharey=True)
    shown: Any = None
    for panel, rival, title in zip(
        panels, (linear, value), ("linear regulator", "network"), strict=True
    ):
        error = np.zeros(MAP_NODES**2)
        error[away] = 100 * (rival.value(states) / exact - 1)
        grid = error.reshape(MAP_NODES, MAP_NODES).T
        shown = panel.pcolormesh(*axes_, grid, cmap="RdBu_r", vmin=-20, vmax=20, shading="nearest")
        if across == tuple(place):
            panel.set_aspect("equal")
        for o in query.obstacles if across == tuple(place) else ():
            at = np.array(o.center) - query.goal_position
            panel.add_patch(Circle((at[0], at[1]), o.radius, fill=False))
        panel.set_title(f"{title}: largest {np.nanmax(np.abs(error)):.1f} %")
        panel.set_xlabel(_axis_label(system.coordinates[across[0]]))
    panels[0].set_ylabel(_axis_label(system.coordinates[across[1]]))
    figure.colorbar(shown, ax=panels, label="error of V (%)")
    save(figure, out / f"causality-free-map-{family.name}.png")


def _axis_label(coordinate: Coordinate) -> str:
    return f"{coordinate.name} from the goal ({coordinate.unit})"


def _figure(name: str, excesses: dict[str, list[float]], out: Path) -> None:
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for method, excess in excesses.items():
        row = np.sort(np.maximum(np.array(excess)[np.isfinite(excess)], 1e-5))
        axes.semilogx(100 * row, np.arange(1, len(row) + 1) / len(excess), label=method)
    axes.set_xlabel("excess over the exact cost (%)")
    axes.set_ylabel("share of closed loops")
    axes.set_title(f"{name}: fresh queries")
    axes.grid(which="both", alpha=0.3)
    axes.legend(frameon=False)
    save(figure, out / f"causality-free-{name}.png")
