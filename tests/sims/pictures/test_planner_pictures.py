"""Pictures of RRT^X: what is drawn is what the planner has."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from ocp.obstacle import Obstacle
from planners.rrtx import RRTX
from planners.solids import Solid
from planners.world import SceneWorld
from sims.pictures.planner_figure import draw_planner, padded_outline, save_planner_figure
from sims.pictures.planner_replay import replay_of_changes


def planner() -> RRTX:
    solids = [Solid.ball([0, 0], 1.5), Solid.box([2, 2], [3, 4])]
    return RRTX(SceneWorld([-5, -5], [5, 5], solids), [4, 4], [-4, -4], 200, padding=0.3)


def test_the_figure_shows_every_branch_and_the_route() -> None:
    tree = planner()
    figure, axes = plt.subplots()
    draw_planner(axes, tree, resolution=20)
    (branches,) = [c for c in axes.collections if isinstance(c, LineCollection)]
    assert len(branches.get_segments()) == (tree.view().parent >= 0).sum()
    drawn = [np.asarray(line.get_xydata()) for line in axes.lines]
    assert any(np.array_equal(line, tree.route.points) for line in drawn)
    # Two solids, each with its padding.
    assert len(axes.patches) == 4
    plt.close(figure)


def test_the_figure_is_written(tmp_path: Path) -> None:
    path = tmp_path / "tree.png"
    save_planner_figure(planner(), path)
    assert plt.imread(path).shape[2] == 4


def test_the_padded_outline_is_the_padding_away() -> None:
    corners = [[0, 0], [2, 0], [1.5, 1.5], [0, 1]]
    outline = padded_outline(Solid.polygon(corners), 0.4)
    assert Obstacle.polygon(corners).signed_distance(outline) == pytest.approx(0.4)


def test_the_replay_holds_what_came_and_went(tmp_path: Path) -> None:
    tree = planner()
    middle = tree.route.points[len(tree.route.points) // 2]
    changes = [{"add": [Solid.ball(middle, 0.5)]}, {"remove": [2]}, {"robot": [-3.0, -4.0]}]
    path = tmp_path / "replay.html"
    replay_of_changes(tree, changes, period=0.5).save(path)
    html = path.read_text(encoding="utf-8")
    assert "<html" in html
    assert len(html) > 1_000_000


def test_only_the_plane_is_drawn() -> None:
    tree = RRTX(SceneWorld([-5] * 3, [5] * 3), [4, 4, 4], [-4, -4, -4], 50)
    figure, axes = plt.subplots()
    with pytest.raises(ValueError, match="plane"):
        draw_planner(axes, tree)
    with pytest.raises(ValueError, match="plane"):
        replay_of_changes(tree, [], 1.0)
    plt.close(figure)
