"""Analytic LQR on random plants: Riccati solvers, matrix exponential, collocation and PMP."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.linalg import expm

from ocp.collocation import solve_collocation
from ocp.cost import RunningCost
from ocp.extremals.fixed_time import solve_fixed_time
from ocp.models.linear import linear_system
from ocp.query import Goal, Query
from ocp.riccati import LinearQuadratic, algebraic_riccati, differential_riccati
from ocp.system import Coordinate, Input, System
from sims.benchmarks import Report

PLANTS = 20
HORIZON = 3.0
notes = Console(stderr=True)


def run(seed: int, _out: Path | None) -> Report:
    """Largest disagreements over double integrators and random plants."""
    rng = np.random.default_rng(seed)
    plants = [_double_integrator(d) for d in (1, 2, 3)]
    plants += [_random_plant(rng) for _ in range(PLANTS)]
    rows = []
    with notes.status("LQR") as status:
        for k, plant in enumerate(plants):
            status.update(f"plant {k + 1} of {len(plants)}")
            rows.append(_disagreements(plant, rng))
    largest = {name: max(row[name] for row in rows) for name in rows[0]}
    table = Table(title=f"Largest relative difference over {len(plants)} linear plants")
    table.add_column("compared")
    table.add_column("difference", justify="right")
    for name, value in largest.items():
        table.add_row(name, f"{value:.1e}")
    return Report({"plants": rows, "largest": largest}, [table])


def _disagreements(system: System, rng: np.random.Generator) -> dict[str, float]:
    query = _query(system, rng)
    problem = LinearQuadratic.of_query(query)
    terminal, start = _semidefinite(rng, system.n), rng.uniform(-2, 2, system.n)
    truth = _by_matrix_exponential(problem, terminal, HORIZON)
    value = float(start @ truth @ start)
    scale = np.abs(truth).max()
    finite = differential_riccati(problem, terminal, HORIZON)
    steady = algebraic_riccati(problem)
    long = differential_riccati(problem, np.zeros_like(terminal), 60.0 / steady.decay_rate)
    collocation = solve_collocation(query, start, horizon=HORIZON, terminal_cost=terminal)
    end = collocation.states[-1]
    pmp = solve_fixed_time(query, start, HORIZON, terminal)
    return {
        "Drake's differential Riccati and the matrix exponential, P(0)": float(
            np.abs(finite.P() - truth).max() / scale
        ),
        "python-control's algebraic Riccati and Drake's long horizon, P": float(
            np.abs(steady.P() - long.P()).max() / np.abs(steady.P()).max()
        ),
        "PMP and the matrix exponential, cost": abs(pmp.value / value - 1),
        "PMP's Hessian and P(0)": float(np.abs(pmp.hessian / 2 - truth).max() / scale),
        "collocation and the matrix exponential, cost": abs(
            (collocation.cost + end @ terminal @ end) / value - 1
        ),
    }


def _query(system: System, rng: np.random.Generator) -> Query:
    rows: Any = tuple(map(tuple, _semidefinite(rng, system.n)))
    weights = tuple(float(r) for r in rng.uniform(0.5, 2.0, system.m))
    cost = RunningCost(goal=0.0, state=rows, input=weights)
    return Query(system, Goal((0.0,) * len(system.position), 0.1), cost=cost)


def _double_integrator(d: int) -> System:
    from ocp.models import get_model

    return get_model(f"double-integrator-{d}d")


def _random_plant(rng: np.random.Generator) -> System:
    """Controllable with probability one; about half of them unstable."""
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    coordinates = tuple(Coordinate(f"x{i}", "1", -5.0, 5.0) for i in range(n))
    inputs = tuple(Input(f"u{i}", "1") for i in range(m))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    return linear_system("random plant", A, B, coordinates, inputs, (0,))


def _semidefinite(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    root = rng.normal(size=(n, n))
    product = root @ root.T
    return (product + product.T) / 2


def _by_matrix_exponential(
    problem: LinearQuadratic, terminal: NDArray[np.float64], horizon: float
) -> NDArray[np.float64]:
    """P(0) from the Hamiltonian matrix (Radon's lemma), in steps that keep it well conditioned."""
    S = problem.B @ np.linalg.solve(problem.R, problem.B.T)
    hamiltonian = np.block([[problem.A, -S], [-problem.M, -problem.A.T]])
    steps = 30
    back = expm(-hamiltonian * horizon / steps)
    P, n = terminal, problem.n
    for _ in range(steps):
        both = back @ np.vstack([np.eye(n), P])
        P = both[n:] @ np.linalg.inv(both[:n])
        P = (P + P.T) / 2
    return P
