"""The scenario file: robots, an arena and obstacles that come and go, in TOML, read strictly."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.query_file import read_toml
from planners.solids import Shape, Solid
from sims.navigation.plants import PLANTS, Plant
from sims.regulation.system_file import need_controllable

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
WEIGHTS = {"M": 10.0, "R": 2.0, "terminal": 0.5}


@dataclass(frozen=True, eq=False)
class Visitor:
    """An obstacle, and when it is there.

    Attributes:
        solid: where it is when it appears.
        appears, vanishes: seconds.
        velocity: `[d]`, metres a second, from when it appears.
    """

    solid: Solid
    appears: float
    vanishes: float
    velocity: Array

    @cached_property
    def moves(self) -> bool:
        return bool(np.any(self.velocity != 0))


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot of a scenario.

    Attributes:
        plant: what it is; it does not know.
        start, goal: `[d]`, metres; it begins and is to end at rest.
        radius: metres, of its body.
        cost: what its legs minimise.
    """

    plant: Plant
    start: Array
    goal: Array
    radius: float
    cost: QuadraticCost

    def at_rest(self, position: Array) -> Array:
        """The state `[n]` at rest at `position` `[d]`."""
        return np.concatenate([position, np.zeros(self.plant.n - len(position))])


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
            _positive(getattr(self, name), name)
        _positive(self.time_limit, "time_limit")
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
        _only(table, "", TOP)
        for key in ("plant", "start", "goal"):
            if key not in table:
                raise ValueError(f"{key}: missing")
        options = {k: _number(table[k], k) for k in OPTIONS if k in table}
        horizon = _positive(options.get("horizon", OPTIONS["horizon"]), "horizon")
        weights = _table(table.get("weights", {}), "weights", set(WEIGHTS))
        first = _robot(table, "", table["plant"], 0.0, weights, horizon)
        d = len(first.start)
        lower, upper = _arena(table.get("arena", {}), d)
        others = [
            _robot(
                _table(entry, f"robot {k}", ROBOT),
                f"robot {k}.",
                table["plant"],
                first.radius,
                weights,
                horizon,
            )
            for k, entry in enumerate(_tables(table, "robot"), 1)
        ]
        for k, robot in enumerate(others, 1):
            if len(robot.start) != d:
                raise ValueError(f"robot {k}.start: must have {d} coordinates like start")
        visitors = tuple(
            _visitor(_table(entry, f"obstacle {k}", None), f"obstacle {k}", d)
            for k, entry in enumerate(_tables(table, "obstacle"), 1)
        )
        return cls((first, *others), lower, upper, visitors, **options)


def shipped_scenarios() -> dict[str, Path]:
    """The scenario files that come with the package, by name."""
    folder = Path(str(resources.files("sims"))) / "scenarios"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def gap(solid: Solid, point: Array) -> float:
    """Metres between a solid and `point` `[d]`; at most 0 inside, a lower bound in space."""
    if solid.shape is Shape.BALL:
        return float(np.linalg.norm(point - solid.center)) - solid.radius
    outside = solid.facets[:, :-1] @ point + solid.facets[:, -1]
    if outside.max() <= 0 or solid.dimension == 3:
        return float(outside.max())
    a, b = solid.sides[:, 0], solid.sides[:, 1]
    along = b - a
    t = np.clip(((point - a) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(a + t[:, None] * along - point, axis=1).min())


def _robot(
    table: Mapping[str, Any],
    prefix: str,
    plant_by_default: Any,
    radius: float,
    weights: Mapping[str, Any],
    horizon: float,
) -> Robot:
    for key in ("start", "goal"):
        if key not in table:
            raise ValueError(f"{prefix}{key}: missing")
    start = _numbers(table["start"], f"{prefix}start")
    plant = _plant(table.get("plant", plant_by_default), f"{prefix}plant", len(start))
    goal = _numbers(table["goal"], f"{prefix}goal")
    for name, point in (("start", start), ("goal", goal)):
        if len(point) != plant.dimension:
            raise ValueError(
                f"{prefix}{name}: must have {plant.dimension} coordinates for {plant.name}, "
                f"got {point.tolist()}"
            )
    own = _number(table.get("robot_radius", radius), f"{prefix}robot_radius")
    if not own >= 0:
        raise ValueError(f"{prefix}robot_radius: must be at least 0, got {own:g}")
    return Robot(plant, start, goal, own, _cost(weights, plant, horizon))


def _plant(value: Any, name: str, d: int) -> Plant:
    if isinstance(value, str):
        if value not in PLANTS:
            raise ValueError(
                f"{name}: {value!r} is unknown; known are {', '.join(PLANTS)}, or a table with A, B"
            )
        return PLANTS[value]()
    table = _table(value, name, {"A", "B", "anchored", "probing", "behaviour_gain"})
    for key in ("A", "B"):
        if key not in table:
            raise ValueError(f"{name}.{key}: missing")
    A, B = _rows(table["A"], f"{name}.A"), _rows(table["B"], f"{name}.B")
    n, m = len(A), B.shape[1]
    if A.shape != (n, n):
        raise ValueError(f"{name}.A: must be square, got {A.shape[0]} x {A.shape[1]}")
    if len(B) != n:
        raise ValueError(f"{name}.B: must have {n} rows like A, got {len(B)}")
    if d not in (2, 3) or n < d:
        raise ValueError(
            f"{name}.A: the first states are the position, as start has them ({d}); got {n} states"
        )
    anchored = table.get("anchored", False)
    if not isinstance(anchored, bool):
        raise ValueError(f"{name}.anchored: must be true or false, got {anchored!r}")
    probing = _positive(_number(table.get("probing", 2.0), f"{name}.probing"), f"{name}.probing")
    gain = np.zeros((m, n))
    if "behaviour_gain" in table:
        gain = _rows(table["behaviour_gain"], f"{name}.behaviour_gain")
        if gain.shape != (m, n):
            raise ValueError(f"{name}.behaviour_gain: must be {m} rows of {n} numbers")
    try:
        need_controllable(A, B)
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from error
    plant = Plant("system", A, B, d, anchored, probing, gain)
    if not anchored:
        # Every place must be one where the robot can stand still.
        rest = np.vstack([np.eye(d), np.zeros((n - d, d))])
        left = A @ rest + B @ np.linalg.lstsq(B, -A @ rest, rcond=None)[0]
        if np.abs(left).max() > 1e-9 * max(1.0, np.abs(A).max()):
            raise ValueError(
                f"{name}.A: no input holds this robot at rest away from the origin; "
                "with anchored = true it is simulated in error coordinates"
            )
    return plant


def _cost(weights: Mapping[str, Any], plant: Plant, horizon: float) -> QuadraticCost:
    matrices = {}
    for key, default in WEIGHTS.items():
        size = plant.m if key == "R" else plant.n
        matrices[key] = default * np.eye(size)
        if key in weights:
            matrices[key] = _rows(weights[key], f"weights.{key}")
            if matrices[key].shape != (size, size):
                raise ValueError(
                    f"weights.{key}: must be {size} x {size} for {plant.name}, "
                    f"got {len(matrices[key])} x {matrices[key].shape[1]}"
                )
    try:
        return QuadraticCost(matrices["M"], matrices["R"], matrices["terminal"], horizon)
    except ValueError as error:
        raise ValueError(f"weights.{error}") from error


def _arena(value: Any, d: int) -> tuple[Array, Array]:
    table = _table(value, "arena", {"lower", "upper"})
    corners = {"lower": np.full(d, -ARENA_HALF), "upper": np.full(d, ARENA_HALF)}
    for key in table:
        corners[key] = _numbers(table[key], f"arena.{key}")
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


def _visitor(table: Mapping[str, Any], name: str, d: int) -> Visitor:
    timing = {"appears", "vanishes", "velocity"}
    forms = {
        frozenset({"vertices"}): "vertices",
        frozenset({"center", "radius"}): "ball",
        frozenset({"lower", "upper"}): "box",
    }
    shape = frozenset(table) - timing
    _only(table, f"{name}.", timing.union(*forms))
    if shape not in forms:
        raise ValueError(
            f"{name}: must have either vertices, or center and radius, or lower and upper, "
            f"got {', '.join(sorted(shape)) or 'none of them'}"
        )
    try:
        if forms[shape] == "vertices":
            vertices = _rows(table["vertices"], "vertices")
            solid = Solid.polygon(vertices) if d == 2 else Solid.hull(vertices)
        elif forms[shape] == "ball":
            solid = Solid.ball(
                _numbers(table["center"], "center"), _number(table["radius"], "radius")
            )
        else:
            solid = Solid.box(_numbers(table["lower"], "lower"), _numbers(table["upper"], "upper"))
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from error
    if solid.dimension != d:
        raise ValueError(f"{name}: must have {d} coordinates like start, got {solid.dimension}")
    appears = _number(table.get("appears", 0.0), f"{name}.appears")
    vanishes = _number(table.get("vanishes", math.inf), f"{name}.vanishes")
    if not 0 <= appears < math.inf:
        raise ValueError(f"{name}.appears: must be a time of at least 0 s, got {appears:g}")
    if not vanishes > appears:
        raise ValueError(f"{name}.vanishes: must be later than it appears, got {vanishes:g}")
    velocity = np.zeros(d)
    if "velocity" in table:
        velocity = _numbers(table["velocity"], f"{name}.velocity")
        if len(velocity) != d:
            raise ValueError(f"{name}.velocity: must have {d} coordinates, got {velocity.tolist()}")
    return Visitor(solid, appears, vanishes, velocity)


def _tables(table: Mapping[str, Any], key: str) -> list[Any]:
    entries = table.get(key, [])
    if not isinstance(entries, list):
        raise ValueError(f"{key}: must be an array of tables, [[{key}]]")
    return entries


def _only(table: Mapping[str, Any], prefix: str, known: set[str] | frozenset[str]) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{prefix}{key}: unknown; known are {', '.join(sorted(known))}")


def _table(value: Any, name: str, known: set[str] | None) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: must be a table, got {value!r}")
    if known is not None:
        _only(value, f"{name}.", known)
    return value


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise ValueError(f"{name}: must be a number, got {value!r}")
    return float(value)


def _positive(value: float, name: str) -> float:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: must be positive and finite, got {value:g}")
    return value


def _numbers(value: Any, name: str) -> Array:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name}: must be a list of numbers, got {value!r}")
    array = np.array([_number(v, name) for v in value])
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: numbers must be finite, got {value!r}")
    return array


def _rows(value: Any, name: str) -> Array:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name}: must be a list of rows of numbers, got {value!r}")
    rows = [_numbers(row, name) for row in value]
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"{name}: rows must be of equal length, got {value!r}")
    return np.array(rows)
