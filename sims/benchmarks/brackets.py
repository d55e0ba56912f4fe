"""Certified brackets: how many contain the exact cost, and how wide they are."""

import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.bracket import lower_bound
from ocp.eikonal import solve_eikonal
from ocp.pontryagin import ExactValue
from ocp.query_family import PAPER_FAMILY, sample_start
from ocp.trajectory import SolveError
from sims.benchmarks import Report
from sims.closed_loop import rollouts

QUERIES, STARTS = 100, 100
"""Queries, and starts of each."""
TOLERANCE = 1e-6
"""Relative: the accuracy of an exact cost. Shooting stops at a Newton correction of 1e-7 of the
motion, ten times less; about a minimum the cost's error is smaller still."""
notes = Console(stderr=True)


def beats(upper: float, rest: float, exact: float) -> bool:
    """Whether a motion that costs `upper` up to a state, and `rest` on from there, beats `exact`.

    No motion beats the optimum: one that does shows that the search for the exact motion missed it.
    """
    return upper + rest < exact * (1 - TOLERANCE)


def run(seed: int, _out: Path | None, queries: int = QUERIES, starts_each: int = STARTS) -> Report:
    """Upper bounds by rollout of the eikonal policy, lower bounds by subsolution.

    `queries` with `starts_each` starts each; what was found so far is on standard error all along.
    """
    rng = np.random.default_rng(seed)
    gaps, gaps_known, wrong, crossed, checked, lost, seconds = [], [], 0, 0, 0, 0, []
    missed = unended = 0
    with notes.status("brackets") as status:
        for k in range(queries):
            status.update(f"query {k + 1} of {queries}")
            if k and k % 5 == 0:
                notes.print(
                    f"{len(gaps):,} brackets: {crossed} crossed, {wrong} of {checked} above an "
                    f"exact cost, median gap {100 * np.median(gaps):.2f} %",
                    highlight=False,
                )
            query = PAPER_FAMILY.sample(rng)
            begun = time.process_time()
            bound = lower_bound(query)
            seconds.append(time.process_time() - begun)
            starts = [sample_start(query, rng) for _ in range(starts_each)]
            solution = solve_eikonal(query)
            loops = rollouts(solution.policy(), starts)
            exact = ExactValue(query, solution.policy())
            for start, loop in zip(starts, loops, strict=True):
                if loop.cost is None:
                    lost += 1
                    continue
                bracket = bound.bracket(start, loop.cost)
                gaps.append(bracket.gap)
                # A loop ends 1 mm before the goal: what is left counts beside a start that near.
                left = float(bound.value(loop.trajectory.states[-1]))
                crossed += bracket.lower - left > bracket.upper
                try:
                    truth = exact.trajectory(start).cost
                except SolveError:
                    continue
                checked += 1
                wrong += bracket.lower > truth * (1 + TOLERANCE)
                gaps_known.append(truth / bracket.lower - 1)
                if bracket.upper >= truth * (1 - TOLERANCE):
                    continue
                try:  # dearer with its last millimetre?
                    rest = exact.trajectory(loop.trajectory.states[-1]).cost
                except SolveError:
                    unended += 1
                    continue
                missed += beats(bracket.upper, rest, truth)
    figures = {
        "brackets": len(gaps),
        "no rollout reached": lost,
        "lower above upper": int(crossed),
        "held against exact costs": checked,
        "lower above exact": int(wrong),
        "upper below exact: the search missed an optimum": int(missed),
        "upper below exact, what its last millimetre costs unknown": int(unended),
        "median gap": float(np.median(gaps)),
        "gap, 95 %": float(np.quantile(gaps, 0.95)),
        "median of exact over lower - 1": float(np.median(gaps_known)),
        "seconds of processor a query": float(np.median(seconds)),
    }
    table = Table(title="Certified brackets: random queries of the paper's family")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else f"{value:,}")
    return Report({"brackets": figures}, [table])
