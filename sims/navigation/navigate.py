"""`zermelo navigate`: robots of unknown dynamics cross a changing world, in Drake's Simulator."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planners.navigation_settings import FLOWING, PAPER, NavigatorSettings, Rules
from planners.orders import Phase
from planners.rrt_qx import Navigator
from planners.update import Cause
from sims.navigation.controllers import (
    CONTROLLERS,
    Driver,
    ExactController,
    make_controller,
)
from sims.navigation.record import Moment, Recorder
from sims.navigation.scenario_file import Scenario
from sims.navigation.scenario_parts import Robot

Array = NDArray[np.float64]

FORESEEING = ("q-learning", "riccati")
"""Controllers that can forecast: they drive by our rules, the others by the paper's."""
EVERY = 0.25
"""Seconds between the moments that pictures are made of."""
BRAKES = np.linspace(-0.5, 2.0, 26)
NODES = {2: 2000, 3: 3000}
CAUSES = {
    Cause.APPEARANCE: "obstacle appeared",
    Cause.DISAPPEARANCE: "obstacle vanished",
    Cause.MOVEMENT: "obstacle moved",
    Cause.PADDING: "padding changed",
}


@dataclass(frozen=True, eq=False)
class Navigation:
    """One robot's run.

    Attributes:
        robot: whose.
        controller: its name.
        driver: the controller itself, as the run left it.
        navigator: likewise.
        times: `[k]`, every sample.
        states: `[k, n]`.
        references: `[k, n]`.
        inputs: `[k, m]`.
        latencies: `[k]`, wall-clock seconds of planner and controller in each sample.
        phases: `[k]`, what the robot was doing.
        legs: `[k]`, the number of the leg.
        fine_times, track, clearances: `[j]`, `[j, d]`, `[j]` at every integration step.
        reached, collided, lost: what became of it; lost is who left the arena for good.
        duration: seconds until it arrived, or until the run ended.
        sample_period: seconds.
        wall_seconds: of the whole simulation, all robots.
        moments: what the robot knew and planned every `EVERY` seconds, if that was recorded.
    """

    robot: Robot
    controller: str
    driver: Driver
    navigator: Navigator
    times: Array
    states: Array
    references: Array
    inputs: Array
    latencies: Array
    phases: list[Phase]
    legs: list[int]
    fine_times: Array
    track: Array
    clearances: Array
    reached: bool
    collided: bool
    lost: bool
    duration: float
    sample_period: float
    wall_seconds: float
    moments: list[Moment]

    @property
    def length(self) -> float:
        """Metres gone."""
        return float(np.linalg.norm(np.diff(self.track, axis=0), axis=1).sum())

    @property
    def min_clearance(self) -> float | None:
        """Metres between the body and an obstacle, at least; `None` if there never was one."""
        least = float(self.clearances.min())
        return least if np.isfinite(least) else None

    @property
    def failure(self) -> str:
        """Why it did not arrive; empty if it did."""
        if self.reached:
            return ""
        if self.collided:
            return "collided"
        if self.lost:
            return "left the arena for good"
        return self.navigator.reason or f"was still {self.navigator.phase.value}"

    @property
    def missed(self) -> int:
        """Samples in which planner and controller took longer than the sample period."""
        return int((self.latencies > self.sample_period).sum())

    def report(self) -> dict[str, Any]:
        """The JSON document of one robot."""
        replans = [
            {
                "time_s": replan.time,
                "cause": ", ".join(CAUSES[c] for c in replan.causes if c in CAUSES),
                "latency_s": replan.seconds,
                "nodes": replan.repaired,
            }
            for replan in self.navigator.replans
        ]
        return {
            "reached": self.reached,
            "collided": self.collided,
            "duration_s": self.duration,
            "length_m": self.length,
            "min_clearance_m": self.min_clearance,
            "max_deviation_m": self.navigator.largest_deviation,
            "replans": replans,
            "legs": self.navigator.legs,
            "missed_deadlines": self.missed,
        }


def navigate(
    scenario_file: str | os.PathLike[str], controller: str = "q-learning", seed: int = 0
) -> dict[str, Any]:
    """Run a scenario file; returns the JSON document of `zermelo navigate`.

    Raises:
        ValueError: if the file or the controller's name is wrong.
        OSError: if the file cannot be read.
    """
    return document(run(Scenario.load(scenario_file), controller, seed))


def document(runs: list[Navigation]) -> dict[str, Any]:
    """The JSON document: of the only robot, or of all together with each under `robots`."""
    reports = [r.report() for r in runs]
    if len(reports) == 1:
        return reports[0]
    clearances = [r["min_clearance_m"] for r in reports if r["min_clearance_m"] is not None]
    return {
        "reached": all(r["reached"] for r in reports),
        "collided": any(r["collided"] for r in reports),
        "duration_s": max(r["duration_s"] for r in reports),
        "length_m": sum(r["length_m"] for r in reports),
        "min_clearance_m": min(clearances, default=None),
        "max_deviation_m": max(r["max_deviation_m"] for r in reports),
        "replans": sorted((e for r in reports for e in r["replans"]), key=lambda e: e["time_s"]),
        "legs": sum(r["legs"] for r in reports),
        "missed_deadlines": sum(r["missed_deadlines"] for r in reports),
        "robots": reports,
    }


def run(
    scenario: Scenario,
    controller: str = "q-learning",
    seed: int = 0,
    rules: Rules | None = None,
    record: bool = False,
    **settings: Any,
) -> list[Navigation]:
    """Run a scenario; one `Navigation` a robot.

    Args:
        scenario: what to run.
        controller: one of `CONTROLLERS`, for every robot.
        seed: of the planner's samples and of the learner's probing.
        rules: which of the paper's rules are kept; by default ours for controllers that can
            forecast, the paper's for the others.
        record: keep moments for pictures.
        **settings: of `NavigatorSettings`.

    Raises:
        ValueError: if the controller is unknown, or the rules need one that can forecast.
    """
    if controller not in CONTROLLERS:
        raise ValueError(f"controller: must be one of {', '.join(CONTROLLERS)}, got {controller!r}")
    foreseeing = controller in FORESEEING
    rules = (FLOWING if foreseeing else PAPER) if rules is None else rules
    if rules.foretell and not foreseeing:
        raise ValueError(
            f"rules: {rules.padding.value!r} is not for {controller}, which cannot forecast"
        )
    from sims.navigation.diagram import drive

    navigators, drivers, stopping = [], [], []
    for number, robot in enumerate(scenario.robots):
        source = np.random.SeedSequence([seed, number])
        rng = np.random.default_rng(source)
        start = robot.at_rest(robot.start)
        driver = make_controller(
            controller, robot.plant, robot.cost, scenario.sample_period, start, rng
        )
        own = NavigatorSettings(
            sample_period=scenario.sample_period,
            horizon=scenario.horizon,
            admissible_window=scenario.admissible_window,
            goal_tolerance=scenario.goal_tolerance,
            perception_radius=scenario.perception_radius,
            robot_radius=robot.radius,
            rules=rules,
            **({"nodes": NODES[scenario.dimension]} | settings),
        )
        navigators.append(
            Navigator(scenario.lower, scenario.upper, start, robot.goal, driver, own, seed)
        )
        drivers.append(driver)
        stopping.append(stopping_time(robot, scenario.sample_period))
    recorders = [Recorder(EVERY) if record else None for _ in navigators]
    driven = drive(scenario, navigators, drivers, np.array(stopping), recorders)
    judge = driven.judge
    fine, track = np.array(judge.times), np.array(judge.positions)
    clearances = np.array(judge.clearances)
    runs = []
    for number, robot in enumerate(scenario.robots):
        kept = recorders[number]
        samples, navigator = driven.samples[number], navigators[number]
        reached = navigator.phase is Phase.ARRIVED and number not in judge.hit
        arrivals = [s.time for s in samples if s.order.phase is Phase.ARRIVED]
        runs.append(
            Navigation(
                robot,
                controller,
                drivers[number],
                navigator,
                np.array([s.time for s in samples]),
                np.array([s.state for s in samples]),
                np.array([s.order.reference for s in samples]),
                np.array([s.input for s in samples]),
                np.array([s.seconds for s in samples]),
                [s.order.phase for s in samples],
                [s.order.leg for s in samples],
                fine,
                track[:, number],
                clearances[:, number],
                reached,
                number in judge.hit,
                number in judge.lost,
                arrivals[0] if reached else float(fine[-1]),
                scenario.sample_period,
                driven.wall_seconds,
                kept.moments if kept is not None else [],
            )
        )
    return runs


def stopping_time(robot: Robot, period: float) -> float:
    """Stopping distance over speed, seconds: how far the exact regulator goes on when it brakes.

    It brakes to the point straight ahead from which the farthest point of its way is nearest.
    """
    exact = ExactController(robot.plant, robot.cost, period)
    d = robot.plant.dimension
    worst = 0.0
    for axis in range(d):
        errors = np.zeros((len(BRAKES), robot.plant.n))
        errors[:, axis] = -BRAKES
        if robot.plant.n >= 2 * d:
            errors[:, d + axis] = 1.0
        ways = exact.forecast(errors, True)
        assert ways is not None
        offset = np.zeros((len(BRAKES), 1, d))
        offset[:, 0, axis] = BRAKES
        farthest = np.linalg.norm(ways + offset, axis=-1).max(axis=1)
        worst = max(worst, float(farthest.min()))
    return worst
