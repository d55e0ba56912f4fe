"""`zermelo plan` as a user runs it, on the shipped query files but two that take long."""

import json
from pathlib import Path

import numpy as np
import pytest

from ocp.query import Query
from sims import cli
from sims.commands import plan
from sims.pictures.motion_figure import motion_figure

QUERIES = Path(__file__).resolve().parents[3] / "sims" / "queries"
PAPER = [-4.0, -4.0, -0.7853981633974483]
STARTS = {
    "acrobot": [0.0, 0.0, 0.0, 0.0],
    "car-among-others": [-3.0, 0.5, 0.0, 1.2, 0.0],
    "cart-pole": [0.0, 0.0, 0.0, 0.0],
    "loaded-quadrotor": [-1.0, -1.0, 0.5, 1.0, 0.0, 0.0],
    "merging-car": [-2.0, 1.0, 0.0, 1.2, 0.0],
    "paper-1-1": PAPER,
    "paper-1-4": PAPER,
    "paper-4-1": PAPER,
    "paper-4-4": PAPER,
    "pendulum": [0.0, 0.0],
    "quadrotor": [-1.0, -1.0, 0.0, 0.0, 0.0, 0.0],
    "spatial-quadrotor": [0.0] * 12,
    "two-link-arm": [0.5, 0.3, 0.0, 0.0],
}
WITHOUT_A_GRID = {"car-among-others", "loaded-quadrotor", "merging-car"}
TOO_LONG = {"acrobot", "spatial-quadrotor"}  # half a minute or more each
RUNS = [(name, None) for name in STARTS if name not in TOO_LONG] + [
    (n, "causality-free") for n in sorted(WITHOUT_A_GRID)
]
UNCONFIRMED = {"quadrotor"}  # it touches a hard obstacle: the minimum principle has no answer


def test_every_shipped_query_has_a_start() -> None:
    assert {path.stem for path in QUERIES.glob("*.toml")} == STARTS.keys()
    for name, start in STARTS.items():
        Query.load(QUERIES / f"{name}.toml").check_start(start)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), RUNS)
def test_plan_reaches_the_goal_near_the_least_cost(name, method, tmp_path, capsys) -> None:
    path = QUERIES / f"{name}.toml"
    command = cli.Plan(
        query=path, start=(tuple(STARTS[name]),), method=method, json=True, out=tmp_path
    )
    assert plan.run(command) == 0
    (start,) = json.loads(capsys.readouterr().out)["starts"]
    assert start["reached"]
    assert not start["collided"]
    assert (start["exact_cost"] is None) == (name in UNCONFIRMED)
    if name not in UNCONFIRMED:
        assert -1e-3 < start["excess"] < 0.03
    query = Query.load(path)
    pictures = {picture.name for picture in tmp_path.glob("*.png")}
    wanted = {"plan.png": plan.moves_in_the_plane(query), "motions.png": query.is_regulation}
    assert pictures == {picture for picture, drawn in wanted.items() if drawn}


def test_the_legend_names_an_optimum_only_where_one_is_drawn() -> None:
    query = Query.load(QUERIES / "merging-car.toml")
    start = np.array([-1.0, 0.4, 0.0, 1.2, 0.0])
    _, (outcome,) = plan.solve(query, [start], "causality-free")
    assert outcome.exact is not None
    for optimum in (None, outcome.exact):
        (legend,) = motion_figure(query, [outcome.rollout], [optimum]).legends
        named = {text.get_text() for text in legend.get_texts()}
        assert ("exact optimum" in named) == (optimum is not None)
