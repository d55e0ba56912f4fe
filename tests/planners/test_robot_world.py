"""The arm among obstacles: certificates by motion bounds, against Drake's sampled checker."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import check_costs

from planners.robot_world import RobotWorld, three_link_arm
from planners.rrtx import RRTX
from planners.solids import Solid

BALL = Solid.ball([1.4, 1.2], 0.25)
BOX = Solid.box([-1.7, 0.5], [-1.2, 1.0])
LOWER, UPPER = np.array([-3.0, -2.8, -2.8]), np.array([3.0, 2.8, 2.8])


def samples(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    starts = rng.uniform(LOWER, UPPER, (count, 3))
    return starts, np.clip(starts + 0.4 * rng.normal(size=(count, 3)), LOWER, UPPER)


@settings(max_examples=5)
@given(seed=st.integers(0, 10_000), padding=st.floats(0, 0.2))
def test_no_certified_edge_meets_anything_at_fine_samples(seed: int, padding: float) -> None:
    world = three_link_arm([BALL, BOX])
    starts, ends = samples(np.random.default_rng(seed), 40)
    free = world.certify(starts, ends, padding)
    world.checker.SetPaddingAllRobotEnvironmentPairs(padding)
    sampled = [
        all(
            world.checker.CheckConfigsCollisionFree(
                list(a + np.linspace(0, 1, 60)[:, None] * (b - a))
            )
        )
        for a, b in zip(starts, ends, strict=True)
    ]
    assert not (free & ~np.array(sampled)).any()
    # Nor are many free edges refused: those within the resolution of the padding.
    assert (np.array(sampled) & ~free).sum() <= 2
    assert 0 < free.sum() < 40


@settings(max_examples=5)
@given(seed=st.integers(0, 10_000))
def test_intervals_hold_the_least_distance_of_fine_samples(seed: int) -> None:
    world = three_link_arm([BALL])
    starts, ends = samples(np.random.default_rng(seed), 15)
    handle = max(world.handles)
    points = np.concatenate([starts, ends])
    edges = np.column_stack([np.arange(15), np.arange(15, 30)])
    rough = world.edge_clearances(handle, points, edges, np.ones(15), within=10.0)
    lower, upper = world.refine(handle, starts, ends, None)
    assert (upper - lower)[upper > 0].max() <= world.resolution
    along = np.linspace(0, 1, 4000)[:, None]
    for k in range(15):
        least = arm_to_ball(starts[k] + along * (ends[k] - starts[k])).min()
        # Samples come within half a step of the true least: 2.5 m of motion per radian at most.
        near = 2.5 * np.abs(ends[k] - starts[k]).sum() / 8000
        assert rough.lower[k] <= least
        assert rough.upper[k] >= least - near - 1e-4
        assert lower[k] <= least
        if least > near:
            assert least - near - 1e-4 <= upper[k] <= least + world.resolution + 1e-4


def arm_to_ball(configurations: np.ndarray) -> np.ndarray:
    """Distance `[k]` of the arm's capsules from BALL, by plane trigonometry."""
    angles = np.cumsum(configurations, axis=1)
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    lengths = np.array([1.0, 0.8, 0.6])
    tips = np.cumsum(lengths[:, None] * heading, axis=1)
    roots = np.concatenate([np.zeros_like(tips[:, :1]), tips[:, :-1]], axis=1)
    to_ball = BALL.center - roots
    on_link = np.clip((to_ball * heading).sum(axis=2), 0, lengths)
    gaps = np.linalg.norm(to_ball - on_link[..., None] * heading, axis=2)
    return gaps.min(axis=1) - BALL.radius - 0.05


def test_links_that_meet_each_other_are_refused() -> None:
    world = three_link_arm()
    folded = np.array([[0.0, 2.7, 2.7]])
    apart = np.array([[0.0, 0.5, 0.5]])
    assert world.certify(apart, apart, 0.0)[0]
    assert not world.certify(apart, folded, 0.0)[0]
    # The padding keeps the arm from obstacles, not from itself.
    assert world.certify(apart, apart, 5.0)[0]


def test_the_arm_plans_and_replans() -> None:
    world = three_link_arm([BALL, BOX])
    goal, start = [2.0, 0.3, 0.3], [-0.5, 0.2, 0.2]
    tree = RRTX(world, goal, start, 500, seed=1, padding=0.02, reach=1.5)
    check_costs(tree)
    assert tree.route.certified
    middle = tree.route.points[len(tree.route.points) // 2]
    update = tree.appear(Solid.ball(hand(middle), 0.15))
    assert update.route_changed
    assert update.route is not None
    check_costs(tree)
    world.checker.SetPaddingAllRobotEnvironmentPairs(0.02)
    for a, b in zip(update.route.points[:-1], update.route.points[1:], strict=True):
        for t in np.linspace(0, 1, 100):
            assert world.checker.CheckConfigCollisionFree(a + t * (b - a))
    before = tree.vanish(update.handles[0]).route
    assert before is not None
    assert before.cost == update.cost_before
    check_costs(tree)


def hand(configuration: np.ndarray) -> np.ndarray:
    """Where the arm's tip is, `[2]`: links of 1, 0.8 and 0.6 m."""
    angles = np.cumsum(configuration)
    return np.array([1.0, 0.8, 0.6]) @ np.column_stack([np.cos(angles), np.sin(angles)])


def test_a_robot_whose_motion_is_not_bounded_is_sampled_and_says_so(tmp_path) -> None:
    robot = """<?xml version="1.0"?>
    <sdf version="1.9"><model name="drill">
      <link name="bit"><collision name="c"><geometry><sphere><radius>0.1</radius></sphere>
      </geometry></collision></link>
      <joint name="x" type="prismatic"><parent>world</parent><child>bit</child>
        <axis><xyz>1 0 0</xyz><limit><lower>-2</lower><upper>2</upper></limit></axis></joint>
      <link name="tip"><pose>0 0.5 0 0 0 0</pose><collision name="c"><geometry><sphere>
        <radius>0.1</radius></sphere></geometry></collision></link>
      <joint name="y" type="screw"><parent>bit</parent><child>tip</child>
        <screw_thread_pitch>1</screw_thread_pitch><axis><xyz>0 1 0</xyz>
        <limit><lower>-2</lower><upper>2</upper></limit></axis></joint>
    </model></sdf>"""
    path = tmp_path / "drill.sdf"
    path.write_text(robot)
    world = RobotWorld.from_file(path, [Solid.ball([0, 0, 0], 0.3)], lower=[-2, -2], upper=[2, 2])
    assert not world.certified
    tree = RRTX(world, [1.5, 0], [1.0, 1.0], 40)
    assert not tree.route.certified
    assert not world.certify(np.array([[-1.0, 0.0]]), np.array([[1.0, 0.0]]), 0.0)[0]


def test_a_file_that_is_no_robot_is_refused(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="model"):
        RobotWorld.from_file(tmp_path / "none.sdf")
    broken = tmp_path / "broken.sdf"
    broken.write_text("<sdf")
    with pytest.raises(ValueError, match="model"):
        RobotWorld.from_file(broken)
