"""The scenario file: robots, an arena and obstacles that come and go, in TOML, read strictly."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.query_file import read_toml
from sims.navigation.scenario_parts import (
    WEIGHTS,
    Robot,
    Visitor,
    gap,
    read_robot,
    read_visitor,
)
from sims.toml_tables import (
    number_of,
    numbers_of,
    positive,
    refuse_unknown,
    table_of,
    tables_of,
)

Array = NDArray[np.float64]

ARENA_HALF = 20.0
OPTIONS = {
    "perception_radius": 8.0,
    "admissible_window": 0.15,
    "goal_tolerance": 0.25,
    "horizon": 10.0,
    "sample_period": 0.05,
    "time_limit": 120.0,
    "appearance_distance": 0.0,
}
"""Numbers of a scenario and their defaults: the paper's, where it gives one."""
TOP = {"plant", "start", "goal", "robot_radius", "arena", "weights", "obstacle", "robot", *OPTIONS}
ROBOT = {"plant", "start", "goal", "robot_radius"}


@dataclass(frozen=True, eq=False)
class Scenario:
    """Robots in an arena whose obstacles come and go.

    Attributes:
        robots: at least one; the first is the file's own.
        lower, upper: `[d]`, the arena: where is planned. Its boundary is no wall.
        visitors: the obstacles.
        perception_radius: metres; an obstacle is known once some part of it is within.
        admissible_window: rho of the paper, for waypoints.
        goal_tolerance: metres, for the goal.
        horizon: T of the paper, seconds.
        sample_period: Delta t of the paper, seconds.
        time_limit: seconds after which a robot has failed.
        appearance_distance: metres; an obstacle that is due keeps away until every robot is so far
            and its stopping distance away. At 0 it appears when it is due, wherever the robots are.
    """

    robots: tuple[Robot, ...]
    lower: Array
    upper: Array
    visitors: tuple[Visitor, ...] = ()
    perception_radius: float = OPTIONS["perception_radius"]
    admissible_window: float = OPTIONS["admissible_window"]
    goal_tolerance: float = OPTIONS["goal_tolerance"]
    horizon: float = OPTIONS["horizon"]
    sample_period: float = OPTIONS["sample_period"]
    time_limit: float = OPTIONS["time_limit"]
    appearance_distance: float = field(default=0.0)

    def __post_init__(self) -> None:
        for name in ("perception_radius", "goal_tolerance", "horizon", "sample_period"):
            positive(getattr(self, name), name)
        positive(self.time_limit, "time_limit")
        if not 0 < self.admissible_window < 1:
            raise ValueError(
                f"admissible_window: must lie between 0 and 1, got {self.admissible_window:g}"
            )
        if not (math.isfinite(self.appearance_distance) and self.appearance_distance >= 0):
            raise ValueError(
                "appearance_distance: must be non-negative and finite, "
                f"got {self.appearance_distance:g}"
            )
        if self.sample_period > self.horizon:
            raise ValueError(
                f"sample_period: must not exceed the horizon {self.horizon:g} s, "
                f"got {self.sample_period:g} s"
            )
        present = [
            v.solid for v in self.visitors if v.appears <= 0 and not self.appearance_distance
        ]
        for number, robot in enumerate(self.robots):
            prefix = "" if number == 0 else f"robot {number}."
            for name in ("start", "goal"):
                point = getattr(robot, name)
                if not ((point >= self.lower) & (point <= self.upper)).all():
                    raise ValueError(
                        f"{prefix}{name}: must lie in the arena, between {self.lower.tolist()} and "
                        f"{self.upper.tolist()}, got {point.tolist()}"
                    )
            for solid in present:
                if gap(solid, robot.start) <= robot.radius:
                    raise ValueError(
                        f"{prefix}start: {robot.start.tolist()} touches an obstacle that is there "
                        "from the beginning"
                    )
            for other in self.robots[:number]:
                if np.linalg.norm(robot.start - other.start) <= robot.radius + other.radius:
                    raise ValueError(
                        f"{prefix}start: {robot.start.tolist()} touches another robot's start"
                    )

    @property
    def dimension(self) -> int:
        return len(self.lower)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Scenario":
        """The scenario of a TOML file.

        Raises:
            ValueError: naming what is missing, unknown or wrong.
            OSError: if the file cannot be read.
        """
        return cls.from_dict(read_toml(path))

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> "Scenario":
        """The scenario of a file's tables; unknown keys are refused."""
        refuse_unknown(table, "", TOP)
        for key in ("plant", "start", "goal"):
            if key not in table:
                raise ValueError(f"{key}: missing")
        options = {k: number_of(table[k], k) for k in OPTIONS if k in table}
        horizon = positive(options.get("horizon", OPTIONS["horizon"]), "horizon")
        weights = table_of(table.get("weights", {}), "weights", set(WEIGHTS))
        first = read_robot(table, "", table["plant"], 0.0, weights, horizon)
        d = len(first.start)
        lower, upper = _arena(table.get("arena", {}), d)
        others = [
            read_robot(
                table_of(entry, f"robot {k}", ROBOT),
                f"robot {k}.",
                table["plant"],
                first.radius,
                weights,
                horizon,
            )
            for k, entry in enumerate(tables_of(table, "robot"), 1)
        ]
        for k, robot in enumerate(others, 1):
            if len(robot.start) != d:
                raise ValueError(f"robot {k}.start: must have {d} coordinates like start")
        visitors = tuple(
            read_visitor(table_of(entry, f"obstacle {k}", None), f"obstacle {k}", d)
            for k, entry in enumerate(tables_of(table, "obstacle"), 1)
        )
        return cls((first, *others), lower, upper, visitors, **options)


def shipped_scenarios() -> dict[str, Path]:
    """The scenario files that come with the package, by name."""
    folder = Path(str(resources.files("sims"))) / "scenarios"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _arena(value: Any, d: int) -> tuple[Array, Array]:
    table = table_of(value, "arena", {"lower", "upper"})
    corners = {"lower": np.full(d, -ARENA_HALF), "upper": np.full(d, ARENA_HALF)}
    for key in table:
        corners[key] = numbers_of(table[key], f"arena.{key}")
        if len(corners[key]) != d:
            raise ValueError(
                f"arena.{key}: must have {d} coordinates like start, got {corners[key].tolist()}"
            )
    if not (corners["upper"] > corners["lower"]).all():
        raise ValueError(
            f"arena.upper: must exceed lower, got {corners['upper'].tolist()} over "
            f"{corners['lower'].tolist()}"
        )
    return corners["lower"], corners["upper"]
