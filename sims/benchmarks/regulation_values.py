"""`zermelo bench regulation-values`: four ways to V on slices of pendulum and cart-pole.

Value iteration on two grids, Pontryagin's conditions by multiple shooting, collocation, and a small
network trained without a grid on the spot (the family's weights of cost vary; the shipped query is
met fresh). Shooting starts from closed loops (the regulator's, the network's, the finer grid's) and
from collocation's motion; equations, meshes and quadratures are not shared. The error of every
method is against the cheaper of the two. A slice goes through the goal in an angle
and its rate; it is wider than the box that the network knows, and reaches where the pendulum's
motor is too weak: there V has kinks, between swinging and not. Network and regulator are also held
against the exact V at random states of that box, off the slice.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from learning.causality_free.exact import exact_from, exact_trajectories
from learning.causality_free.families import get_family
from learning.causality_free.network import Weights
from learning.causality_free.training import TrainingSettings, start, train
from learning.causality_free.value import NetworkValue
from ocp.grid import Grid
from ocp.grids.regulation_grid import solve_regulation_grid
from ocp.query import Query
from ocp.regulation import RegulatorValue, solve_regulation
from ocp.trajectory import SolveError, Trajectory
from ocp.value import Value
from sims.benchmarks import Report

Floats = NDArray[np.float64]
notes = Console(stderr=True)


@dataclass(frozen=True)
class Slice:
    """Where the methods are compared.

    Attributes:
        family: of the network; the query file's name too.
        across: the two coordinates.
        extent: of the slice from the goal, in them.
        nodes: an axis, odd: the goal is a node, and left out.
        box: `[n]`, half the grid's extent from the goal; empty takes the robot's domain.
        shapes: of both grids, the finer one last.
    """

    family: str
    across: tuple[int, int]
    extent: tuple[float, float]
    nodes: int
    box: tuple[float, ...]
    shapes: tuple[tuple[int, ...], tuple[int, ...]]


SLICES = (
    Slice("pendulum", (0, 1), (1.2, 4.0), 13, (), ((121, 161), (241, 321))),
    Slice(
        "cart-pole",
        (1, 3),
        (0.6, 1.2),
        9,
        (0.9, 0.8, 2.5, 2.5),
        ((9, 11, 13, 13), (15, 17, 19, 19)),
    ),
)
TRAINING = {
    "queries": 24, "held_out": 4, "motions": (16, 6), "steps": (1500, 3000), "widths": (32, 32),
    "batch": 256, "warm_up": 100, "checkpoint_steps": 1500,
}  # fmt: skip
RANDOM = 60  # states of the network's box
METHODS = ("linear regulator", "grid", "finer grid", "network", "PMP", "collocation")


@dataclass
class Values:
    """V by every method at the slice's states; NaN where a method has none.

    Attributes:
        states: `[k, n]`.
        inside: `[k]`, whether they are in the network's box.
        of: V `[k]` by method.
        seconds: of the processor, by method.
        random_error: relative ones at random states of the box, by method.
    """

    states: Floats
    inside: NDArray[np.bool_]
    of: dict[str, Floats] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    random_error: dict[str, Floats] = field(default_factory=dict)

    @property
    def exact(self) -> Floats:
        """The cheaper of shooting and collocation."""
        return np.fmin(self.of["PMP"], self.of["collocation"])

    def error(self, method: str) -> Floats:
        """Relative, `[k]`."""
        return self.of[method] / self.exact - 1


def run(seed: int, out: Path | None, slices: tuple[Slice, ...] = SLICES) -> Report:
    """Compare on every slice; draws the maps."""
    report = Report()
    for chosen in slices:
        query = Query.load(Path(__file__).parent.parent / "queries" / f"{chosen.family}.toml")
        values = compare(chosen, query, seed)
        report.figures[chosen.family] = figures_of(values)
        report.tables.append(_table(chosen.family, report.figures[chosen.family]))
        if out is not None:
            _map(chosen, query, values, out)
    return report


def network(query: Query, name: str, seed: int, settings: dict[str, Any]) -> NetworkValue:
    """A network trained on the family, for a query that it has not met."""
    family, chosen = get_family(name), TrainingSettings(name, seed=seed, **settings)
    state = start(chosen)
    for state in train(chosen, state):  # noqa: B020
        notes.print(f"{name}: step {state.step} of {chosen.total_steps}", highlight=False)
    weights = Weights.of({n: t.detach() for n, t in state.weights.tensors().items()})
    return NetworkValue(query, weights, np.array(family.reach))


def compare(
    chosen: Slice,
    query: Query,
    seed: int,
    settings: dict[str, Any] | None = None,
    random: int = RANDOM,
) -> Values:
    """V by every method on a slice, and by two at so many `random` states of the network's box."""
    states = slice_states(chosen, query)
    offsets = np.abs(query.system.difference(states, query.reference))
    reach = np.array(get_family(chosen.family).reach)
    values = Values(states, np.all(offsets <= reach + 1e-9, axis=1))

    def timed(method: str, begun: float, found: Floats) -> None:
        values.of[method], values.seconds[method] = found, time.thread_time() - begun

    begun = time.thread_time()
    learned = network(query, chosen.family, seed, settings or TRAINING)
    timed("network", begun, learned.value(states))
    linear = RegulatorValue(query)
    values.of["linear regulator"] = linear.value(states)
    loops: list[Value] = [linear, learned]
    for method, shape in zip(("grid", "finer grid"), chosen.shapes, strict=True):
        notes.print(f"{chosen.family}: grid {shape}", highlight=False)
        begun = time.thread_time()
        solved = solve_regulation_grid(query, _grid(chosen, query, shape))
        found = solved.value(states)
        timed(method, begun, np.where(np.isfinite(found), found, np.nan))
        loops = [linear, learned, solved]
    begun = time.thread_time()
    motions = _collocated(query, states)
    timed("collocation", begun, _costs(motions))
    begun = time.thread_time()
    timed("PMP", begun, _shot(query, states, loops, motions))
    rng = np.random.default_rng([seed, 7])
    drawn = query.reference + rng.uniform(-1, 1, (random, len(reach))) * reach
    motions = _collocated(query, drawn)
    exact = np.fmin(_costs(motions), _shot(query, drawn, [linear, learned], motions))
    for method, value in (("linear regulator", linear), ("network", learned)):
        values.random_error[method] = (value.value(drawn) / exact - 1)[np.isfinite(exact)]
    return values


def _collocated(query: Query, states: Floats) -> list[Trajectory | None]:
    """Collocation's motion from each of `[k, n]`; `None` where it fails."""
    motions: list[Trajectory | None] = []
    for k, state in enumerate(states):
        try:
            motions.append(solve_regulation(query, query.system.wrap(state)))
        except SolveError as error:
            notes.print(f"{query.system.name}: collocation from {state}: {error}", highlight=False)
            motions.append(None)
        if k % 20 == 0:
            notes.print(f"{query.system.name}: state {k} of {len(states)}", highlight=False)
    return motions


def _costs(motions: Sequence[Trajectory | None]) -> Floats:
    return np.array([np.nan if m is None else m.cost for m in motions])


def _shot(
    query: Query, states: Floats, loops: Sequence[Value], motions: Sequence[Trajectory | None]
) -> Floats:
    """The least cost `[k]` by shooting from closed loops and from other methods' motions."""
    costs = np.full(len(states), np.nan)
    for value in loops:
        found = exact_trajectories(query, [value], states, continuation=False)
        costs = np.fmin(costs, [np.nan if o is None else o.cost for o in found])
    for i, motion in enumerate(motions):
        rival = None if motion is None else exact_from(query, motion)
        costs[i] = np.fmin(costs[i], np.nan if rival is None else rival.cost)
    return costs


def slice_states(chosen: Slice, query: Query) -> Floats:
    """`[nodes^2, n]`, through the goal, moved off it by a hair where they would meet it."""
    first, second = (np.linspace(-e, e, chosen.nodes) for e in chosen.extent)
    states = np.tile(query.reference, (chosen.nodes**2, 1))
    for i, column in zip(chosen.across, np.meshgrid(first, second, indexing="ij"), strict=True):
        states[:, i] += column.ravel()
    states[(chosen.nodes**2) // 2, chosen.across[0]] += 1e-2
    return states


def _grid(chosen: Slice, query: Query, shape: tuple[int, ...]) -> Grid:
    if not chosen.box:
        return Grid.of(query.system, shape)
    lower, upper = query.reference - chosen.box, query.reference + chosen.box
    return Grid(tuple(lower), tuple(upper), shape, (False,) * len(shape))


def figures_of(values: Values) -> dict[str, Any]:
    """Errors inside the network's box and on the whole slice, by method."""
    figures: dict[str, Any] = {}
    for method in METHODS:
        if method not in values.of:
            continue
        error = np.abs(values.error(method))
        row: dict[str, Any] = {"seconds": values.seconds.get(method)}
        for name, some in (("box", values.inside), ("slice", np.ones(len(error), dtype=bool))):
            row[name] = _summary(error[some])
        if method in values.random_error:
            row["random"] = _summary(np.abs(values.random_error[method]))
        figures[method] = row
    both = np.isfinite(values.of["PMP"]) & np.isfinite(values.of["collocation"])
    gap = np.abs(values.of["PMP"] / values.of["collocation"] - 1)[both]
    figures["PMP and collocation"] = {
        "both": int(both.sum()),
        "within_1e-4": float((gap < 1e-4).mean()),
        "median": float(np.median(gap)),
    }
    return figures


def _summary(error: Floats) -> dict[str, Any]:
    known = error[np.isfinite(error)]
    return {
        "states": len(error),
        "answered": len(known),
        "median": float(np.median(known)) if len(known) else None,
        "error_95": float(np.quantile(known, 0.95)) if len(known) else None,
        "largest": float(known.max()) if len(known) else None,
    }


def _table(name: str, figures: dict[str, Any]) -> Table:
    inside, whole = figures["PMP"]["box"]["states"], figures["PMP"]["slice"]["states"]
    table = Table(
        title=f"{name}: |error of V|, {inside} states in the network's box, {whole} of the slice"
    )
    for column in ("method", "box: answered", "median", "95 %", "largest", "slice: answered",
                   "median", "95 %", "largest", "s"):  # fmt: skip
        table.add_column(column, justify="left" if column == "method" else "right")
    for method in METHODS:
        if method not in figures:
            continue
        cells = []
        for part in ("box", "slice"):
            row = figures[method][part]
            cells.append(str(row["answered"]))
            cells += [
                "-" if row[key] is None else f"{row[key]:.1e}"
                for key in ("median", "error_95", "largest")
            ]
        seconds = figures[method]["seconds"]
        table.add_row(method, *cells, "-" if seconds is None else f"{seconds:.1f}")
    both = figures["PMP and collocation"]
    table.caption = (
        f"PMP and collocation: within 1e-4 of each other in {100 * both['within_1e-4']:.0f} % "
        f"of {both['both']}, median {both['median']:.0e}"
    )
    for method in METHODS:
        if "random" in figures.get(method, {}):
            row = figures[method]["random"]
            table.caption += (
                f"\n{method}, {row['answered']} random states of the box: median "
                f"{row['median']:.1e}, 95 % {row['error_95']:.1e}, largest {row['largest']:.1e}"
            )
    return table


def _map(chosen: Slice, query: Query, values: Values, out: Path) -> None:
    """log10 of the relative error of every method, and V itself."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Rectangle

    from sims.pictures.plan_figure import save

    shown = [m for m in METHODS if m in values.of]
    axes_ = [np.linspace(-e, e, chosen.nodes) for e in chosen.extent]
    figure, panels = plt.subplots(
        1, 1 + len(shown), figsize=(2.6 * (1 + len(shown)), 3.3), layout="constrained", sharey=True
    )
    square = (chosen.nodes, chosen.nodes)
    first = panels[0].pcolormesh(*axes_, values.exact.reshape(square).T, shading="nearest")
    panels[0].set_title("V")
    figure.colorbar(first, ax=panels[0], location="bottom")
    image: Any = None
    for panel, method in zip(panels[1:], shown, strict=True):
        error = np.log10(np.maximum(np.abs(values.error(method)), 1e-9)).reshape(square).T
        panel.set_facecolor("0.8")
        image = panel.pcolormesh(*axes_, error, vmin=-7, vmax=0, cmap="magma", shading="nearest")
        panel.set_title(method)
    reach = np.array(get_family(chosen.family).reach)[list(chosen.across)]
    for panel in panels:
        panel.add_patch(
            Rectangle(tuple(-reach), *(2 * reach), fill=False, edgecolor="tab:cyan", linewidth=1.2)
        )
        panel.set_xlabel(_label(query, chosen.across[0]))
    panels[0].set_ylabel(_label(query, chosen.across[1]))
    figure.colorbar(image, ax=list(panels[1:]), location="bottom", label="log10 |error of V|")
    save(figure, out / f"regulation-values-{chosen.family}.png")


def _label(query: Query, index: int) -> str:
    coordinate = query.system.coordinates[index]
    return f"{coordinate.name} from the goal ({coordinate.unit})"
