"""Laws of RRT^X: after every change the repaired tree is the shortest-path tree."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from ball_world import BallWorld
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import check_costs, check_tree, clearance_by_search, costs_by_dijkstra

from ocp.obstacle import Obstacle
from ocp.trajectory import SolveError
from planners.blockage import Barrier
from planners.rrtx import RRTX
from planners.solids import Solid
from planners.update import Cause
from planners.world import SceneWorld
from sims.benchmarks.visibility_graph import shortest_way

SIDE = 10.0


def random_obstacle(rng: np.random.Generator, dimension: int = 2) -> Obstacle | Solid:
    center = rng.uniform(-SIDE, SIDE, dimension)
    size = rng.uniform(0.5, 2.5)
    if dimension == 3:
        return [
            Solid.ball(center, size),
            Solid.box(center - size / 2, center + size / 2),
            Solid.hull(center + size * rng.normal(size=(8, 3))),
        ][rng.integers(3)]
    if rng.random() < 0.3:
        return Obstacle.circle(center, size)
    corners = rng.integers(3, 8)
    angles = (np.arange(corners) + rng.uniform(0.1, 0.9, corners)) * (2 * np.pi / corners)
    return Obstacle.polygon(center + size * np.column_stack([np.cos(angles), np.sin(angles)]))


def planner(
    nodes: int = 400, obstacles: int = 4, seed: int = 0, dimension: int = 2, **options
) -> RRTX:
    rng = np.random.default_rng(seed)
    box = np.full(dimension, SIDE)
    world = SceneWorld(-box, box, [random_obstacle(rng, dimension) for _ in range(obstacles)])
    return RRTX(world, 0.9 * box, -0.9 * box, nodes, seed=seed, **options)


def random_change(planner: RRTX, rng: np.random.Generator) -> None:
    """One change of any kind, not always repaired to the end."""
    world, d = planner.world, planner.world.dimension
    kind = rng.integers(8)
    to_the_end = bool(rng.random() < 0.5)
    handles = list(world.handles)
    if kind == 0 or (kind in (1, 2) and not handles):
        planner.appear(random_obstacle(rng, d), to_the_end=to_the_end)
    elif kind == 1:
        planner.vanish(int(rng.choice(handles)), to_the_end=to_the_end)
    elif kind == 2:
        turn = rng.uniform(-1, 1) if d == 2 else np.eye(3)
        planner.shift(int(rng.choice(handles)), rng.normal(size=d), turn, to_the_end=to_the_end)
    elif kind == 3:
        planner.set_padding(rng.uniform(0, 0.9), to_the_end=to_the_end)
    elif kind == 4:
        planner.move_robot(rng.uniform(-SIDE, SIDE, d), to_the_end=to_the_end)
    elif kind == 5:
        planner.set_goal(rng.uniform(-SIDE, SIDE, d), to_the_end=to_the_end)
    elif kind == 6:
        planner.grow(int(rng.integers(1, 60)), to_the_end=to_the_end)
    else:
        planner.change(
            add=[random_obstacle(rng, d) for _ in range(2)],
            remove=handles[:1],
            padding=rng.uniform(0, 0.5),
            to_the_end=to_the_end,
        )


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), epsilon=st.sampled_from([0.0, 0.02]))
def test_any_changes_leave_the_costs_of_dijkstra(seed: int, epsilon: float) -> None:
    rng = np.random.default_rng(seed)
    tree = planner(seed=seed, epsilon=epsilon)
    for _ in range(6):
        random_change(tree, rng)
        check_tree(tree.view(), epsilon)
        if rng.random() < 0.5:
            check_costs(tree, epsilon)
    check_costs(tree, epsilon)


def test_a_long_fuzz_in_space() -> None:
    rng = np.random.default_rng(1)
    tree = planner(300, dimension=3, seed=1)
    for _ in range(40):
        random_change(tree, rng)
        check_costs(tree)


def test_a_long_fuzz_in_the_plane() -> None:
    rng = np.random.default_rng(2)
    tree = planner(500, obstacles=8, seed=2)
    for _ in range(100):
        random_change(tree, rng)
        check_costs(tree)


@pytest.mark.parametrize("dimension", [4, 5, 6, 7])
def test_a_fuzz_in_more_dimensions(dimension: int) -> None:
    rng = np.random.default_rng(dimension)
    box = np.full(dimension, SIDE)
    world = BallWorld(-box, box)
    for _ in range(3):
        world.add((rng.uniform(-box, box), rng.uniform(1, 5)))
    tree = RRTX(world, 0.9 * box, -0.9 * box, 150, seed=1, reach=2 * SIDE)
    for _ in range(12):
        tree.change(
            add=[(rng.uniform(-box, box), rng.uniform(1, 5))],
            remove=list(world.handles)[:1],
            move={world.handles[-1]: rng.normal(size=dimension)},
            padding=rng.uniform(0, 2),
            robot=rng.uniform(-box, box),
        )
        tree.grow(10)
        check_costs(tree)
        if tree.change().route is not None:
            assert world.clearance(tree.route.points) > tree.padding


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_an_unsettled_tree_already_knows_the_robots_cost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = planner(500, seed=seed)
    for _ in range(5):
        random_change(tree, rng)
        early = tree.view(), tree.settle()
        assert not early[1].route_changed


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_an_obstacle_added_and_removed_restores_the_costs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = planner(seed=seed)
    tree.settle()
    before = tree.view()
    handle = tree.appear(random_obstacle(rng)).handles[0]
    tree.shift(handle, rng.normal(size=2), 0.3)
    tree.vanish(handle, to_the_end=True)
    after = tree.view()
    assert np.array_equal(before.cost_to_go, after.cost_to_go)
    assert np.array_equal(before.blocked, after.blocked)


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), padding=st.floats(0, 2))
def test_edges_are_blocked_exactly_where_their_clearance_is_at_most_the_padding(
    seed: int, padding: float
) -> None:
    rng = np.random.default_rng(seed)
    obstacles = [random_obstacle(rng) for _ in range(5)]
    world = SceneWorld([-SIDE] * 2, [SIDE] * 2, obstacles)
    tree = RRTX(world, [9, 9], [-9, -9], 200, seed=seed)
    tree.set_padding(padding)
    view = tree.view()
    ends = view.points[view.edges]
    clearance = np.min(
        [
            clearance_by_search(o, ends[:, 0], ends[:, 1])
            for o in obstacles
            if isinstance(o, Obstacle)
        ],
        axis=0,
    )
    clear_cut = np.abs(clearance - padding) > 1e-6
    assert np.array_equal(view.blocked[clear_cut], (clearance <= padding)[clear_cut])


@pytest.mark.parametrize("dimension", [2, 3])
def test_routes_are_free_under_the_padded_checker_of_drake(dimension: int) -> None:
    from drake_checker import PaddedChecker

    rng = np.random.default_rng(3)
    tree = planner(600, obstacles=6, seed=3, dimension=dimension, padding=0.2)
    checker = PaddedChecker(dimension)
    seen = 0
    for _ in range(12):
        random_change(tree, rng)
        update = tree.change()
        if update.route is None:
            continue
        seen += 1
        assert isinstance(tree.world, SceneWorld)
        checker.set(tree.world.obstacles.values(), tree.padding)
        assert checker.free(update.route.points, step=0.01)
        assert update.route.certified
    assert seen >= 6


def test_the_padded_checker_refuses_what_is_not_free() -> None:
    from drake_checker import PaddedChecker

    checker = PaddedChecker(2)
    checker.set([Solid.ball([0, 0], 1.0)], 0.5)
    assert not checker.free(np.array([[-3, 1.45], [3, 1.45]]), step=0.01)
    assert checker.free(np.array([[-3, 1.55], [3, 1.55]]), step=0.01)


def gap(width: float) -> SceneWorld:
    """Two walls across the box with a gap between them."""
    return SceneWorld(
        [-SIDE] * 2,
        [SIDE] * 2,
        [Solid.box([-0.5, -11], [0.5, -width / 2]), Solid.box([-0.5, width / 2], [0.5, 11])],
    )


def test_padding_that_bars_the_way_is_told_from_obstacles() -> None:
    width = 2.0
    tree = RRTX(gap(width), [8, 0], [-8, 0], 2000, seed=1, padding=0.2)
    assert tree.route.cost < 17
    barred = tree.set_padding(1.2)
    assert barred.route is None
    assert barred.blockage is not None
    assert barred.blockage.barrier is Barrier.PADDING
    largest = barred.blockage.largest_padding
    # No way is wider than half the gap; this dense a graph comes within 0.2 m of it.
    assert width / 2 - 0.2 < largest < width / 2
    with pytest.raises(SolveError, match="padding"):
        _ = tree.route
    assert tree.set_padding(largest - 1e-6).route is not None
    assert tree.set_padding(largest + 1e-6).route is None
    closed = tree.appear(Solid.box([-1, -1], [1, 1]))
    assert closed.blockage is not None
    assert closed.blockage.barrier is Barrier.OBSTACLES
    tree.change(remove=closed.handles, padding=0.2)
    assert tree.route.cost < 17


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_the_largest_padding_is_where_routes_end(seed: int) -> None:
    tree = planner(300, obstacles=8, seed=seed)
    barred = tree.set_padding(4.0).blockage
    if barred is None or barred.barrier is Barrier.OBSTACLES:
        return
    assert tree.set_padding(barred.largest_padding * (1 - 1e-6)).route is not None
    assert tree.set_padding(barred.largest_padding + 1e-6).route is None


def test_updates_say_what_changed_and_why() -> None:
    tree = planner(500, obstacles=0)
    middle = tree.route.points[len(tree.route.points) // 2]
    update = tree.change(add=[Solid.ball(middle, 1.0)], padding=0.1)
    assert update.causes == (Cause.APPEARANCE, Cause.PADDING)
    assert update.edges_blocked > 0 == update.edges_freed
    assert update.orphans > 0
    assert update.route_changed
    assert update.route is not None
    assert update.route.cost > update.cost_before
    assert 0 < update.geometry_seconds < update.seconds
    back = tree.vanish(update.handles[0])
    assert back.causes == (Cause.DISAPPEARANCE,)
    assert back.edges_freed == update.edges_blocked
    assert back.route is not None
    assert back.route.cost == update.cost_before


def test_equal_seeds_give_equal_trees_and_other_seeds_others() -> None:
    first, second, third = planner(seed=4).view(), planner(seed=4).view(), planner(seed=5).view()
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.cost_to_go, second.cost_to_go)
    assert not np.array_equal(first.points[1:], third.points[1:])


def test_more_samples_shorten_the_way() -> None:
    tree = planner(100, obstacles=6, seed=7, padding=0.1)
    costs = [tree.grow(400).route.cost for _ in range(5)]  # pyright: ignore[reportOptionalMemberAccess]
    assert all(later <= earlier for earlier, later in pairwise(costs))
    assert costs[-1] < costs[0]


def test_the_shortened_route_leaves_out_corners_only_where_that_is_free() -> None:
    tree = planner(1500, obstacles=0, padding=0.2)
    tree.change(add=[Solid.ball([-2, -1], 2.0), Solid.box([1, 2], [4, 6])])
    short, route = tree.shortened(), tree.route
    assert short.cost < route.cost
    assert {tuple(p) for p in short.points} <= {tuple(p) for p in route.points}
    assert short.points[[0, -1]].tolist() == route.points[[0, -1]].tolist()
    assert tree.world.certify(short.points[:-1], short.points[1:], 0.2).all()
    assert isinstance(tree.world, SceneWorld)
    # No way is shorter than the optimum.
    best, _ = shortest_way(tree.world.obstacles.values(), tree.robot, tree.goal, 0.2)
    assert best < short.cost < 1.02 * best


def test_a_tree_of_samples_added_late_equals_one_grown_at_once() -> None:
    late, once = planner(50, seed=6), planner(250, seed=6)
    late.appear(Solid.ball([0, 0], 1.0))
    for _ in range(4):
        late.grow(50)
    once.appear(Solid.ball([0, 0], 1.0))
    late.settle()
    once.settle()
    assert np.array_equal(late.view().cost_to_go, once.view().cost_to_go)


def test_culling_forgets_long_edges_and_its_price_is_bounded() -> None:
    rng = np.random.default_rng(0)
    plain, culled = planner(800, seed=8), planner(800, seed=8, culling=True)
    worst = 0.0
    for _ in range(10):
        obstacle = random_obstacle(rng)
        for tree in (plain, culled):
            tree.appear(obstacle, to_the_end=True)
        a, b = plain.view(), culled.view()
        assert np.array_equal(a.blocked, b.blocked)
        check_tree(b)
        reachable = np.isfinite(b.cost_to_go)
        assert (b.cost_to_go[reachable] >= a.cost_to_go[reachable]).all()
        # No worse than forgetting every running neighbour beyond the radius, in the tree or not.
        bound = costs_by_dijkstra(b, b.lengths > b.radius)
        assert (b.cost_to_go <= bound).all()
        both = reachable & np.isfinite(a.cost_to_go)
        worst = max(worst, float((b.cost_to_go[both] - a.cost_to_go[both]).max()))
    assert 0 < worst < 2.0


def test_cost_to_go_anywhere_is_that_of_a_visible_node() -> None:
    tree = RRTX(gap(2.0), [8, 0], [-8, 0], 3000, seed=1, padding=0.2)
    points = np.array([[-8.0, 0.0], [-3.0, 6.0], [3.0, 6.0], [0.0, 5.0], [8.0, 0.0]])
    cost = tree.cost_to_go(points.reshape(5, 1, 2))[:, 0]
    around = np.hypot(2.5, 5.2) + np.hypot(0, 0)
    assert cost[0] == pytest.approx(tree.route.cost)
    assert cost[1] > around + 8
    assert cost[2] == pytest.approx(np.hypot(5, 6), rel=0.02)
    assert np.isinf(cost[3])
    assert cost[4] == 0


def test_the_robot_on_the_goal_is_there() -> None:
    tree = planner(100, obstacles=0)
    update = tree.move_robot(tree.goal)
    assert update.route is not None
    assert update.route.cost == 0


def test_a_robot_inside_the_padding_has_no_route_until_it_shrinks() -> None:
    tree = RRTX(gap(2.0), [8, 0], [-1.0, 5.0], 800, padding=0.4)
    assert tree.route.points[0].tolist() == [-1.0, 5.0]
    barred = tree.set_padding(0.6)
    assert barred.blockage is not None
    assert barred.blockage.barrier is Barrier.PADDING
    assert barred.blockage.largest_padding == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"padding": -0.1}, "padding"),
        ({"padding": np.nan}, "padding"),
        ({"robot": [np.inf, 0]}, "robot"),
        ({"robot": [50, 0]}, "robot"),
        ({"robot": [0, 0, 0]}, "robot"),
        ({"remove": [77]}, "handle"),
        ({"move": {0: [np.nan, 0]}}, "translation"),
        ({"add": [Solid.ball([0, 0, 0], 1)]}, "obstacle"),
        ({"add": ["wall"]}, "obstacle"),
    ],
)
def test_bad_changes_are_refused_and_leave_the_tree_in_order(change: dict, message: str) -> None:
    tree = planner(200)
    with pytest.raises(ValueError, match=message):
        tree.change(**change)
    check_costs(tree)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": [99, 0]}, "goal"),
        ({"nodes": 0}, "nodes"),
        ({"nodes": 2.5}, "nodes"),
        ({"padding": np.inf}, "padding"),
        ({"epsilon": -1}, "epsilon"),
        ({"reach": 0}, "reach"),
        ({"radius_factor": np.nan}, "radius_factor"),
        ({"padding": 1.0, "horizon": 0.5}, "horizon"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    world = SceneWorld([-SIDE] * 2, [SIDE] * 2)
    merged: dict[str, Any] = {"goal": [9, 9], "robot": [0, 0]} | options
    with pytest.raises(ValueError, match=message):
        RRTX(world, **merged)
