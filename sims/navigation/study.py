"""What is claimed of RRT-Q^X, measured: prints every figure that the documents quote.

`python -m sims.navigation.study PART [--scenarios N] [--keep FILE]`; PART is controllers,
improvements, crowds, teams, figure-2 or all. With --keep every run is written to FILE, one JSON
document a line, and runs that stand there are not made again. `zermelo bench navigation` prints the
same tables.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ocp.query_file import read_toml
from planners.navigation_settings import (
    FLOWING,
    FORETOLD,
    PAPER,
    NavigatorSettings,
    Rules,
    WaypointRule,
)
from planners.orders import Phase
from sims.benchmarks.visibility_graph import shortest_way
from sims.navigation.controllers import ExactController
from sims.navigation.navigate import FORESEEING, Navigation, run
from sims.navigation.scenario_file import Scenario, shipped_scenarios
from sims.navigation.scenario_generator import load, random_crowd, random_scenario, random_team
from sims.regulation.simulation import LinearPlant

Array = NDArray[np.float64]

RULES: dict[str, Rules] = {"paper": PAPER, "each leg foretold": FORETOLD, "flowing": FLOWING}
PLANTS = ("springless-rover", "double-integrator")
BASELINES = ("open-loop", "paper-literal", "paper-repaired")
SHORT = 30.0
"""Seconds that a controller which does not control is given."""
PIECES = 10


class Ledger:
    """Runs that were made, by name; kept in a file if one is given."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.runs: dict[str, list[dict[str, Any]]] = {}
        if path is not None and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                entry = json.loads(line)
                self.runs[entry["name"]] = entry["robots"]

    def get(self, name: str, make: Callable[[], list[Navigation]]) -> list[dict[str, Any]]:
        """The robots of the run of this name."""
        if name not in self.runs:
            self.runs[name] = [summary(r) for r in make()]
            if self._path is not None:
                with self._path.open("a", encoding="utf-8") as out:
                    out.write(json.dumps({"name": name, "robots": self.runs[name]}) + "\n")
        return self.runs[name]


def summary(result: Navigation) -> dict[str, Any]:
    """A run in numbers."""
    straight = float(np.linalg.norm(result.robot.goal - result.robot.start))
    latencies = np.percentile(result.latencies, [50.0, 99.0, 100.0]).tolist()
    excess = None
    if result.controller == "q-learning" and result.reached:
        excess = cost_excess(result)
    return {
        "reached": result.reached,
        "collided": result.collided,
        "duration": result.duration,
        "detour": result.length / straight,
        "clearance": result.min_clearance,
        "deviation": result.navigator.largest_deviation,
        "replans": len(result.navigator.replans),
        "latencies": latencies,
        "missed": result.missed,
        "samples": len(result.times),
        "excess": excess,
        "end": result.failure,
    }


def cost_excess(result: Navigation) -> float:
    """The learned regulator's cost over the exact one's, less one, after the learning phase.

    Both drive the true plant along the run's own references, from the state in which the learning
    ended; the cost is the integral of the error's x'M x + u'R u.
    """
    robot, period = result.robot, result.sample_period
    exact = ExactController(robot.plant, robot.cost, period)
    driver: Any = result.driver
    ready = int(np.argmax([p is not Phase.LEARNING for p in result.phases]))
    receding = result.navigator.settings.rules.waypoints is WaypointRule.MOVING
    costs = [_cost(result, gains, ready, receding) for gains in (driver.gains, exact.gains)]
    return costs[0] / costs[1] - 1.0


def _cost(result: Navigation, gains: Array, ready: int, receding: bool) -> float:
    plant, cost = result.robot.plant, result.robot.cost
    F, G, _ = LinearPlant(plant.A, plant.B).held_step(result.sample_period / PIECES)
    x = result.states[ready]
    total, clock, before = 0.0, 0, None
    for reference, leg in zip(result.references[ready:], result.legs[ready:], strict=True):
        clock = 0 if receding or leg != before else min(clock + 1, len(gains) - 1)
        before = leg
        # In error coordinates, which is what every plant here obeys with its holding input.
        error = x - reference
        u = -gains[clock] @ error
        total += float(u @ cost.R @ u) * PIECES
        for _ in range(PIECES):
            after = F @ error + G @ u
            total += 0.5 * float(error @ cost.M @ error + after @ cost.M @ after)
            error = after
        x = error + reference
    return total


def controllers(ledger: Ledger, count: int) -> Iterator[Table]:
    """Random dynamic scenarios, every controller on the two plants where control matters."""
    table = _table(f"{count} random dynamic scenarios: plant, controller")
    for plant in PLANTS:
        for controller in ("q-learning", "riccati", *BASELINES):
            limit = SHORT if controller in BASELINES else 120.0

            def make(seed: int, p: str = plant, c: str = controller, t: float = limit) -> list:
                return run(load(random_scenario(seed, p, time_limit=t)), c, seed)

            robots = _runs(ledger, f"random {plant} {controller}", make, count)
            _row(table, f"{plant}, {controller}", robots)
    yield table


def improvements(ledger: Ledger, count: int) -> Iterator[Table]:
    """The paper's rules and ours, the learned controller, the same scenarios."""
    table = _table(f"{count} random dynamic scenarios, springless rover, q-learning: rules")
    for name, rules in RULES.items():

        def make(seed: int, rules: Rules = rules) -> list[Navigation]:
            return run(load(random_scenario(seed)), "q-learning", seed, rules)

        label = "random springless-rover q-learning" + ("" if rules is FLOWING else f" {name}")
        _row(table, name, _runs(ledger, label, make, count))
    yield table


def crowds(ledger: Ledger, count: int) -> Iterator[Table]:
    """Discs that walk straight on."""
    table = _table(f"{count} random crowds of 24 discs: plant, controller")
    for controller in ("q-learning", "riccati"):

        def make(seed: int, controller: str = controller) -> list[Navigation]:
            return run(load(random_crowd(seed)), controller, seed)

        robots = _runs(ledger, f"crowd {controller}", make, count)
        _row(table, f"double-integrator, {controller}", robots)
    yield table


def teams(ledger: Ledger, count: int) -> Iterator[Table]:
    """Several robots that cross a circle, 20 m wide, among six obstacles."""
    table = _table("robots that see one another: how many, seeds")
    for robots, seeds in _shares(count):

        def make(seed: int, robots: int = robots) -> list[Navigation]:
            return run(load(random_team(seed, robots)), "q-learning", seed)

        _row(table, f"{robots} robots, {seeds} runs", _runs(ledger, f"team {robots}", make, seeds))
    yield table


def figure_2(ledger: Ledger, count: int) -> Iterator[Table]:  # noqa: ARG001
    """The paper's setting: eq. (26) as simulated there, and robots where control matters.

    The optimum is the shortest way past all of the obstacles, with the margin that ours keep.
    """
    tables = read_toml(shipped_scenarios()["figure-2"])
    whole = Scenario.from_dict(tables)
    robot = whole.robots[0]
    padding = robot.radius + NavigatorSettings().margin
    best, _ = shortest_way(
        [v.solid for v in whole.visitors],
        robot.start,
        robot.goal,
        padding,
        bounds=(whole.lower, whole.upper),
    )
    optimum = best / float(np.linalg.norm(robot.goal - robot.start))
    table = _table(
        "the paper's setting (figure-2.toml): plant, controller, rules; "
        f"the final map's optimum is {optimum:.3f} of the straight line"
    )
    cases = [
        (plant, controller, rules)
        for plant in ("rover", "rover-physical", "springless-rover")
        for controller in ("q-learning", "riccati", "open-loop", "paper-repaired")
        for rules in ("paper", "flowing")
        if rules == "paper" or controller in FORESEEING
    ]
    for plant, controller, rules in cases:
        limit = 120.0 if controller in FORESEEING else 60.0
        own = Scenario.from_dict(tables | {"plant": plant, "time_limit": limit})

        def make(seed: int, s: Scenario = own, c: str = controller, r: str = rules) -> list:
            return run(s, c, seed, RULES[r])

        label = f"{plant}, {controller}, {rules}"
        _row(table, label, _runs(ledger, f"figure-2 {label}", make, 1))
    yield table


def _shares(count: int) -> list[tuple[int, int]]:
    """How many seeds each team size gets of `count`."""
    sizes = (2, 4, 6, 8)
    return [(size, len(range(k, count, len(sizes)))) for k, size in enumerate(sizes)]


def _runs(
    ledger: Ledger, name: str, make: Callable[[int], list[Navigation]], count: int
) -> list[dict[str, Any]]:
    robots = []
    for seed in range(count):
        robots += ledger.get(f"{name} {seed}", lambda seed=seed: make(seed))
    return robots


def _table(title: str) -> Table:
    table = Table(title=title)
    table.add_column("case")
    for column in (
        "robots",
        "reached",
        "collided",
        "time, s",
        "way/straight",
        "clearance least / median, m",
        "D_kin, m",
        "latency ms 50 / 99 % / worst",
        "missed",
        "cost excess, worst",
    ):
        table.add_column(column, justify="right")
    return table


def failures(ledger: Ledger) -> Table:
    """Every robot of the ledger that could forecast, drove by our rules and did not arrive."""
    table = Table(title="failures under our rules")
    table.add_column("run")
    table.add_column("cause")
    for name, robots in ledger.runs.items():
        for number, robot in enumerate(robots):
            if robot["end"] and not any(b in name for b in (*BASELINES, "paper", "foretold")):
                table.add_row(f"{name}, robot {number}", robot["end"])
    return table


def _row(table: Table, label: str, robots: Sequence[dict[str, Any]]) -> None:
    done = [r for r in robots if r["reached"]]
    clear = [r["clearance"] for r in robots if r["clearance"] is not None]
    excess = [r["excess"] for r in robots if r["excess"] is not None]
    latency = np.array([r["latencies"] for r in robots])
    missed, samples = sum(r["missed"] for r in robots), sum(r["samples"] for r in robots)

    def mean(key: str) -> str:
        return f"{np.mean([r[key] for r in done]):.2f}" if done else "-"

    table.add_row(
        label,
        str(len(robots)),
        str(len(done)),
        str(sum(r["collided"] for r in robots)),
        mean("duration"),
        mean("detour"),
        f"{min(clear):.3f} / {np.median(clear):.3f}" if clear else "-",
        mean("deviation"),
        f"{np.median(latency[:, 0]) * 1e3:.1f} / {np.median(latency[:, 1]) * 1e3:.1f} / "
        f"{latency[:, 2].max() * 1e3:.0f}",
        f"{missed} of {samples}",
        f"{max(excess):.1e}" if excess else "-",
    )


PARTS: dict[str, tuple[Callable[[Ledger, int], Iterator[Table]], int]] = {
    "figure-2": (figure_2, 1),
    "controllers": (controllers, 100),
    "improvements": (improvements, 100),
    "crowds": (crowds, 50),
    "teams": (teams, 50),
}
"""What is measured, and over how many scenarios."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=[*PARTS, "all"])
    parser.add_argument("--scenarios", type=int, help="instead of each part's own number")
    parser.add_argument("--keep", type=Path, help="file of runs, made if it does not exist")
    arguments = parser.parse_args()
    ledger = Ledger(arguments.keep)
    console = Console(width=190)
    for name in PARTS if arguments.part == "all" else [arguments.part]:
        part, count = PARTS[name]
        count = count if arguments.scenarios is None else arguments.scenarios
        for table in part(ledger, count):
            console.print(table)
    console.print(failures(ledger))


if __name__ == "__main__":
    main()
