"""Exact optimal costs: the paper's four queries, the closed form, and 100 random problems."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.closed_form import straight_value
from ocp.collocation import solve_collocation
from ocp.eikonal import solve_eikonal
from ocp.extremals.extremal import find_extremal
from ocp.extremals.warm_start import rollouts
from ocp.oracle import Verdict, consult
from ocp.pontryagin import exact_trajectory, solve_pmp
from ocp.query_family import PAPER_FAMILY, PAPER_GOALS, PAPER_START, paper_query
from sims.benchmarks import Report

PROBLEMS = 100
notes = Console(stderr=True)


def run(seed: int, _out: Path | None) -> Report:
    """The three parts, one table each."""
    report = Report()
    for part in (_four_queries, _closed_form, _random_problems):
        part(report, np.random.default_rng(seed))
    return report


def _four_queries(report: Report, _rng: np.random.Generator) -> None:
    table = Table(title="Optimal cost from (-4, -4, -pi/4)")
    for column in ("goal", "PMP", "collocation", "relative difference"):
        table.add_column(column, justify="right")
    rows = []
    for goal in PAPER_GOALS:
        query = paper_query(goal)
        pmp = exact_trajectory(query, PAPER_START).cost
        collocation = solve_collocation(query, PAPER_START).cost
        gap = abs(collocation / pmp - 1)
        rows.append({"goal": goal, "pmp": pmp, "collocation": collocation, "gap": gap})
        table.add_row(
            "({:g}, {:g})".format(*goal), f"{pmp:.5f}", f"{collocation:.5f}", f"{gap:.1e}"
        )
    report.figures["four_queries"] = rows
    report.tables.append(table)


def _closed_form(report: Report, rng: np.random.Generator) -> None:
    """Aligned headings, facing the goal or away from it."""
    errors: dict[str, list[float]] = {"pmp": [], "collocation": []}
    query = paper_query((4.0, 4.0))
    for k in range(20):
        bearing, distance = rng.uniform(np.pi, 1.5 * np.pi), rng.uniform(0.6, 8.0)
        offset = distance * np.array([np.cos(bearing), np.sin(bearing)])
        start = query.system.wrap([4 + offset[0], 4 + offset[1], bearing + np.pi * (k % 2)])
        exact = straight_value(query, start)
        errors["pmp"].append(abs(exact_trajectory(query, start).cost / exact - 1))
        errors["collocation"].append(abs(solve_collocation(query, start).cost / exact - 1))
    table = Table(title="Largest relative error against the closed form, 20 aligned headings")
    for column in ("method", "error"):
        table.add_column(column, justify="right")
    for name, found in errors.items():
        report.figures[f"closed_form_error_{name}"] = max(found)
        table.add_row(name, f"{max(found):.1e}")
    report.tables.append(table)


def _random_problems(report: Report, rng: np.random.Generator) -> None:
    """Success and time of one shooting from a grid's guess, and how many optima count as truth."""
    query, start = PAPER_FAMILY.sample_with_start(rng)
    policy = solve_eikonal(query).policy()
    find_extremal(query, start, solve_pmp(query, start, policy))  # loads compiled code
    guesses, shots, solved, cheapest = [], [], 0, 0
    verdicts: list[Verdict] = []
    with notes.status("random problems") as status:
        for k in range(PROBLEMS):
            status.update(f"random problem {k + 1} of {PROBLEMS}")
            query, start = PAPER_FAMILY.sample_with_start(rng)
            policy = solve_eikonal(query).policy()
            begun = time.perf_counter()
            guess = rollouts(query, policy, start)[0]
            guesses.append(time.perf_counter() - begun)
            verdict = consult(query, start)
            verdicts.append(verdict)
            if not verdict.established:
                notes.print(f"{start}, goal {query.goal_position}: {verdict.explanation}")
            if guess is None:
                continue
            begun = time.perf_counter()
            motion = find_extremal(query, start, guess).trajectory
            shots.append(time.perf_counter() - begun)
            if motion is not None and verdict.value is not None:
                solved += 1
                cheapest += motion.cost <= verdict.value * (1 + 1e-4)
    figures = {
        "problems": PROBLEMS,
        "one shooting from the grid's guess: solved": solved,
        "and the cheapest": int(cheapest),
        "median ms, guess excluded": 1e3 * float(np.median(shots)),
        "median ms, rollout of the guess included": 1e3 * float(np.median(np.add(guesses, shots)))
        if len(shots) == len(guesses)
        else None,
        "all candidates: solved": sum(v.answers["PMP"].value is not None for v in verdicts),
        "all candidates: the cheapest": sum(_cheapest(v, "PMP") for v in verdicts),
        "collocation from its own guesses: the cheapest": sum(
            _cheapest(v, "collocation") for v in verdicts
        ),
        "truth established": sum(v.established for v in verdicts),
    }
    report.figures["random_problems"] = figures
    table = Table(title=f"{PROBLEMS} random queries of the paper's family, random starts")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in figures.items():
        table.add_row(name, _text(value))
    report.tables.append(table)


def _cheapest(verdict: Verdict, method: str) -> bool:
    return verdict.spread.get(method, np.inf) <= 1e-4


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
