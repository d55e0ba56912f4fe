"""The family file: a distribution of queries in TOML, read strictly.

Everything is uniform within its bounds; `obstacles.shapes` gives each shape's share. Starts are
those of `sample_start`: uniform in the robot's domain, outside the goal.
"""

import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_FAMILY, QueryFamily
from ocp.query_file import read_toml

MOST_DRAWS = 10_000
SHAPES = {"circle": Obstacle.circle, "diamond": Obstacle.diamond}


def load_family(name: str | os.PathLike[str]) -> QueryFamily:
    """A family by name (`paper`, `general`, `paper-1-1`: one query alone) or from a family file.

    Raises:
        ValueError: if it is unknown or a field is wrong; the message names the field.
    """
    if name == PAPER_FAMILY.name:
        return PAPER_FAMILY
    shipped = resources.files("ocp.families") / f"{name}.toml"
    if not Path(name).suffix:
        if not shipped.is_file():
            raise ValueError(f"family: {str(name)!r} is unknown; known are {', '.join(_known())}")
        name = Path(str(shipped))
    return family_from_dict(read_toml(name))


def _known() -> list[str]:
    shipped = (Path(str(file)) for file in resources.files("ocp.families").iterdir())
    return sorted({PAPER_FAMILY.name, *(f.stem for f in shipped if f.suffix == ".toml")})


def family_from_dict(table: Mapping[str, Any]) -> QueryFamily:
    """A family from the tables of a family file; unknown keys are refused."""
    _keys(table, "", {"name", "model", "goal", "obstacles"})
    goal, obstacles = table["goal"], table["obstacles"]
    _keys(goal, "goal.", {"lower", "upper", "radius"})
    _keys(obstacles, "obstacles.", {"count", "lower", "upper", "radius", "shapes"})
    shapes = dict(obstacles["shapes"])
    for shape, share in shapes.items():
        if shape not in SHAPES or not share >= 0:
            raise ValueError(f"obstacles.shapes: needs shares of circle, diamond, got {shapes}")
    for name, box in (("goal", goal), ("obstacles", obstacles)):
        for low, high, key in (
            (box["lower"], box["upper"], "upper"),
            (box["radius"][:1], box["radius"][1:], "radius"),
        ):
            if len(low) != len(high) or not np.less_equal(low, high).all():
                raise ValueError(f"{name}.{key}: bounds must increase, got {low}, {high}")
    if not 0 <= obstacles["count"][0] <= obstacles["count"][1]:
        raise ValueError(f"obstacles.count: bounds must increase, got {obstacles['count']}")
    names, shares = list(shapes), np.array(list(shapes.values()), dtype=float)
    model = table["model"]

    def draw(rng: np.random.Generator) -> Query:
        center = rng.uniform(goal["lower"], goal["upper"])
        radius = float(rng.uniform(*goal["radius"]))
        count = int(rng.integers(obstacles["count"][0], obstacles["count"][1] + 1))
        drawn: list[Obstacle] = []
        for _ in range(MOST_DRAWS):
            if len(drawn) == count:
                break
            shape = names[int(rng.choice(len(names), p=shares / shares.sum()))]
            place = rng.uniform(obstacles["lower"], obstacles["upper"])
            obstacle = SHAPES[shape](place, float(rng.uniform(*obstacles["radius"])))
            if obstacle.signed_distance(center) >= 0:
                drawn.append(obstacle)
        else:
            raise ValueError("obstacles: they leave no room for the goal")
        return Query(model, Goal(tuple(map(float, center)), radius), tuple(drawn))

    return QueryFamily(table["name"], draw)


def with_obstacle_count(table: Mapping[str, Any], least: int, most: int) -> QueryFamily:
    """The family of a family file's `table`, with another range of obstacle counts."""
    changed = {**table["obstacles"], "count": [least, most]}
    return family_from_dict(
        {**table, "name": f"{table['name']}-{least}-{most}", "obstacles": changed}
    )


def _keys(table: Any, prefix: str, known: set[str]) -> None:
    if not isinstance(table, Mapping):
        raise ValueError(f"{prefix or 'family'}: must be a table, got {table!r}")
    for key in table:
        if key not in known:
            raise ValueError(f"{prefix}{key}: unknown; known are {', '.join(sorted(known))}")
    for key in sorted(known - set(table)):
        raise ValueError(f"{prefix}{key}: missing")
