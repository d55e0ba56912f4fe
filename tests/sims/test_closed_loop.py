"""The closed loop: cost against theory, Drake against the compiled batch, honest endings."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from references import aligned_value

from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import Status
from ocp.value import greedy
from sims.closed_loop import GOAL_TOLERANCE, LoopSettings, drake_rollout, rollout, rollouts

POINT = Query("single-integrator-2d", Goal((1.0, 1.0), 0.5))


@dataclass(frozen=True)
class RadialValue:
    """The exact value of a point robot: it drives straight at the goal. Gradient: 2 sqrt(Q)."""

    query: Query

    def value(self, states):
        distance = np.atleast_1d(self.query.goal_distance(states)) + self.query.goal.radius
        return np.array([aligned_value(d) for d in distance])

    def gradient(self, states):
        offset = self.query.position(states) - self.query.goal_position
        return offset / np.linalg.norm(offset, axis=-1, keepdims=True)  # only its direction counts


@dataclass(frozen=True)
class Constant:
    """A policy that holds one input for ever."""

    query: Query
    held: tuple[float, ...]

    def __call__(self, states):
        return np.broadcast_to(self.held, (*np.shape(states)[:-1], len(self.held)))


def unicycle_rules(query: Query):
    """Any smooth policy that turns, drives and reaches: a hand-written unicycle value's greed."""

    @dataclass(frozen=True)
    class Guess:
        def value(self, states):
            raise AssertionError(f"a greedy policy needs gradients only, not V at {states}")

        def gradient(self, states):
            offset = query.position(states) - query.goal_position
            bearing = np.arctan2(offset[..., 1], offset[..., 0])
            turn = np.sin(2 * (np.asarray(states)[..., 2] - bearing))
            direction = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
            return np.concatenate([direction, turn[..., None]], axis=-1)

    return greedy(query, Guess())


def test_cost_of_the_exact_policy_converges_to_the_exact_value() -> None:
    """The input held for h seconds lags: the excess falls in proportion to h^2 or faster.

    The loop ends 1 mm before the goal's boundary; that last part is taken off the exact value.
    """
    start = np.array([-3.0, 2.0])
    distance = float(np.linalg.norm(start - 1.0))
    exact = aligned_value(distance) - aligned_value(0.5 + GOAL_TOLERANCE)
    policy = greedy(POINT, RadialValue(POINT))
    excess = []
    for period in (0.2, 0.1, 0.05, 0.025):
        result = rollout(policy, start, LoopSettings(period=period))
        assert result.reached
        assert result.cost is not None
        excess.append(result.cost / exact - 1)
    assert all(0 < later < 0.35 * sooner for sooner, later in pairwise(excess))
    assert excess[-1] < 1e-4


@pytest.mark.parametrize("goal", [(4.0, 4.0), (1.0, 4.0)])
def test_drake_and_the_compiled_batch_agree(goal: tuple[float, float]) -> None:
    """Both integrate the same held inputs; Drake to 1e-8, Runge-Kutta 4 at 5 ms to 1e-9."""
    policy = unicycle_rules(paper_query(goal))
    settings = LoopSettings(period=0.05, substeps=10)
    compiled, drake = (
        rollout(policy, PAPER_START, settings),
        drake_rollout(policy, PAPER_START, settings),
    )
    assert compiled.reached
    assert drake.reached
    assert compiled.cost == pytest.approx(drake.cost, rel=1e-6)
    assert compiled.trajectory.duration == pytest.approx(drake.trajectory.duration, abs=1e-5)
    np.testing.assert_allclose(
        compiled.trajectory.states[-1], drake.trajectory.states[-1], atol=1e-5
    )
    assert compiled.collided == drake.collided
    assert compiled.min_clearance == pytest.approx(drake.min_clearance, abs=0.02)


def test_a_batch_is_its_members_one_by_one() -> None:
    policy = unicycle_rules(paper_query((4.0, 4.0)))
    rng = np.random.default_rng(3)
    starts = [*rng.uniform([-5, -5, -np.pi], [3, 3, np.pi], (5, 3)), np.array([4.0, 4.2, 0.0])]
    for start, together in zip(starts, rollouts(policy, starts), strict=True):
        alone = rollout(policy, start)
        assert together.cost == alone.cost
        np.testing.assert_array_equal(together.trajectory.states, alone.trajectory.states)


def test_the_first_hit_ends_on_the_goals_boundary() -> None:
    result = rollout(unicycle_rules(paper_query((4.0, 4.0))), PAPER_START)
    end = POINT.goal.radius + GOAL_TOLERANCE
    distance = np.linalg.norm(result.trajectory.states[-1, :2] - 4.0)
    assert distance == pytest.approx(end, abs=1e-9)
    before = np.linalg.norm(result.trajectory.states[:-1, :2] - 4.0, axis=1)
    assert (before > end).all()


def test_a_start_in_the_goal_costs_nothing() -> None:
    result = rollout(unicycle_rules(paper_query((4.0, 4.0))), [4.0, 4.2, 1.0])
    assert result.reached
    assert result.cost == 0.0


@pytest.mark.parametrize("drive", [rollout, drake_rollout])
def test_a_policy_that_circles_for_ever_did_not_reach(drive) -> None:
    policy = Constant(paper_query((4.0, 4.0)), (1.0, 1.0))
    result = drive(policy, [-4.0, -4.0, 0.0], LoopSettings(time_limit=8.0))
    assert not result.reached
    assert result.cost is None
    assert result.trajectory.status is Status.DID_NOT_REACH
    assert result.trajectory.duration == pytest.approx(8.0)
    # A circle of radius 1 about (-4, -3): the geometry confirms the dynamics.
    radii = np.linalg.norm(result.trajectory.states[:, :2] - [-4.0, -3.0], axis=1)
    np.testing.assert_allclose(radii, 1.0, atol=1e-6)


def test_collision_is_geometry_not_cost() -> None:
    """Straight through a soft circle of radius 1: cleared by -1; a robot of radius .2, by -1.2."""
    for radius in (0.0, 0.2):
        query = Query(
            "single-integrator-2d",
            Goal((4.0, 0.0), 0.5),
            (Obstacle.circle((0.0, 0.0), 1.0),),
            robot_radius=radius,
        )
        result = rollout(Constant(query, (1.0, 0.0)), [-4.0, 0.0])
        assert result.reached
        assert result.collided
        assert result.min_clearance == pytest.approx(-1.0 - radius, abs=1e-9)


def test_a_policy_that_returns_nonsense_is_not_followed() -> None:
    policy = Constant(POINT, (np.nan, 0.0))
    with pytest.raises(FloatingPointError, match="non-finite input"):
        rollout(policy, [-3.0, 2.0])
