"""Random scenarios by seed: obstacles that appear, vanish and stand in the way; robots that cross.

Obstacles that appear during the run keep away from the robot until it is 3 m and its stopping
distance away (`appearance_distance`), and may then appear right there: in its way, as a rule, since
many of them are put beside the straight line to the goal.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planners.solids import Solid
from sims.navigation.scenario_file import Scenario
from sims.navigation.scenario_parts import gap

Array = NDArray[np.float64]

HALF = 20.0
START, GOAL = -15.0, 17.0
ROOM = 2.0
"""Metres that obstacles keep from the start, and from the goal."""
NEAREST = 3.0
"""Metres, beyond the stopping distance, at which obstacles may appear."""


def random_scenario(
    seed: int,
    plant: str = "springless-rover",
    standing: int = 10,
    appearing: int = 14,
    vanishing: float = 0.3,
    within: float = 14.0,
    robot_radius: float = 0.3,
    time_limit: float = 120.0,
) -> dict[str, Any]:
    """The tables of a scenario file: 40 m wide, across the diagonal as in the paper's Figure 2.

    Args:
        seed: equal seeds give equal scenarios.
        plant: of the robot, in the plane.
        standing: obstacles that are there from the beginning.
        appearing: obstacles that appear during the first `within` seconds.
        vanishing: the share of all that vanishes again, 4 to 12 seconds later.
        within: seconds.
        robot_radius: metres.
        time_limit: seconds.
    """
    rng = np.random.default_rng(seed)
    start, goal = np.full(2, START), np.full(2, GOAL)
    obstacles: list[dict[str, Any]] = []
    while len(obstacles) < standing + appearing:
        late = len(obstacles) >= standing
        if late and rng.random() < 0.7:
            along = start + rng.uniform(0.1, 0.92) * (goal - start)
            center = along + rng.normal(scale=2.0, size=2)
        else:
            center = rng.uniform(-0.9 * HALF, 0.9 * HALF, 2)
        table, solid = _shape(rng, center, rng.uniform(0.6, 1.2 if late else 2.4))
        keep = ROOM + robot_radius
        if min(gap(solid, start), gap(solid, goal)) < keep:
            continue
        if late:
            table["appears"] = round(float(rng.uniform(0.5, within)), 2)
        if rng.random() < vanishing:
            table["vanishes"] = round(table.get("appears", 0.0) + float(rng.uniform(4, 12)), 2)
        obstacles.append(table)
    return _scenario(plant, start, goal, robot_radius, time_limit) | {
        "appearance_distance": NEAREST,
        "obstacle": obstacles,
    }


def random_crowd(
    seed: int,
    plant: str = "double-integrator",
    walkers: int = 24,
    fastest: float = 1.2,
    robot_radius: float = 0.3,
) -> dict[str, Any]:
    """The tables of a scenario file with discs that walk straight on, 0.3 m/s to `fastest`."""
    rng = np.random.default_rng(seed)
    start, goal = np.full(2, START), np.full(2, GOAL)
    obstacles: list[dict[str, Any]] = []
    while len(obstacles) < walkers:
        center = rng.uniform(-0.95 * HALF, 0.95 * HALF, 2)
        radius = float(rng.uniform(0.3, 0.6))
        if np.linalg.norm(center - start) < 5.0 + radius:
            continue
        turn, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, fastest)
        velocity = speed * np.array([np.cos(turn), np.sin(turn)])
        obstacles.append(
            {
                "center": _rounded(center),
                "radius": round(radius, 3),
                "velocity": _rounded(velocity),
            }
        )
    return _scenario(plant, start, goal, robot_radius, 120.0) | {"obstacle": obstacles}


def random_team(
    seed: int,
    robots: int,
    plant: str = "springless-rover",
    standing: int = 6,
    half: float = 10.0,
    robot_radius: float = 0.3,
) -> dict[str, Any]:
    """The tables of a scenario file with robots that start on a circle and cross it.

    Each goes to about the opposite side, so that all meet in the middle, among a few obstacles.

    Args:
        seed: equal seeds give equal scenarios.
        robots: how many.
        plant: of every robot.
        standing: obstacles.
        half: half the side of the arena, metres.
        robot_radius: metres.
    """
    rng = np.random.default_rng(seed)
    ring = 0.85 * half
    turns = (np.arange(robots) + rng.uniform(-0.2, 0.2, robots)) * (2 * np.pi / robots)
    starts = ring * np.column_stack([np.cos(turns), np.sin(turns)])
    across = turns + np.pi + rng.uniform(-0.1, 0.1, robots) * (2 * np.pi / robots)
    goals = ring * np.column_stack([np.cos(across), np.sin(across)])
    obstacles: list[dict[str, Any]] = []
    while len(obstacles) < standing:
        center = rng.uniform(-0.7 * half, 0.7 * half, 2)
        table, solid = _shape(rng, center, rng.uniform(0.4, 1.0))
        if min(gap(solid, p) for p in (*starts, *goals)) >= 1.0 + robot_radius:
            obstacles.append(table)
    first = _scenario(plant, starts[0], goals[0], robot_radius, 90.0)
    first["arena"] = {"lower": [-half, -half], "upper": [half, half]}
    others = [
        {"start": _rounded(s), "goal": _rounded(g)}
        for s, g in zip(starts[1:], goals[1:], strict=True)
    ]
    return first | {"obstacle": obstacles, "robot": others}


def load(table: dict[str, Any]) -> Scenario:
    """The scenario of generated tables."""
    return Scenario.from_dict(table)


def _scenario(
    plant: str, start: Array, goal: Array, robot_radius: float, time_limit: float
) -> dict[str, Any]:
    return {
        "plant": plant,
        "start": _rounded(start),
        "goal": _rounded(goal),
        "robot_radius": robot_radius,
        "time_limit": time_limit,
        "arena": {"lower": [-HALF, -HALF], "upper": [HALF, HALF]},
    }


def _shape(rng: np.random.Generator, center: Array, size: float) -> tuple[dict[str, Any], Solid]:
    """A disc or a convex polygon whose farthest point is `size` from its centre."""
    if rng.random() < 0.35:
        table: dict[str, Any] = {"center": _rounded(center), "radius": round(float(size), 3)}
        return table, Solid.ball(table["center"], table["radius"])
    corners = int(rng.integers(3, 7))
    turns = (np.arange(corners) + rng.uniform(0.15, 0.85, corners)) * (2 * np.pi / corners)
    points = center + size * np.column_stack([np.cos(turns), np.sin(turns)])
    table = {"vertices": [_rounded(p) for p in points]}
    return table, Solid.polygon(table["vertices"])


def _rounded(point: Array) -> list[float]:
    return [round(float(v), 3) for v in point]
