"""RRT-Q^X as a state machine, driven without a simulator by a robot of known motion."""

import numpy as np
import pytest

from planners.leg import Leg
from planners.navigation_settings import FLOWING, FORETOLD, PAPER, NavigatorSettings
from planners.orders import Phase
from planners.perceived import Sighting
from planners.rrt_qx import Navigator
from planners.solids import Solid
from planners.update import Cause
from planners.world import SceneWorld

PERIOD = 0.05
START, GOAL = [-8.0, 0.0], [8.0, 0.0]
WALL = Solid.box([-0.5, -10.0], [0.5, 10.0])
POST = Solid.ball([0.0, 0.3], 1.5)


class Glider:
    """p'' = u in the plane under u = -k_p e - k_v e', the input held: a controller and its robot.

    Critically damped at 1.5/s. Satisfies the controllers' protocol by nothing but its own motion.
    """

    def __init__(self, ready_after=0.0, tells=True):
        self.gain = np.array([2.25, 3.0])
        # Held input: p += h v + h^2/2 u, v += h u.
        h = PERIOD
        step = np.array([[1, h], [0, 1]]) - np.outer([h * h / 2, h], self.gain)
        self.powers = [np.eye(2)]
        while np.abs(self.powers[-1][0]).max() > 0.01:
            self.powers.append(step @ self.powers[-1])
        self.step = step
        self.legs, self.time, self.ready_after, self.tells = 0, 0.0, ready_after, tells

    @property
    def ready(self):
        return self.time >= self.ready_after - 1e-9

    def new_leg(self):
        self.legs += 1

    def control(self, error):
        return -self.gain[0] * error[:2] - self.gain[1] * error[2:]

    def forecast(self, errors, receding):  # noqa: ARG002
        if not self.tells:
            return None
        axes = np.stack([errors[:, :2], errors[:, 2:]])
        return np.stack([np.einsum("j,jcd->cd", M[0], axes) for M in self.powers], axis=1)

    def drive(self, state, reference):
        """One sample of the robot's motion."""
        self.time += PERIOD
        error = (state - reference).reshape(2, 2)
        return (self.step @ error).ravel() + reference


class World:
    """What there is, and a robot in it that sees 8 m far."""

    def __init__(self, rules=FLOWING, solids=(), glider=None, **settings):
        self.glider = Glider() if glider is None else glider
        self.solids, self.scenes = dict(enumerate(solids)), {}
        self.state = np.array([*START, 0.0, 0.0])
        own = NavigatorSettings(
            rules=rules,
            robot_radius=0.2,
            sample_period=PERIOD,
            **({"nodes": 400} | settings),
        )
        self.navigator = Navigator([-10, -10], [10, 10], self.state, GOAL, self.glider, own)
        self.time, self.track, self.orders = 0.0, [self.state.copy()], []

    def away(self):
        """Drake's distance to each solid, by key."""
        found = {}
        for key, solid in self.solids.items():
            if id(solid) not in self.scenes:
                self.scenes[id(solid)] = solid, SceneWorld([-10, -10], [10, 10], [solid])
            found[key] = float(self.scenes[id(solid)][1].distances(self.state[:2]).distance)
        return found

    def clearance(self):
        return min(self.away().values(), default=np.inf) - 0.2

    def seen(self):
        radius, away = self.navigator.settings.perception_radius, self.away()
        return [Sighting(k, s) for k, s in self.solids.items() if away[k] <= radius]

    def go(self, seconds, until=None):
        """Run; returns the least clearance on the way."""
        least = self.clearance()
        for _ in range(round(seconds / PERIOD)):
            order = self.navigator.step(self.time, self.state, self.seen())
            self.orders.append(order)
            if until is not None and order.phase is until:
                break
            self.state = self.glider.drive(self.state, order.reference)
            self.time += PERIOD
            self.track.append(self.state.copy())
            least = min(least, self.clearance())
        return least


@pytest.mark.parametrize("rules", [PAPER, FORETOLD, FLOWING])
def test_an_empty_world_is_crossed_to_within_the_goals_tolerance(rules):
    world = World(rules)
    world.go(60.0, until=Phase.ARRIVED)
    assert world.orders[-1].phase is Phase.ARRIVED
    assert np.linalg.norm(world.state[:2] - GOAL) <= world.navigator.settings.goal_tolerance


def test_a_reference_that_runs_ahead_is_faster_than_waypoints_one_by_one():
    times = {}
    for rules in (FORETOLD, FLOWING):
        world = World(rules)
        world.go(60.0, until=Phase.ARRIVED)
        times[rules] = world.time
    assert times[FLOWING] < 0.6 * times[FORETOLD]


def test_until_the_controller_is_ready_the_robot_is_kept_where_it_stands():
    world = World(glider=Glider(ready_after=1.0))
    world.go(1.0)
    assert all(order.phase is Phase.LEARNING for order in world.orders)
    assert all(np.array_equal(order.reference[:2], START) for order in world.orders)
    world.go(0.2)
    assert world.orders[-1].phase is Phase.DRIVING


@pytest.mark.parametrize("rules", [FORETOLD, FLOWING])
def test_foretold_motion_keeps_the_margin_from_what_stands(rules):
    world = World(rules, [POST, Solid.box([3.0, -3.0], [4.0, 1.0])])
    least = world.go(60.0, until=Phase.ARRIVED)
    assert world.orders[-1].phase is Phase.ARRIVED
    # Not more than necessary either: the way round the post is taken, not one along the walls.
    assert world.navigator.settings.margin - 1e-3 <= least < 1.0


@pytest.mark.parametrize("rules", [FORETOLD, FLOWING])
@pytest.mark.parametrize("ahead", [1.5, 2.5])
def test_an_obstacle_that_appears_right_ahead_is_survived(rules, ahead):
    """It appears so many metres and the stopping distance ahead of a robot at full speed."""
    world = World(rules)
    world.go(0.8)
    speed = np.linalg.norm(world.state[2:])
    assert speed > 0.5
    # e^-(1.5 t) t v has its greatest value v / (1.5 e) under critical damping.
    stopping = speed / (1.5 * np.e)
    x = world.state[0] + 0.2 + ahead + stopping
    world.solids[7] = Solid.box([x, world.state[1] - 2.0], [x + 1.0, world.state[1] + 2.0])
    least = world.go(60.0, until=Phase.ARRIVED)
    assert world.orders[-1].phase is Phase.ARRIVED
    assert least >= world.navigator.settings.margin - 1e-3


def test_without_a_route_the_robot_stops_says_why_and_goes_on_when_one_opens():
    world = World(FLOWING, [WALL])
    least = world.go(10.0)
    stopped = world.orders[-1]
    assert stopped.phase is Phase.STOPPED
    assert "obstacles bar every way" in stopped.reason
    assert np.linalg.norm(world.state[2:]) < 1e-3
    assert least > 0.05
    del world.solids[0]
    world.go(20.0, until=Phase.ARRIVED)
    assert world.orders[-1].phase is Phase.ARRIVED
    assert world.orders[-1].reason == ""


def test_a_gap_too_narrow_for_comfort_is_taken_all_the_same():
    """0.9 m for a body of 0.4 m: the padding of 0.6 m that is preferred leaves no way."""
    walls = [Solid.box([-0.5, 0.45], [0.5, 10.0]), Solid.box([-0.5, -10.0], [0.5, -0.45])]
    world = World(FLOWING, walls, nodes=1500)
    least = world.go(20.0, until=Phase.ARRIVED)
    assert world.orders[-1].phase is Phase.ARRIVED
    assert 0.09 <= least <= 0.25
    assert Cause.PADDING in {cause for r in world.navigator.replans for cause in r.causes}


def test_the_papers_padding_grows_with_the_largest_deviation_and_never_shrinks():
    world = World(PAPER, [POST])
    world.go(60.0, until=Phase.ARRIVED)
    paddings = np.array([order.padding for order in world.orders])
    largest = np.array([order.largest_deviation for order in world.orders])
    assert (np.diff(paddings) >= 0).all()
    assert largest[-1] > 0
    np.testing.assert_allclose(paddings[1:], 0.2 + largest[1:], atol=1e-12)


def test_the_papers_legs_end_within_the_window_of_their_waypoint():
    world = World(PAPER)
    world.go(60.0, until=Phase.ARRIVED)
    switches = 0
    for k in range(1, len(world.orders)):
        before, now = world.orders[k - 1], world.orders[k]
        if now.phase is not Phase.DRIVING or before.leg == now.leg:
            continue
        begun = next(i for i, order in enumerate(world.orders) if order.leg == before.leg)
        leg = Leg(world.track[begun], before.reference, 2, 0.0)
        assert leg.arrived(world.track[k], world.navigator.settings.admissible_window)
        assert not leg.arrived(world.track[k - 1], world.navigator.settings.admissible_window)
        switches += 1
    assert switches >= 3


def test_a_leg_whose_horizon_expires_begins_anew_to_the_same_waypoint():
    class Stuck(Glider):
        def drive(self, state, reference):  # noqa: ARG002
            self.time += PERIOD
            return state

    world = World(PAPER, glider=Stuck(), horizon=1.0)
    world.go(3.5)
    assert world.navigator.legs == 4
    references = np.array([order.reference for order in world.orders])
    assert (references == references[0]).all()


def test_obstacles_that_are_not_seen_are_not_known():
    far = Solid.ball([7.0, 5.0], 0.5)
    world = World(FLOWING, [far])
    world.go(0.5)
    assert world.navigator.perceived.known == []
    world.go(30.0, until=Phase.ARRIVED)
    assert [key for key, _ in world.navigator.perceived.known] == [0]


def test_every_change_of_the_world_is_told_to_the_planner_once():
    world = World(FLOWING, [POST])
    world.go(0.5)
    del world.solids[0]
    world.go(0.5)
    causes = [cause for replan in world.navigator.replans for cause in replan.causes]
    assert causes == [Cause.APPEARANCE, Cause.DISAPPEARANCE]


def test_a_disc_that_walks_into_the_way_is_let_pass():
    world = World(FLOWING, [Solid.ball([-2.0, -4.0], 0.5)])
    least = np.inf
    for _ in range(400):
        world.solids[0] = world.solids[0].moved([0.0, 0.6 * PERIOD])
        least = min(least, world.go(PERIOD))
        if world.orders[-1].phase is Phase.ARRIVED:
            break
    assert world.orders[-1].phase is Phase.ARRIVED
    assert least >= 0.05


@pytest.mark.parametrize("seed", range(8))
def test_what_stands_is_not_met_to_make_way_for_what_moves(seed):
    """A disc too broad and too fast to escape drives through a yard of posts: it may hit the robot,
    but the robot, which knows where the posts are, hits none of them."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(0.0, 2 * np.pi) + np.arange(7) * (2 * np.pi / 7)
    places = np.array(START) + 1.6 * np.column_stack([np.cos(turns), np.sin(turns)])
    posts = [Solid.ball(place, 0.5) for place in places]
    world = World(FLOWING, posts)
    world.go(0.5)
    course = rng.uniform(0.0, 2 * np.pi)
    way = np.array([np.cos(course), np.sin(course)])
    disc = Solid.ball(np.array(START) - 6.0 * way, 2.5)
    for _ in range(80):
        disc = disc.moved(3.0 * PERIOD * way)
        world.solids[len(posts)] = disc
        world.go(PERIOD)
        assert min(world.away()[k] for k in range(len(posts))) >= 0.2


def test_rules_that_foretell_refuse_a_controller_that_cannot():
    world = World(FLOWING, glider=Glider(tells=False))
    with pytest.raises(ValueError, match="forecast"):
        world.go(0.1)
    World(PAPER, glider=Glider(tells=False)).go(0.1)


def test_equal_seeds_give_equal_runs():
    tracks = []
    for _ in range(2):
        world = World(FLOWING, [POST])
        world.go(3.0)
        tracks.append(np.array(world.track))
    np.testing.assert_array_equal(*tracks)
