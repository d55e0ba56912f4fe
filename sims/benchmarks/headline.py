"""The headline figures in one run: median, spread, and ratio to a reference measured beside.

Times are processor times of one thread, which other work on the machine hardly touches. Each is
taken `REPEATS` times, and the reference (a fixed amount of plain Python) before each. The spread is
the range that half of the repeats fill, over the median: `zermelo bench --compare` makes its band
of noise from it.
"""

import resource
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from sims.benchmarks import Report, startup
from sims.commands.bench_compare import plain_work

REPEATS = 9
LEAST = 0.02
"""Seconds that a repeat lasts at least: short tasks are done several times in it."""
NODES = 5_000
"""Of the RRT^X tree."""
notes = Console(stderr=True)

Task = Callable[[], Any]


def run(seed: int, _out: Path | None, repeats: int = REPEATS) -> Report:
    """All figures; the last is the peak memory of this process."""
    figures: dict[str, dict[str, float]] = {}
    table = Table(title=f"Headline figures: processor time, median of {repeats}")
    for column in ("figure", "median", "spread", "over the reference"):
        table.add_column(column, justify="left" if column == "figure" else "right")
    for name, task in (*_planning(seed), *_repair(seed), *_regulation(seed)):
        notes.print(name, highlight=False)
        figures[name] = repeated(task, repeats)
        _row(table, name, figures[name])
    programs = startup.run(seed, None).figures["programs"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    table.add_row("peak memory", f"{peak:.0f} MB", "", "")
    for name, row in programs.items():
        table.add_row(name, f"{1e3 * row['processor_s']:.0f} ms", "", "")
    return Report({"times": figures, "programs": programs, "peak_MB": peak}, [table])


def repeated(task: Task, repeats: int) -> dict[str, float]:
    """Median seconds of processor of `task`, their spread, and the ratio to the reference."""
    task()
    begun = time.process_time()
    task()
    often = max(1, int(LEAST / max(time.process_time() - begun, 1e-7)))
    times, ratios = [], []
    for _ in range(repeats):
        begun = time.process_time()
        plain_work()
        middle = time.process_time()
        for _ in range(often):
            task()
        spent = (time.process_time() - middle) / often
        times.append(spent)
        ratios.append(spent / (middle - begun))
    low, _, high = statistics.quantiles(times, n=4)
    median = statistics.median(times)
    spread = (high - low) / median if median > 0 else 0.0
    return {"median_s": median, "spread": spread, "over_reference": statistics.median(ratios)}


def _row(table: Table, name: str, row: dict[str, float]) -> None:
    seconds, ratio = row["median_s"], row["over_reference"]
    shown = f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"
    table.add_row(name, shown, f"{100 * row['spread']:.0f} %", f"{ratio:.3g}")


def _planning(seed: int) -> Iterator[tuple[str, Task]]:
    """The query of Table I with three obstacles, from the paper's start and a random one."""
    from learning.meta_planner import MetaPlanner
    from ocp.eikonal import solve_eikonal
    from ocp.planning import iterations, plan, trajectories
    from ocp.pontryagin import exact_trajectory, solve_pmp
    from ocp.query_family import PAPER_START, paper_query, sample_start

    query, start = paper_query((1.0, 4.0)), np.array(PAPER_START)
    rng = np.random.default_rng(seed)
    states = np.array([sample_start(query, rng) for _ in range(1000)])
    solution = solve_eikonal(query)
    policy = solution.policy()
    truth = exact_trajectory(query, start)
    near = start + np.array([0.05, -0.05, 0.02])
    planner = MetaPlanner.shipped()
    network = planner.policy(planner.start(query, []))
    adapted = plan(planner, query, [start], trajectories(1)).policy
    yield "exact trajectory, from a neighbour's", lambda: solve_pmp(query, near, truth)
    yield "exact trajectory, guess included", lambda: solve_pmp(query, start, policy)
    yield "exact trajectory, all classes of motions", lambda: exact_trajectory(query, start)
    for nodes in (4_500, 18_000, 60_000):
        yield f"grid of {nodes:,} nodes", lambda nodes=nodes: solve_eikonal(query, nodes=nodes)
    yield "adaptation, network only", lambda: plan(planner, query, [start], iterations(0))
    yield "adaptation, one trajectory", lambda: plan(planner, query, [start], trajectories(1))
    for name, one in (("grid", policy), ("network", network), ("adapted", adapted)):
        yield f"policy call, {name}, one state", lambda one=one: one(start)
        yield f"policy call, {name}, 1,000 states", lambda one=one: one(states)


def _repair(seed: int) -> Iterator[tuple[str, Task]]:
    """RRT^X among 20 obstacles: growth, an obstacle on the route, a change of padding."""
    from planners.rrtx import RRTX
    from planners.solids import Solid
    from planners.world import SceneWorld
    from sims.benchmarks.rrtx_maps import HALF, PLANE

    problem = PLANE["20 obstacles"](seed)
    box = np.full(problem.dimension, HALF)
    world = SceneWorld(-box, box, problem.solids)

    def grown() -> RRTX:
        return RRTX(world, problem.goal, problem.start, NODES, seed=seed, padding=0.2)

    yield f"RRT^X, growth to {NODES:,} nodes", grown
    planner = grown()
    route = planner.construction.route
    assert route is not None
    middle = np.asarray(route.points)[len(route.points) // 2]
    obstacle = Solid.ball(middle, 1.0)

    def appears_and_vanishes() -> None:
        (handle,) = planner.appear(obstacle).handles
        planner.vanish(handle)

    yield "RRT^X, an obstacle appears and vanishes", appears_and_vanishes
    points = np.random.default_rng(seed).uniform(-HALF, HALF, (1000, problem.dimension))
    yield "distances of 1,000 points to 20 obstacles", lambda: world.distances(points)


def _regulation(seed: int) -> Iterator[tuple[str, Task]]:
    """Recursive least squares with four states and two inputs, as on the rover."""
    from learning.q_learning.window_regression import WindowRegression

    rng = np.random.default_rng(seed)
    holds, substeps = 100, 4
    data = WindowRegression(4, 2, 0.01, substeps, 5, 1.0)
    states = rng.standard_normal((holds * substeps + 1, 4))
    inputs = rng.standard_normal((holds, 2))

    def absorb() -> None:
        data.interrupt()
        data.absorb(states, inputs)

    yield f"least squares, {holds} updates", absorb
