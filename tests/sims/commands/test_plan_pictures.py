"""`zermelo plan --out` for robots of any size: what is drawn, and how much is computed for it."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.lines import Line2D

from ocp.query import Query
from sims.commands.plan import moves_in_the_plane, solve, write_outputs
from sims.pictures.motion_figure import motion_figure

QUERIES = Path(__file__).resolve().parents[3] / "sims" / "queries"
PLANAR = {
    "car-among-others": True,
    "merging-car": True,
    "loaded-quadrotor": True,
    "quadrotor": True,
    "paper-4-4": True,
    "pendulum": False,
    "cart-pole": False,
    "acrobot": False,  # two angles are no place
    "two-link-arm": False,
    "spatial-quadrotor": False,
}


@pytest.mark.parametrize("name", PLANAR)
def test_only_robots_in_the_plane_get_a_map(name: str) -> None:
    assert moves_in_the_plane(Query.load(QUERIES / f"{name}.toml")) == PLANAR[name]


@pytest.fixture(scope="module")
def merged():
    """A car with five states, planned for without a grid."""
    query = Query.load(QUERIES / "merging-car.toml")
    start = np.array([-1.0, 0.4, 0.0, 1.2, 0.0])
    return solve(query, [start], "causality-free", with_exact=False)


def test_pictures_of_a_robot_with_many_states_ask_v_nowhere(merged, tmp_path, monkeypatch) -> None:
    """Over the plane and three more coordinates 10^7 states: once that filled all memory."""
    answer, outcomes = merged

    def forbidden(*_states) -> None:
        raise AssertionError("V was asked for")

    monkeypatch.setattr(type(answer.value), "value", forbidden)
    write_outputs(tmp_path, {"made": "here"}, answer, outcomes)
    assert json.loads((tmp_path / "plan.json").read_text()) == {"made": "here"}
    for name in ("trajectories.npz", "plan.png", "motions.png"):
        assert (tmp_path / name).stat().st_size > 0


def heights(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_ydata())


def test_motions_show_every_state_and_input(merged) -> None:
    answer, outcomes = merged
    system = answer.query.system
    loop = outcomes[0].rollout
    figure = motion_figure(answer.query, [loop])
    drawn = [axes for axes in figure.axes if axes.get_ylabel()]
    assert len(drawn) == system.n + system.m
    for i, axes in enumerate(drawn[: system.n]):
        (curve,) = (y for y in map(heights, axes.lines) if len(y) > 2)
        np.testing.assert_array_equal(curve, loop.trajectory.states[:, i])


def test_an_angles_goal_is_drawn_where_the_motion_comes_to_it() -> None:
    """A pendulum that swings up the other way ends at -pi."""
    query = Query.load(QUERIES / "pendulum.toml")
    _, outcomes = solve(query, [np.array([0.3, 0.0])], "exact", with_exact=False)
    loop = outcomes[0].rollout
    end = loop.trajectory.states[-1, 0]
    figure = motion_figure(query, [loop])
    ((goal, _),) = (y for y in map(heights, figure.axes[0].lines) if len(y) == 2)
    assert abs(goal - end) <= query.goal.radius
    assert abs(goal) == pytest.approx(np.pi)
