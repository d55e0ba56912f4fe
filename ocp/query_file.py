"""The query file: a query's tables in TOML, read strictly and written back."""

import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from ocp.cost import RunningCost
from ocp.obstacle import Obstacle
from ocp.query import Equilibrium, Goal, ModelFile, Query
from ocp.system import System


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        ValueError: if the file is no TOML.
        OSError: if it cannot be read.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error


def query_from_dict(table: Mapping[str, Any], folder: str | os.PathLike[str] = ".") -> Query:
    """A query from the tables of a query file in `folder`; unknown keys are refused."""
    _only(table, "", {"model", "goal", "obstacle", "cost", "input", "robot"})
    for required in ("model", "goal"):
        if required not in table:
            raise ValueError(f"{required}: missing")
    model = table["model"]
    if not isinstance(model, str):
        raise ValueError(f"model: must be a name, got {model!r}")
    goal = _goal(table["goal"])
    obstacles = table.get("obstacle", [])
    if not isinstance(obstacles, list):
        raise ValueError("obstacle: must be an array of tables, [[obstacle]]")
    limits = _table(table.get("input", {}), "input", {"lower", "upper"})
    robot = _table(table.get("robot", {}), "robot", {"radius"})
    return Query(
        model=ModelFile(model, os.fspath(folder)) if _is_file(model) else model,
        goal=goal,
        obstacles=tuple(_obstacle(o, f"obstacle {k}") for k, o in enumerate(obstacles, 1)),
        cost=_cost(table.get("cost", {}), isinstance(goal, Equilibrium)),
        input_lower=_numbers(limits["lower"], "input.lower") if "lower" in limits else None,
        input_upper=_numbers(limits["upper"], "input.upper") if "upper" in limits else None,
        robot_radius=_number(robot.get("radius", 0.0), "robot.radius"),
    )


def query_to_dict(query: Query) -> dict[str, Any]:
    """The tables of the query file; `query_from_dict` of them gives an equal query.

    Raises:
        ValueError: if the model is a `System` of one's own.
    """
    if isinstance(query.model, System):
        raise ValueError(f"model: {query.model.name!r} is not a registered name, no file holds it")
    if query.cost.own:
        raise ValueError("cost.own: a function of one's own, no file holds it")
    if isinstance(query.goal, Equilibrium):
        place, defaults = {"state": list(query.goal.state)}, {"goal": 0.0}
    else:
        place, defaults = {"center": list(query.goal.center)}, {}
    table: dict[str, Any] = {
        "model": query.model.name if isinstance(query.model, ModelFile) else query.model,
        "goal": {**place, "radius": query.goal.radius},
    }
    if query.obstacles:
        table["obstacle"] = [_obstacle_table(o) for o in query.obstacles]
    weights = {
        f.name: _plain(value)
        for f in fields(RunningCost)
        if (value := getattr(query.cost, f.name)) != defaults.get(f.name, f.default)
    }
    if weights:
        table["cost"] = weights
    bounds = {"lower": query.input_lower, "upper": query.input_upper}
    if any(b is not None for b in bounds.values()):
        table["input"] = {k: list(b) for k, b in bounds.items() if b is not None}
    if query.robot_radius:
        table["robot"] = {"radius": query.robot_radius}
    return table


def _only(table: Mapping[str, Any], prefix: str, known: set[str]) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{prefix}{key}: unknown; known are {', '.join(sorted(known))}")


def _table(value: Any, name: str, known: set[str]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: must be a table, got {value!r}")
    _only(value, f"{name}.", known)
    return value


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{name}: must be a number, got {value!r}")
    if math.isnan(value):
        raise ValueError(f"{name}: must be a number, got nan")
    return float(value)


def _numbers(value: Any, name: str) -> tuple[float, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name}: must be a list of numbers, got {value!r}")
    return tuple(_number(v, name) for v in value)


def _rows(value: Any, name: str) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise ValueError(f"{name}: must be a list of rows, got {value!r}")
    if value and not isinstance(value[0], Sequence):
        diagonal = _numbers(value, name)
        return tuple(
            tuple(w if i == j else 0.0 for j in range(len(diagonal)))
            for i, w in enumerate(diagonal)
        )
    rows = tuple(_numbers(row, name) for row in value)
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"{name}: rows must be of equal length, got {value!r}")
    return rows


def _obstacle(value: Any, name: str) -> Obstacle:
    table = _table(value, name, {"shape", "center", "radius", "vertices", "hard"})
    shape, hard = table.get("shape"), table.get("hard", False)
    if not isinstance(hard, bool):
        raise ValueError(f"{name}.hard: must be true or false, got {hard!r}")
    needed = {"circle": {"center", "radius"}, "diamond": {"center", "radius"}}
    needed["polygon"] = {"vertices"}
    if not isinstance(shape, str) or shape not in needed:
        raise ValueError(f"{name}.shape: must be circle, diamond or polygon, got {shape!r}")
    for key in sorted(needed[shape]):
        if key not in table:
            raise ValueError(f"{name}.{key}: missing")
    _only(table, f"{name}.", needed[shape] | {"shape", "hard"})
    try:
        if shape == "polygon":
            return Obstacle.polygon(_rows(table["vertices"], "vertices"), hard)
        center, radius = _numbers(table["center"], "center"), _number(table["radius"], "radius")
        make = Obstacle.circle if shape == "circle" else Obstacle.diamond
        return make(center, radius, hard)
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from error


def _obstacle_table(obstacle: Obstacle) -> dict[str, Any]:
    table: dict[str, Any] = {"shape": obstacle.shape}
    if obstacle.shape == "polygon":
        table["vertices"] = [list(v) for v in obstacle.vertices]
    else:
        table |= {"center": list(obstacle.center), "radius": obstacle.radius}
    if obstacle.hard:
        table["hard"] = True
    return table


def _is_file(model: str) -> bool:
    return model.endswith((".sdf", ".urdf"))


def _goal(value: Any) -> Goal | Equilibrium:
    goal = _table(value, "goal", {"center", "state", "radius"})
    if ("center" in goal) == ("state" in goal):
        raise ValueError("goal.center: missing; or give goal.state, an equilibrium, in its place")
    if "radius" not in goal:
        raise ValueError("goal.radius: missing")
    radius = _number(goal["radius"], "goal.radius")
    if "state" in goal:
        return Equilibrium(_numbers(goal["state"], "goal.state"), radius)
    return Goal(_numbers(goal["center"], "goal.center"), radius)


def _cost(value: Any, regulation: bool) -> RunningCost:
    table = _table(value, "cost", {f.name for f in fields(RunningCost)} - {"own"})
    weights: dict[str, Any] = {"goal": 0.0} if regulation else {}
    for key, entry in table.items():
        read = {"input": _numbers, "state": _rows}.get(key, _number)
        weights[key] = read(entry, f"cost.{key}")
    return RunningCost(**weights)


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple) else value
