"""Repair against growth from scratch: RRT^X, OMPL's planners and the visibility graph's optimum.

One run, the same maps, the same certificates as validity oracle. OMPL is optional: without it the
peers are left out, and the report says so.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from planners.rrtx import RRTX
from planners.solids import Solid
from planners.update import Update
from planners.world import SceneWorld
from sims.benchmarks import Report
from sims.benchmarks.rrtx_maps import HALF, PLANE, Map, random_solid, space_100
from sims.benchmarks.rrtx_peers import PEERS, PeersMissingError, run_peer
from sims.benchmarks.visibility_graph import shortest_way

PADDING = 0.2
NODES = 5000
SCRATCH_EVENTS = 3
PEER_EVENTS = 2


def run(seed: int, out: Path | None, events: int = 200, peer_limit: float = 3.0) -> Report:
    """Run the benchmark; the plot goes to `out`.

    Args:
        events: change events in all, shared among the maps of the plane.
        peer_limit: seconds after which a peer is stopped.
    """
    _warm_up()
    figures: dict[str, Any] = {"padding_m": PADDING, "nodes": NODES, "maps": {}}
    for name, make in PLANE.items():
        each = math.ceil(events / len(PLANE))
        figures["maps"][name] = _measure(make(seed), seed, NODES, each, peer_limit)
    figures["maps"]["space, 100 obstacles"] = _measure(space_100(seed), seed, NODES, 20, None)
    large = _measure(PLANE["20 obstacles"](seed), seed, 4 * NODES, 40, None)
    figures["maps"]["20 obstacles, 20000 nodes"] = large
    if out is not None:
        _plot(figures, out)
    return Report(figures, [_latency_table(figures), _peer_table(figures)])


def _measure(
    problem: Map, seed: int, nodes: int, events: int, peer_limit: float | None
) -> dict[str, Any]:
    rng = np.random.default_rng([seed, nodes, events])
    box = np.full(problem.dimension, HALF)
    world = SceneWorld(-box, box, problem.solids)
    options: dict[str, Any] = {"seed": seed, "padding": PADDING}
    growth = RRTX(world, problem.goal, problem.start, nodes, **options)
    planner = growth
    rows: list[dict[str, Any]] = []
    scratch: list[float] = []
    peers: list[dict[str, Any]] = []
    first = _optimum(planner)
    for kind, update in _events(planner, rng, events):
        row = {
            "kind": kind,
            "seconds": update.seconds,
            "geometry_seconds": update.geometry_seconds,
            "route": update.route is not None,
            "repaired": update.repaired,
        }
        rows.append(row)
        best = _optimum(planner)
        if best is not None:
            row["possible"] = math.isfinite(best)
            if update.route is not None:
                row["excess"] = update.route.cost / best - 1
                row["excess_shortened"] = planner.shortened().cost / best - 1
        if kind == "appears" and update.route is not None:
            if len(scratch) < SCRATCH_EVENTS:
                again = RRTX(
                    world,
                    planner.goal,
                    planner.robot,
                    nodes,
                    **{**options, "padding": planner.padding},
                )
                scratch.append(again.construction.seconds)
            if peer_limit is not None and len(peers) < PEER_EVENTS * len(PEERS):
                peers += _race(planner, update, peer_limit, seed)
        planner.settle()
    return {
        "growth_seconds": growth.construction.seconds,
        "path_over_optimum": _over(growth.construction, first),
        "events": rows,
        "scratch_seconds": scratch,
        "peers": peers,
    }


def _events(planner: RRTX, rng: np.random.Generator, count: int) -> Iterator[tuple[str, Update]]:
    """Random changes: obstacles of 2 m on the route, and whatever may happen after."""
    added: list[int] = []
    for _ in range(count):
        kind = str(rng.choice(["appears", "appears", "vanishes", "moves", "padding", "robot"]))
        spot = _spot_on_route(planner, rng)
        if kind in ("vanishes", "moves") and not added:
            kind = "appears"
        if spot is None and kind in ("appears", "robot"):
            kind = "vanishes" if added else "padding"
        if kind == "appears" and spot is not None:
            update = planner.appear(random_solid(rng, spot, 1.0, len(spot)))
            added += update.handles
        elif kind == "vanishes":
            update = planner.vanish(added.pop(int(rng.integers(len(added)))))
        elif kind == "moves":
            shift = rng.normal(size=planner.world.dimension)
            update = planner.shift(added[int(rng.integers(len(added)))], shift)
        elif kind == "padding":
            update = planner.set_padding(float(rng.uniform(0.0, 0.4)))
        else:
            points = planner.route.points
            update = planner.move_robot(points[0] + 0.3 * (points[1] - points[0]))
        yield kind, update


def _spot_on_route(planner: RRTX, rng: np.random.Generator) -> NDArray[np.float64] | None:
    """A point of the route at least 2.5 m from both ends; None if there is none."""
    update = planner.change()
    if update.route is None:
        return None
    points = update.route.points
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] < 6:
        return None
    at = rng.uniform(2.5, along[-1] - 2.5)
    spot = np.array([np.interp(at, along, column) for column in points.T])
    near = np.linalg.norm(points[[0, -1]] - spot, axis=1).min()
    return spot if near > 1.0 + planner.padding + 0.5 else None


def _optimum(planner: RRTX) -> float | None:
    """Length of the shortest way; infinite if there is none, None in space."""
    world = planner.world
    if world.dimension != 2 or not isinstance(world, SceneWorld):
        return None
    return shortest_way(
        world.obstacles.values(),
        planner.robot,
        planner.goal,
        planner.padding,
        24,
        (world.lower, world.upper),
    )[0]


def _over(update: Update, best: float | None) -> float | None:
    if update.route is None or best is None or not math.isfinite(best):
        return None
    return update.route.cost / best - 1


def _race(planner: RRTX, update: Update, limit: float, seed: int) -> list[dict[str, Any]]:
    """Let every peer plan from scratch until it has a way as short as ours, within 0.1 %."""
    assert update.route is not None
    target = update.route.cost * 1.001
    best = _optimum(planner)
    found = []
    for name in PEERS:
        try:
            result = run_peer(
                name, planner.world, planner.robot, planner.goal, planner.padding,
                target, limit, seed,
            )  # fmt: skip
        except PeersMissingError as missing:
            return [{"missing": str(missing)}]
        found.append(
            {
                "peer": name,
                "seconds": result.seconds,
                "reached": result.reached,
                "over_optimum": result.cost / best - 1
                if best is not None and math.isfinite(result.cost)
                else None,
                "our_seconds": update.seconds,
            }
        )
    return found


def _warm_up() -> None:
    """One small run of everything, so that nothing is loaded or compiled while the clock runs."""
    box = np.full(2, HALF)
    planner = RRTX(SceneWorld(-box, box), [15, 15], [-15, -15], 300)
    planner.appear(Solid.polygon([[-1, -1], [1, -1], [0, 1]]))
    planner.appear(Solid.ball([0, 0], 1.0))
    planner.set_padding(0.1)
    _optimum(planner)
    planner.shortened()


def summary(values: list[float]) -> dict[str, float]:
    """Median, 95th percentile and maximum."""
    return {
        "median": float(np.median(values)),
        "95 %": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
    }


def _latency_table(figures: dict[str, Any]) -> Table:
    table = Table(title=f"RRT^X, {NODES} nodes, padding {PADDING} m: repair, growth and quality")
    columns = ("map", "event", "count", "median ms", "95 % ms", "max ms", "growth ms",
               "growth / repair", "over optimum %", "shortened %", "success")  # fmt: skip
    for column in columns:
        table.add_column(column, justify="left" if column in ("map", "event") else "right")
    for name, found in figures["maps"].items():
        kinds = sorted({row["kind"] for row in found["events"]})
        for kind in (*kinds, "all"):
            rows = [r for r in found["events"] if kind in (r["kind"], "all")]
            spread = summary([1e3 * r["seconds"] for r in rows])
            excess = [r["excess"] for r in rows if "excess" in r]
            shortened = [r["excess_shortened"] for r in rows if "excess_shortened" in r]
            possible = [r["route"] for r in rows if r.get("possible", True)]
            growth = 1e3 * float(np.median(found["scratch_seconds"] or [found["growth_seconds"]]))
            table.add_row(
                name if kind == kinds[0] else "",
                kind,
                str(len(rows)),
                *(f"{value:.2f}" for value in spread.values()),
                f"{growth:.0f}",
                f"{growth / spread['median']:.0f}",
                f"{100 * np.median(excess):.2f}" if excess else "",
                f"{100 * np.median(shortened):.2f}" if shortened else "",
                f"{sum(possible)}/{len(possible)}",
            )
    return table


def _peer_table(figures: dict[str, Any]) -> Table:
    table = Table(title="Peers from scratch, until as short as our repaired route (within 0.1 %)")
    columns = ("map", "peer", "runs", "as short", "median s", "over optimum %", "peer / repair")
    for column in columns:
        table.add_column(column, justify="left" if column in ("map", "peer") else "right")
    for name, found in figures["maps"].items():
        runs = [r for r in found["peers"] if "peer" in r]
        for missing in {r["missing"] for r in found["peers"] if "missing" in r}:
            table.add_row(name, missing, "", "", "", "", "")
        for peer in dict.fromkeys(r["peer"] for r in runs):
            own = [r for r in runs if r["peer"] == peer]
            reached = sum(r["reached"] for r in own)
            ratio = float(np.median([r["seconds"] / r["our_seconds"] for r in own]))
            over = [r["over_optimum"] for r in own if r["over_optimum"] is not None]
            table.add_row(
                name,
                peer,
                str(len(own)),
                f"{reached}/{len(own)}",
                f"{np.median([r['seconds'] for r in own]):.3f}",
                f"{100 * np.median(over):.2f}" if over else "no way",
                # A peer that was stopped would have needed longer.
                f"{'' if reached == len(own) else '> '}{ratio:.0f}",
            )
    return table


def _plot(figures: dict[str, Any], out: Path) -> None:
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    names = list(figures["maps"])
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    repairs = [[1e3 * r["seconds"] for r in figures["maps"][n]["events"]] for n in names]
    left.boxplot(repairs, orientation="horizontal", whis=(5, 95), flierprops={"markersize": 3})
    for y, name in enumerate(names, 1):
        found = figures["maps"][name]
        growth = [1e3 * s for s in (found["scratch_seconds"] or [found["growth_seconds"]])]
        left.plot(growth, [y] * len(growth), "s", color="#0072B2", ms=6, mfc="none")
        reached = [1e3 * r["seconds"] for r in found["peers"] if r.get("reached")]
        stopped = [1e3 * r["seconds"] for r in found["peers"] if r.get("reached") is False]
        left.plot(reached, [y] * len(reached), "^", color="#D55E00", ms=6, mfc="none")
        left.plot(stopped, [y] * len(stopped), ">", color="#D55E00", ms=6)
    left.plot([], [], "s", color="#0072B2", mfc="none", label="RRT^X grown from scratch")
    left.plot([], [], "^", color="#D55E00", mfc="none", label="peer as short as our route")
    left.plot([], [], ">", color="#D55E00", label="peer stopped before that")
    left.set_yticks(range(1, len(names) + 1), names)
    left.set_xscale("log")
    left.set_xlabel("milliseconds; boxes: repair after a change, whiskers 5 and 95 %")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    left.grid(axis="x", alpha=0.3)
    plane = [n for n in names if any("excess" in r for r in figures["maps"][n]["events"])]
    for y, name in enumerate(plane, 1):
        rows = [r for r in figures["maps"][name]["events"] if "excess" in r]
        right.plot(
            [100 * r["excess"] for r in rows], [y + 0.12] * len(rows), "|", color="#0072B2", ms=14
        )
        right.plot(
            [100 * r["excess_shortened"] for r in rows],
            [y - 0.12] * len(rows),
            "|",
            color="#009E73",
            ms=14,
        )
    right.plot([], [], "|", color="#0072B2", ms=12, label="route of the tree")
    right.plot([], [], "|", color="#009E73", ms=12, label="with corners left out")
    right.set_yticks(range(1, len(plane) + 1), plane)
    right.set_ylim(0.4, len(plane) + 0.6)
    right.set_xlim(left=0)
    right.set_xlabel("longer than the visibility graph's optimum, %")
    right.legend(fontsize=8)
    right.grid(axis="x", alpha=0.3)
    figure.savefig(out / "rrtx.png", dpi=130)
    plt.close(figure)
