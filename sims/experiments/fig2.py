"""Figure 2: cost over the exact optimum against computation time, every method any time."""

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.planning import Answer
from ocp.query import Query
from ocp.query_family import paper_query
from ocp.trajectory import SolveError, Status
from ocp.value import Policy
from sims.closed_loop import LoopSettings, rollouts
from sims.experiments import Entry, Findings, Setting
from sims.experiments.contestants import contestant
from sims.experiments.measure import rehearse, truth
from sims.experiments.sheet import ABSENT, Sheet, number, seconds
from sims.parts import Parts

log = logging.getLogger(__name__)

GOAL = (4.0, 4.0)
STARTS = (
    (-4.0, -4.0, -0.25 * np.pi),
    (-2.5, -4.0, 0.25 * np.pi),
    (-4.0, 2.0, -0.1 * np.pi),
)
NODES = (1_000, 2_000, 4_500, 9_000, 18_000, 60_000, 240_000)
CELLS = (29, 36, 46, 58, 73, 92, 116)
"""Of a set-valued grid along x; the coarse and the fine grid of the paper among them."""
RATIO = 2.28  # of eps to h, that of the paper's two grids
Point = dict[str, Any]

PAPER = {
    "faithful": ("adaptation", 4.0, 6.0),
    "refmm": ("ReFMM", 15.0, 30.0),
    "set-valued": ("set-valued method", 30.0, 90.0),
    "trpo": ("TRPO", 60.0, None),
}
"""What the text says: seconds to the first feasible controller, and to an excess of 5 %."""


def run(setting: Setting, parts: Parts) -> Findings:
    """A curve for each method; each point is the mean over the paper's three starts."""
    query = paper_query(GOAL)
    optima = [truth(parts, query, s, f"truth-fig2-{k}")["cost"] for k, s in enumerate(STARTS)]
    if any(o is None for o in optima):
        raise SolveError(
            Status.NOT_CONVERGED, "the optimum of a start of Figure 2 is not established"
        )
    curves, absent = {}, {}
    for name, (key, trace) in CURVES.items():
        why = contestant(key).absent
        if setting.quick and name in SLOW:
            why = "trained for minutes on each query, left out of a quick run"
        if why is not None:
            absent[name] = why
            continue
        curves[name] = parts.get(
            f"fig2-{name}",
            {**contestant(key).config, **SIZES.get(name, {})},
            lambda trace=trace, key=key: _curve(key, trace, query, optima, setting),
        )
    document = {"starts": [list(s) for s in STARTS], "optima": optima, "curves": curves}
    document["absent"] = absent
    return Findings(document, {"fig2": sheet(document)})


def _curve(
    key: str, trace: Callable, query: Query, optima: list[float], setting: Setting
) -> list[Point]:
    who = contestant(key)
    points: list[Point] = []
    try:
        for spent, policy in trace(query, setting.quick):
            points.append({"seconds": spent, "ratio": _ratio(policy, optima, who.held)})
    except (SolveError, FloatingPointError) as error:
        log.warning("%s: %s", key, error)  # no policy from here on
        points.append({"seconds": points[-1]["seconds"] if points else 0.0, "ratio": None})
    return points


def _ratio(policy: Policy, optima: list[float], period: float) -> float | None:
    """Mean cost over the optimum; `None` unless all three starts reach the goal."""
    try:
        loops = rollouts(policy, STARTS, LoopSettings(period=period))
    except (SolveError, FloatingPointError):
        return None
    costs = [loop.cost for loop in loops]
    if any(c is None for c in costs):
        return None
    return float(np.mean([c / o for c, o in zip(costs, optima, strict=True) if c is not None]))


def _sizes(solve: Callable[[Query, int], Answer], sizes: tuple[int, ...]) -> Callable:
    """A one-shot method at growing sizes, each solved from nothing: its time is that solve's."""

    def trace(query: Query, quick: bool) -> Iterator[tuple[float, Policy]]:
        solve(query, sizes[0])
        for size in sizes[: len(sizes) - 2 * quick]:
            begun = time.process_time()
            policy, _ = solve(query, size)
            yield time.process_time() - begun, policy

    return trace


def _eikonal(query: Query, nodes: int) -> Answer:
    from ocp.eikonal import solve_eikonal

    solution = solve_eikonal(query, nodes=nodes)
    return solution.policy(), solution.value


def _set_valued(query: Query, cells: int) -> Answer:
    from ocp.grid import Grid
    from ocp.set_valued import SetValuedSettings, solve_set_valued

    grid = Grid.of(query.system, (cells, cells, round(cells * 0.61)))
    step = RATIO * float(grid.spacing.max())
    solution = solve_set_valued(query, grid, SetValuedSettings(step=step))
    return solution.policy(), solution.value


def _refining(key: str, most: int) -> Callable:
    """A planner that refines: the time is what it has spent so far, closed loops excluded."""

    def trace(query: Query, quick: bool) -> Iterator[tuple[float, Policy]]:
        who = contestant(key)
        rehearse(who)
        planner = who.planner()
        starts: list[NDArray[np.float64]] = [np.array(s) for s in STARTS]
        begun = time.process_time()
        state = planner.start(query, starts)
        spent = time.process_time() - begun
        yield spent, planner.policy(state)
        for k in range(most // (8 if quick else 1)):
            if state.finished:
                return
            begun = time.process_time()
            state = planner.refine(state)
            spent += time.process_time() - begun
            if k < 16 or k % 4 == 3:
                yield spent, planner.policy(state)

    return trace


CURVES: dict[str, tuple[str, Callable]] = {
    "adapt": ("adapt", _refining("adapt", 64)),
    "eikonal": ("eikonal", _sizes(_eikonal, NODES)),
    "refmm": ("refmm-fine", _refining("refmm-fine", 16)),
    "set-valued": ("set-valued-coarse", _sizes(_set_valued, CELLS)),
    "faithful": ("faithful", _refining("faithful", 64)),
    "anytime": ("anytime", _refining("anytime", 64)),
    "interpolation": ("interpolation", _refining("interpolation", 0)),
}
"""The contestant behind each curve, and what traces it."""
SLOW = ("interpolation",)
SIZES = {
    "eikonal": {"nodes": list(NODES)},
    "set-valued": {"cells": list(CELLS), "ratio": RATIO},
}
"""What the curves of one-shot methods depend on beside that."""


def first(points: list[Point], most: float = np.inf) -> float | None:
    """Seconds until the cost is at most so many times the optimum, for good."""
    found = None
    for point in reversed(points):
        if point["ratio"] is None or point["ratio"] > most:
            break
        found = point["seconds"]
    return found


def sheet(document: dict[str, Any]) -> Sheet:
    """Seconds to a policy that reaches the goal, to 5 %, 1 % and .1 % above the optimum."""
    result = Sheet(
        "Figure 2: processor time to a feasible policy and to an excess over the exact optimum",
        ("method", "feasible", "5 %", "1 %", "0.1 %", "least excess"),
    )
    for name in CURVES:
        points = document["curves"].get(name)
        if points is None:
            result.add(name, *[ABSENT] * 5)
            continue
        reached = [p["ratio"] for p in points if p["ratio"] is not None]
        times = (first(points, r) for r in (np.inf, 1.05, 1.01, 1.001))
        least = 100 * (min(reached) - 1) if reached else None
        result.add(name, *(seconds(t) for t in times), number(least, "{:.3f} %"))
    result.notes = [
        "Mean over the three starts, one thread; a method counts from when all three reach the "
        "goal, and stay within the excess at all later points.",
        *(f"{name}: {why}." for name, why in document["absent"].items()),
    ]
    return result


def draw(document: dict[str, Any], out: Path) -> list[Path]:
    """Excess against time on logarithmic axes."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save_all

    figure, axes = plt.subplots(figsize=(6.8, 4.6), layout="constrained")
    colours = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#882255", "#56B4E9")
    floor = 1e-3
    for name, colour, mark in zip(CURVES, colours, "oDs^vXP", strict=True):
        points = [p for p in document["curves"].get(name, []) if p["ratio"] is not None]
        if points:
            axes.loglog(
                [p["seconds"] for p in points],
                [max(100 * (p["ratio"] - 1), floor) for p in points],
                marker=mark,
                color=colour,
                ms=5,
                lw=1.4,
                label=name,
            )
    for name, (label, _, five) in PAPER.items():
        if name in CURVES and five is not None:
            colour = colours[list(CURVES).index(name)]
            axes.plot(five, 5, "*", mfc="none", mec=colour, ms=11)
            place = {"xytext": (0, 9), "textcoords": "offset points", "rotation": 35}
            axes.annotate(label, (five, 5), **place, fontsize=8, color="0.3")
    axes.plot([], [], "*", mfc="none", mec="0.3", ms=11, label="time to 5 % in the paper")
    axes.set_xlim(right=2e3)
    axes.set_ylim(floor / 1.4, 100)
    ticks = (0.001, 0.01, 0.1, 1, 10, 100)
    axes.set_yticks(ticks, ["≤ 0.001", *(f"{t:g}" for t in ticks[1:])])
    axes.set_xlabel("computation time (s, one thread)")
    axes.set_ylabel("mean cost above the exact optimum (%)")
    axes.grid(which="major", alpha=0.3)
    axes.legend(frameon=False, fontsize=9, loc="center right")
    return save_all(figure, out / "fig2")


def entries(document: dict[str, Any]) -> list[Entry]:
    """What the text says about the figure."""
    found = []
    for name, (label, feasible, five) in PAPER.items():
        points = document["curves"].get(name)
        for what, claim, most in (
            ("a feasible controller", feasible, np.inf),
            ("within 5 %", five, 1.05),
        ):
            if claim is None:
                continue
            if points is None:
                ours, remark = ABSENT, document["absent"].get(name, "Not traced over time.")
            else:
                when = first(points, most)
                ours = seconds(when, "never")
                remark = "Over the exact optimum here, over its own fine grid in the paper."
            found.append(
                Entry(f"Figure 2, {label}: {what}", seconds(claim), ours=ours, remark=remark)
            )
            if name == "faithful" and (anytime := document["curves"].get("anytime")):
                found.append(
                    Entry(
                        f"Figure 2, {label} with any-time settings: {what}",
                        seconds(claim),
                        ours=seconds(first(anytime, most), "never"),
                        remark=remark,
                    )
                )
    ours = document["curves"].get("adapt") or document["curves"].get("eikonal")
    if ours:
        found.append(
            Entry(
                "Figure 2, the fastest planner here: within 5 %",
                "6 s (adaptation, one process)",
                ours=seconds(first(ours, 1.05)),
                remark=f"Within 1 % after {seconds(first(ours, 1.01))}.",
            )
        )
    return found
