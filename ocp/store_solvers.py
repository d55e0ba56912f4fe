"""The solvers a store knows: query and settings in, arrays out. All plain data at both ends."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ocp.query import Query
from ocp.query_file import query_from_dict
from ocp.store_schema import Order, Solved, finite_or_none, plain_query
from ocp.trajectory import SolveError
from ocp.version import code_version

COARSER = 2.0  # times the spacing of the grid that the error is estimated with
SAMPLES = 2048  # states at which the two are compared, between the nodes too


@dataclass(frozen=True)
class Solver:
    """A solver by name.

    Attributes:
        defaults: its settings.
        solve: (query, settings) -> answer; may raise `SolveError`.
        module: whose sources, and all they import, can change the numbers.
    """

    defaults: Mapping[str, Any]
    solve: Callable[[Query, Mapping[str, Any]], Solved]
    module: str

    def __post_init__(self) -> None:
        """Note the sources' version now, at import: they may be edited while they run."""
        code_version(self.module)


def _eikonal(query: Query, settings: Mapping[str, Any]) -> Solved:
    """V on a grid. The error is estimated from a grid twice as coarse, by the scheme's order."""
    from ocp.eikonal import Scheme, default_scheme, solve_eikonal

    nodes = int(settings["nodes"])
    scheme = default_scheme(query) if settings["scheme"] is None else Scheme[settings["scheme"]]
    begun = time.process_time()
    solution = solve_eikonal(query, nodes=nodes, scheme=scheme)
    seconds = time.process_time() - begun
    grid, values = solution.grid, solution.value.on_grid.values
    names = tuple(c.name for c in query.system.coordinates)
    arrays: dict[str, Any] = {"value": (names, values)}
    arrays |= {name: ((name,), axis) for name, axis in zip(names, grid.axes, strict=True)}
    error = None
    if settings["estimate"]:
        coarse_nodes = max(nodes / COARSER**grid.dimension, 6.0**grid.dimension)
        coarse = solve_eikonal(query, nodes=round(coarse_nodes), scheme=scheme)
        order = 2 if scheme is Scheme.FAST_MARCHING else 1
        rng = np.random.default_rng(0)
        states = rng.uniform(query.system.lower, query.system.upper, (SAMPLES, query.system.n))
        ours = np.asarray(solution.value.value(states))
        theirs = np.asarray(coarse.value.value(states))
        known = np.isfinite(ours) & np.isfinite(theirs) & (ours > 0)
        if known.any():
            gaps = np.abs(theirs[known] - ours[known]) / ours[known]
            ratio = (grid.size / coarse.grid.size) ** (order / grid.dimension)
            error = finite_or_none(float(np.median(gaps)) / (ratio - 1))
    detail = {
        "scheme": scheme.name,
        "lower": list(grid.lower),
        "upper": list(grid.upper),
        "shape": list(grid.shape),
        "periodic": list(grid.periodic),
    }
    return Solved(arrays, solution.status, error, seconds, detail)


def _exact(query: Query, settings: Mapping[str, Any]) -> Solved:
    """Optimal costs and costates at random starts; NaN where truth was not established."""
    from ocp.oracle import TRUTH_TOLERANCE, consult
    from ocp.query_family import sample_start

    rng = np.random.default_rng(int(settings["seed"]))
    starts = np.array([sample_start(query, rng) for _ in range(int(settings["starts"]))])
    costs, costates = np.full(len(starts), np.nan), np.full(starts.shape, np.nan)
    begun = time.process_time()
    for k, start in enumerate(starts):
        verdict = consult(query, start)
        best = verdict.best
        if verdict.established and best is not None:
            costs[k] = best.cost
            if best.costates is not None:
                costates[k] = best.costates[0]
    arrays = {
        "start": (("k", "coordinate"), starts),
        "cost": (("k",), costs),
        "costate": (("k", "coordinate"), costates),
    }
    established = int(np.isfinite(costs).sum())
    error = TRUTH_TOLERANCE if established else None
    seconds = time.process_time() - begun
    return Solved(
        arrays, error_estimate=error, seconds=seconds, detail={"established": established}
    )


SOLVERS: dict[str, Solver] = {
    "eikonal": Solver({"nodes": 60_000, "scheme": None, "estimate": True}, _eikonal, "ocp.eikonal"),
    "exact": Solver({"starts": 8, "seed": 0}, _exact, "ocp.oracle"),
}


def order(query: Query, solver: str, settings: Mapping[str, Any] | None = None) -> Order:
    """What to ask a store for.

    Raises:
        ValueError: if the solver or a setting is unknown, or no file can hold the query's model.
    """
    if solver not in SOLVERS:
        raise ValueError(f"solver: {solver!r} is unknown; known are {', '.join(SOLVERS)}")
    chosen = SOLVERS[solver]
    for name in settings or {}:
        if name not in chosen.defaults:
            known = ", ".join(chosen.defaults)
            raise ValueError(f"{solver}.{name}: unknown; known are {known}")
    filled = {**chosen.defaults, **(settings or {})}
    return Order(plain_query(query), solver, filled, code_version(chosen.module))


def carry_out(asked: Order) -> Solved:
    """Solve an order. A solver's own failure is an answer, with its status and no arrays.

    Raises:
        ValueError: if this machine's sources are not those of the order, or the query is wrong.
    """
    solver = SOLVERS[asked.solver]
    ours = code_version(solver.module)
    if ours != asked.code_version:
        raise ValueError(
            f"code_version: ordered from {asked.code_version}, but the worker runs {ours}: "
            "start it anew"
        )
    begun = time.process_time()
    try:
        return solver.solve(query_from_dict(asked.query), asked.settings)
    except SolveError as error:
        seconds = time.process_time() - begun
        return Solved({}, error.status, None, seconds, {"why": error.detail})
