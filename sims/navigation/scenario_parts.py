"""Robots and obstacles of a scenario: what they are, and how their tables are read."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.quadratic_cost import QuadraticCost
from planners.solids import Shape, Solid
from sims.navigation.plants import PLANTS, Plant
from sims.regulation.system_file import need_controllable
from sims.toml_tables import number_of, numbers_of, positive, refuse_unknown, rows_of, table_of

Array = NDArray[np.float64]

WEIGHTS = {"M": 10.0, "R": 2.0, "terminal": 0.5}
"""Of the cost: by default these multiples of the identity."""


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


def read_robot(
    table: Mapping[str, Any],
    prefix: str,
    plant_by_default: Any,
    radius: float,
    weights: Mapping[str, Any],
    horizon: float,
) -> Robot:
    """A robot of a file's table, every name in a refusal led by `prefix`.

    Args:
        table: the robot's own keys.
        prefix: such as `robot 1.`.
        plant_by_default: what it is, if its table does not say.
        radius: metres, if its table does not say.
        weights: of the cost.
        horizon: seconds.

    Raises:
        ValueError: naming what is missing or wrong.
    """
    for key in ("start", "goal"):
        if key not in table:
            raise ValueError(f"{prefix}{key}: missing")
    start = numbers_of(table["start"], f"{prefix}start")
    plant = _plant(table.get("plant", plant_by_default), f"{prefix}plant", len(start))
    goal = numbers_of(table["goal"], f"{prefix}goal")
    for name, point in (("start", start), ("goal", goal)):
        if len(point) != plant.dimension:
            raise ValueError(
                f"{prefix}{name}: must have {plant.dimension} coordinates for {plant.name}, "
                f"got {point.tolist()}"
            )
    own = number_of(table.get("robot_radius", radius), f"{prefix}robot_radius")
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
    table = table_of(value, name, {"A", "B", "anchored", "probing", "behaviour_gain"})
    for key in ("A", "B"):
        if key not in table:
            raise ValueError(f"{name}.{key}: missing")
    A, B = rows_of(table["A"], f"{name}.A"), rows_of(table["B"], f"{name}.B")
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
    probing = positive(number_of(table.get("probing", 2.0), f"{name}.probing"), f"{name}.probing")
    gain = np.zeros((m, n))
    if "behaviour_gain" in table:
        gain = rows_of(table["behaviour_gain"], f"{name}.behaviour_gain")
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
            matrices[key] = rows_of(weights[key], f"weights.{key}")
            if matrices[key].shape != (size, size):
                raise ValueError(
                    f"weights.{key}: must be {size} x {size} for {plant.name}, "
                    f"got {len(matrices[key])} x {matrices[key].shape[1]}"
                )
    try:
        return QuadraticCost(matrices["M"], matrices["R"], matrices["terminal"], horizon)
    except ValueError as error:
        raise ValueError(f"weights.{error}") from error


def read_visitor(table: Mapping[str, Any], name: str, d: int) -> Visitor:
    """An obstacle of a file's table in `d` dimensions; unknown keys are refused.

    Raises:
        ValueError: naming what is missing, unknown or wrong.
    """
    timing = {"appears", "vanishes", "velocity"}
    forms = {
        frozenset({"vertices"}): "vertices",
        frozenset({"center", "radius"}): "ball",
        frozenset({"lower", "upper"}): "box",
    }
    shape = frozenset(table) - timing
    refuse_unknown(table, f"{name}.", timing.union(*forms))
    if shape not in forms:
        raise ValueError(
            f"{name}: must have either vertices, or center and radius, or lower and upper, "
            f"got {', '.join(sorted(shape)) or 'none of them'}"
        )
    try:
        if forms[shape] == "vertices":
            vertices = rows_of(table["vertices"], "vertices")
            solid = Solid.polygon(vertices) if d == 2 else Solid.hull(vertices)
        elif forms[shape] == "ball":
            solid = Solid.ball(
                numbers_of(table["center"], "center"), number_of(table["radius"], "radius")
            )
        else:
            solid = Solid.box(
                numbers_of(table["lower"], "lower"), numbers_of(table["upper"], "upper")
            )
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from error
    if solid.dimension != d:
        raise ValueError(f"{name}: must have {d} coordinates like start, got {solid.dimension}")
    appears = number_of(table.get("appears", 0.0), f"{name}.appears")
    vanishes = number_of(table.get("vanishes", math.inf), f"{name}.vanishes")
    if not 0 <= appears < math.inf:
        raise ValueError(f"{name}.appears: must be a time of at least 0 s, got {appears:g}")
    if not vanishes > appears:
        raise ValueError(f"{name}.vanishes: must be later than it appears, got {vanishes:g}")
    velocity = np.zeros(d)
    if "velocity" in table:
        velocity = numbers_of(table["velocity"], f"{name}.velocity")
        if len(velocity) != d:
            raise ValueError(f"{name}.velocity: must have {d} coordinates, got {velocity.tolist()}")
    return Visitor(solid, appears, vanishes, velocity)
