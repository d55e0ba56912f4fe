"""How well Algorithm 2 plans fresh queries after n trajectories: Figure 3 against exact optima.

    python -m sims.experiments.faithful_study evaluate WEIGHTS [WEIGHTS ...]    stored weights
    python -m sims.experiments.faithful_study ablate CONFIG --out DIR           one change at a time

Fresh queries and starts come from a seed sequence of their own, which no training draws from.
"""

import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from learning.faithful.adaptation import Adaptation, adapt_once, next_trajectory
from learning.faithful.config import Config, Optimizer, Source
from learning.faithful.losses import Derivative, Reduction, Structure
from learning.faithful.meta import MetaWeights, train
from learning.faithful.network_value import StateNetworkValue
from learning.faithful.value_network import Activation
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY, sample_start
from ocp.set_valued import COARSE
from ocp.trajectory import SolveError, Trajectory
from ocp.value import GradientPolicy, greedy
from sims.closed_loop import LoopSettings, rollouts

log = logging.getLogger(__name__)

FRESH_STREAM = 99
COUNTS = (0, 1, 2, 4, 8, 16, 32, 64)
"""Trajectories after which the policy is judged."""
LOOP = LoopSettings(period=0.1, time_limit=40.0)


@dataclass(frozen=True)
class Trial:
    """A fresh query with exact optima, and the trajectories that Algorithm 2 will add.

    Attributes:
        query: the query.
        starts: `[k, n]`, uniform outside the goal.
        optima: `[k]`, exact costs from them.
        motions: in the order in which they are added.
    """

    query: Query
    starts: NDArray[np.float64]
    optima: NDArray[np.float64]
    motions: tuple[Trajectory, ...]


@dataclass(frozen=True)
class Figures:
    """What a policy achieves over all trials.

    Attributes:
        reached: fraction of starts from which the goal is reached.
        excess: total cost over the total optimum of the starts that reach the goal, minus 1.
        median_excess, excess_95: over single starts that reach the goal.
    """

    reached: float
    excess: float | None
    median_excess: float | None
    excess_95: float | None


@dataclass(frozen=True)
class Row:
    """After n trajectories.

    Attributes:
        trajectories: n.
        value_error: mean |V - V*| over the mean V* at the starts.
        paper: of the feedback h(grad V).
        direction: of the feedback that uses grad V's direction alone.
        diverged: queries whose adaptation had diverged; they count as not reached.
    """

    trajectories: int
    value_error: float | None
    paper: Figures
    direction: Figures
    diverged: int


def fresh_trials(seed: int, queries: int, starts: int, trajectories: int) -> list[Trial]:
    """Queries of the paper's family that no training has seen; starts without truth are redrawn."""
    rng = np.random.default_rng([seed, FRESH_STREAM])
    trials = []
    for i in range(queries):
        query = PAPER_FAMILY.sample(rng)
        states, optima = [], []
        while len(states) < starts:
            state = sample_start(query, rng)
            try:
                optima.append(exact_trajectory(query, state).cost)
            except SolveError as error:
                log.info("query %d: a start is redrawn: %s", i, error)
                continue
            states.append(state)
        trials.append(
            Trial(query, np.array(states), np.array(optima), _motions(query, i, trajectories))
        )
        log.info("exact optima: query %d of %d", i + 1, queries)
    return trials


def _motions(query: Query, seed: int, count: int) -> tuple[Trajectory, ...]:
    """The trajectories that `adapt_once` would compute one after another."""
    found: list[Trajectory] = []
    for n in range(count):
        here = Adaptation(query, (), (None,) * n)  # pyright: ignore[reportArgumentType]
        found.append(next_trajectory(here, seed)[0])
    return tuple(found)


def evaluate(
    weights: MetaWeights, trials: Sequence[Trial], counts: Sequence[int] = COUNTS
) -> list[Row]:
    """Figure 3: success, excess and value error after n trajectories."""
    results: dict[int, list[tuple[Any, Any, Any]]] = {n: [] for n in counts}
    for i, trial in enumerate(trials):
        query = trial.query
        adaptation: Adaptation | None = Adaptation(query, weights.parameters)
        for n in range(max(counts) + 1):
            if n and adaptation is not None:
                try:
                    adaptation = adapt_once(adaptation, weights.config, i, trial.motions[n - 1])
                except FloatingPointError as error:
                    log.info("query %d: %s", i, error)
                    adaptation = None
            if n not in results:
                continue
            if adaptation is None:
                lost = np.full(len(trial.starts), np.nan)
                results[n].append((lost, lost, lost))
                continue
            value = StateNetworkValue(query, weights.config.network, adaptation.parameters)
            paper = _costs(GradientPolicy(query, value), trial.starts)
            direction = _costs(greedy(query, value), trial.starts)
            results[n].append((value.value(trial.starts), paper, direction))
        log.info("evaluated query %d of %d", i + 1, len(trials))
    optima = np.concatenate([t.optima for t in trials])
    rows = []
    for n, found in results.items():
        values, paper, direction = (np.concatenate(part) for part in zip(*found, strict=True))
        known = np.isfinite(values)
        error = (
            np.abs(values - optima)[known].mean() / optima[known].mean() if known.any() else None
        )
        rows.append(
            Row(
                n,
                None if error is None else float(error),
                _figures(paper, optima),
                _figures(direction, optima),
                sum(bool(np.isnan(v).all()) for v, *_ in found),
            )
        )
    return rows


def _costs(policy: Any, starts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Closed-loop costs `[k]`; NaN where the goal is not reached or the loop blows up."""
    try:
        with np.errstate(all="ignore"):  # a diverged network overflows; `rollouts` then raises
            loops = rollouts(policy, list(starts), LOOP)
    except FloatingPointError:  # a far excursion overflows: judge the starts one by one
        if len(starts) == 1:
            return np.array([np.nan])
        return np.concatenate([_costs(policy, start[None]) for start in starts])
    return np.array([np.nan if loop.cost is None else loop.cost for loop in loops])


def _figures(costs: NDArray[np.float64], optima: NDArray[np.float64]) -> Figures:
    reached = np.isfinite(costs)
    if not reached.any():
        return Figures(0.0, None, None, None)
    single = costs[reached] / optima[reached] - 1
    return Figures(
        float(reached.mean()),
        float(costs[reached].sum() / optima[reached].sum() - 1),
        float(np.median(single)),
        float(np.quantile(single, 0.95)),
    )


def table_of(rows: Sequence[Row], title: str) -> Table:
    """For reading."""
    table = Table(title=title)
    for column in (
        "n",
        "value error",
        "reached, h(grad V)",
        "excess",
        "reached, direction",
        "excess",
        "median",
        "diverged",
    ):
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(
            str(row.trajectories),
            _percent(row.value_error),
            _percent(row.paper.reached),
            _percent(row.paper.excess),
            _percent(row.direction.reached),
            _percent(row.direction.excess),
            _percent(row.direction.median_excess),
            str(row.diverged),
        )
    return table


def _percent(number: float | None) -> str:
    if number is None:
        return "-"
    return f"{100 * number:.1f} %" if number < 1e4 else "> 1e6 %"


# Ablations

CHANGES: dict[str, dict[str, dict[str, Any]]] = {
    "none": {},
    "sums": {"loss": {"reduction": Reduction.SUM}},
    "means": {"loss": {"reduction": Reduction.MEAN}},
    "finite differences": {"loss": {"derivative": Derivative.FINITE}},
    "mu = 0.1": {"loss": {"multiplier": 0.1}},
    "mu = 1": {"loss": {"multiplier": 1.0}},
    "relu": {"network": {"activation": Activation.RELU}},
    "silu": {"network": {"activation": Activation.SILU}},
    "absolute positions": {"network": {"relative": False}},
    "relative positions": {"network": {"relative": True}},
    "plain structure": {"network": {"structure": Structure.PLAIN}},
    "bound structure": {"network": {"structure": Structure.BOUND}},
    "alpha = 0.001": {"meta": {"inner_rate": 1e-3}},
    "three inner steps": {"meta": {"inner_steps": 3}},
    "first order": {"meta": {"second_order": False}},
    "no inner step": {"meta": {"inner_steps": 0}},
    "Adam in the adaptation": {"adaptation": {"optimizer": Optimizer.ADAM, "rate": 1e-3}},
    "adaptation rate 0.003": {"adaptation": {"rate": 3e-3}},
    "adaptation rate 0.005": {"adaptation": {"rate": 5e-3}},
    "one adaptation step": {"adaptation": {"steps": 1}},
    # The step that meta-training takes on its sum of 256 samples, whatever the number of samples.
    "one step as meta-trained": {
        "loss": {"reduction": Reduction.MEAN},
        "adaptation": {"steps": 1, "rate": 0.256},
    },
    "fewer outer samples": {"meta": {"outer_shots": 64}},
    "more outer samples": {"meta": {"outer_shots": 1024}},
    "beta = 0.0003": {"meta": {"outer_rate": 3e-4}},
    "beta = 0.001": {"meta": {"outer_rate": 1e-3}},
    "beta = 0.01": {"meta": {"outer_rate": 1e-2}},
    "beta constant": {"meta": {"final_rate": 1.0}},
    "interval 0.05 s": {"adaptation": {"interval": 0.05}},
    "interval 0.2 s": {"adaptation": {"interval": 0.2}},
    "goal share 0.03": {"adaptation": {"goal_ratio": 0.03}},
    "goal share 0.3": {"adaptation": {"goal_ratio": 0.3}},
    "set-valued data": {"data": {"source": Source.SET_VALUED, "grid": COARSE}},
    "eikonal data": {"data": {"source": Source.EIKONAL}},
    "trajectories as data": {"data": {"source": Source.TRAJECTORIES}},
}
"""Single changes by name: section of the configuration, fields, new values."""


def changed(config: Config, name: str) -> Config:
    """`config` after a change of `CHANGES`, or after several: "one + another"."""
    for single in name.split(" + "):
        config = _with_fields(config, CHANGES[single])
    return config


def _with_fields(config: Config, change: dict[str, dict[str, Any]]) -> Config:
    for section, values in change.items():
        config = replace(config, **{section: replace(getattr(config, section), **values)})
    return config


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError for a change that is not in `CHANGES`."""
    for name in " + ".join(names).split(" + "):
        if name not in CHANGES:
            raise ValueError(f"changes: {name!r} is unknown; known are {', '.join(CHANGES)}")


@dataclass(frozen=True)
class Evaluate:
    """Evaluate stored weights on fresh queries."""

    weights: tyro.conf.Positional[tuple[Path, ...]]
    """Weights files or checkpoints."""
    counts: tuple[int, ...] = COUNTS
    """Trajectories after which to judge."""
    changes: tuple[str, ...] = ("none",)
    """Names in `CHANGES`, of how the weights are adapted: nothing is trained."""
    queries: int = 20
    starts: int = 10
    seed: int = 0
    json: bool = False

    def run(self) -> None:
        check_names(self.changes)
        trials = fresh_trials(self.seed, self.queries, self.starts, max(self.counts))
        for path in self.weights:
            weights = MetaWeights.load(path)
            for name in self.changes:
                title = f"{path}: {weights.iterations} meta-iterations; changes: {name}"
                other = replace(weights, config=changed(weights.config, name))
                show(evaluate(other, trials, self.counts), title, self.json)


@dataclass(frozen=True)
class Ablate:
    """Train a configuration with one change at a time, and evaluate each."""

    config: tyro.conf.Positional[Path]
    """The configuration that is changed."""
    out: Path
    """Folder for weights; a run that was stopped goes on."""
    changes: tuple[str, ...] = tuple(CHANGES)
    """Names in `CHANGES`, or several of them joined by " + "; one training each."""
    hidden: tuple[int, ...] = ()
    """Widths instead of the configuration's."""
    iterations: int = 0
    """Meta-iterations instead of the configuration's."""
    counts: tuple[int, ...] = (0, 4, 16)
    """Trajectories after which to judge."""
    queries: int = 8
    starts: int = 10
    seed: int = 0
    json: bool = False

    def run(self) -> None:
        check_names(self.changes)
        base = Config.load(self.config)
        if self.iterations:
            base = _with_fields(base, {"meta": {"iterations": self.iterations}})
        if self.hidden:
            base = _with_fields(base, {"network": {"hidden": self.hidden}})
        trials = fresh_trials(self.seed, self.queries, self.starts, max(self.counts))
        for name in self.changes:
            config = changed(base, name)
            try:
                path = train(config, self.out / name.replace(" ", "-"))
            except FloatingPointError as error:
                print(f"{name}: {error}")
                continue
            show(evaluate(MetaWeights.load(path), trials, self.counts), name, self.json)


def show(rows: Sequence[Row], title: str, as_json: bool) -> None:
    """Print rows as a table, or as one line of JSON."""
    if as_json:
        print(json.dumps({"title": title, "rows": [asdict(r) for r in rows]}), flush=True)
    else:
        Console(width=118).print(table_of(rows, title))


def main() -> None:
    """Parse the command line and run."""
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(message)s")
    tyro.extras.subcommand_cli_from_dict({"evaluate": Evaluate, "ablate": Ablate}).run()


if __name__ == "__main__":
    main()
