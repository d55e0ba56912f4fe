"""RRT-Q^X, Algorithm 1: a robot of unknown linear dynamics among obstacles that come and go.

Kontoudis, Vamvoudakis and Xu, "RRT-Q^X: Real-Time Kinodynamic Motion Planning in Dynamic
Environments with Continuous-Time Reinforcement Learning" (2022).

`Navigator` is the algorithm as a state machine: `step` is handed the state and what is seen once a
sample (Delta t) and answers with the state x_r to regulate to; a `LegController` regulates the
error x - x_r. The planner never learns what the controller is: `LegController` says what it needs.

What the paper leaves open is decided thus, the same for every rule:

- First plan: the tree is grown in the empty arena before the clock starts; the first route is asked
  for once the controller says that it is ready. Until then the robot stays where it is.
- A leg whose horizon T expires begins anew from where the robot is, to the same waypoint.
- D_rob is the distance of the position to the leg's finite segment (see `leg.Leg.deviation`).
- Waypoints count as reached by the admissible window rho, the goal by its own tolerance in metres.
- A waypoint nearer than `SHORTEST` is passed over: rho D_0 of it would mean nothing.
- The arena bounds the planning; it is no wall.
- A leg goes on while its straight line stays free; else the new route's first waypoint follows.
- No route: the robot brakes within what it knows to be free, says whether the obstacles or their
  padding bar the way, holds, and goes on when a route opens.

Two rules of the paper can be exchanged for ours, which need a controller that can `forecast`:

- Padding. `LARGEST_DEVIATION` (the paper's, Remark 2): obstacles are augmented by D_kin, the
  largest deviation of the robot's lifetime. `EACH_LEG`: the learned closed loop foretells the
  motion of each leg before it is begun; a leg is begun only if that motion keeps `margin` from
  everything known, else it is shortened. The planner's padding is a matter of comfort only.
- Waypoints. `WINDOW` (the paper's): to each waypoint in turn, until within rho D_0. `MOVING`: the
  reference runs ahead along the route and the horizon recedes. Each sample, the farthest reference
  is taken from which the foretold motion, up to standstill, keeps clear.

Why this is safe, among obstacles that stand: the motion to the last reference, up to standstill,
was clear when it was chosen, and a linear closed loop does what was foretold; so the last reference
is always a safe choice, and new ones are taken only if they are safe too. An obstacle that appears
is survived if some braking motion keeps clear of it: it is enough that it appears farther away than
the robot's stopping distance and the margin. Obstacles that move are extrapolated at their present
velocity for `foresight` seconds: as safe as that guess.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planners.blockage import Barrier
from planners.foretold import SHARES, ForetoldMotions
from planners.leg import Leg, along_route
from planners.leg_controller import LegController
from planners.navigation_settings import NavigatorSettings, PaddingRule, WaypointRule
from planners.orders import Order, Phase, Replan
from planners.perceived import Perceived, Sighting
from planners.rrtx import RRTX
from planners.update import Cause, Update
from planners.world import SceneWorld

Array = NDArray[np.float64]

SHORTEST = 0.5
"""Metres: a waypoint nearer than this is passed over."""
RETRY = 0.5
"""Seconds between two attempts at the padding that is preferred, or at a route where none was."""
SLACK = 0.03
"""Metres that routes keep beyond the margin at least, for forecasts are judged conservatively."""
SPROUTS = 40
"""At each such attempt, this part of the tree's nodes is added, until they have doubled."""
NEWS = 0.3
"""Metres that the robot moves without a route before one is asked for again."""


@dataclass(eq=False)
class Navigator:
    """One robot's way through the world: `step` once a sample.

    Args:
        lower, upper: `[d]`, the arena.
        start: `[n]`, the state at rest where the robot is.
        goal: `[d]`.
        controller: drives the legs; `new_leg` is called here, `control` by whoever runs the loop.
        settings: numbers and rules.
        seed: of the planner's samples.

    Attributes:
        planner: RRT^X over what is known.
        replans: every time the planner was told of a change of the world or of its padding.
        phase, reason: as in the last `Order`.
        legs: how many were begun.
        largest_deviation: D_kin, metres.

    Raises:
        ValueError: if start or goal lie outside the arena.
    """

    lower: ArrayLike
    upper: ArrayLike
    start: Array
    goal: ArrayLike
    controller: LegController
    settings: NavigatorSettings = field(default_factory=NavigatorSettings)
    seed: int = 0

    def __post_init__(self) -> None:
        settings = self.settings
        self._world = SceneWorld(self.lower, self.upper)
        d = self._d = self._world.dimension
        self._goal = np.array(self.goal, dtype=float)
        foretell = settings.rules.foretell
        padding = settings.robot_radius + (settings.comfort if foretell else 0.0)
        self.planner = RRTX(
            self._world,
            self._goal,
            self.start[:d],
            settings.nodes,
            seed=self.seed,
            padding=padding,
            horizon=max(2 * padding, 1.5),
        )
        self.perceived = Perceived(
            self._goal, max(padding, SHORTEST), settings.perception_radius, settings.growth
        )
        self._foretold = ForetoldMotions(self.controller, self.perceived, settings, d)
        self.replans: list[Replan] = []
        self.phase, self.reason = Phase.LEARNING, ""
        self._update: Update = self.planner.construction
        self._leg: Leg | None = None
        self.legs = 0
        self.largest_deviation = 0.0
        self._reference = self.start.copy()
        self._retried = -np.inf
        self._asked: tuple[float, Array] | None = None

    @property
    def has_route(self) -> bool:
        """Whether the planner has a route now."""
        return self._update.route is not None

    def step(self, time: float, state: Array, sightings: Sequence[Sighting]) -> Order:
        """One sample: look, replan, and say where to go from `state` `[n]`."""
        if self.phase is Phase.ARRIVED:
            return self._order(state)
        position = state[: self._d]
        changed = self._look(time, position, sightings)
        if not self.controller.ready:
            return self._order(state)
        if np.linalg.norm(position - self._goal) <= self.settings.goal_tolerance:
            self.phase, self.reason = Phase.ARRIVED, ""
            self._send(time, state, self._at_rest(self._goal))
            return self._order(state)
        if self.settings.rules.padding is PaddingRule.LARGEST_DEVIATION:
            changed |= self._augment(time, state)
        else:
            self._choose_padding(time, changed)
        if self.settings.rules.waypoints is WaypointRule.MOVING:
            self._run_ahead(time, state)
        elif self.settings.rules.foretell:
            self._foretold_leg(time, state, changed)
        else:
            self._plain_leg(time, state, changed)
        return self._order(state)

    def _look(self, time: float, position: Array, sightings: Sequence[Sighting]) -> bool:
        """Tell the planner what changed and where the robot is. Whether the world changed."""
        changes = self.perceived.look(time, position, sightings)
        inside = np.clip(position, self._world.lower, self._world.upper)
        if not changes and self._update.route is None and self._asked is not None:
            # Asking anew why there is no route costs more than it tells while nothing happens.
            when, where = self._asked
            if time - when < RETRY and np.linalg.norm(inside - where) < NEWS:
                self.perceived.refresh(time)
                return False
            if self.planner.nodes < 2 * self.settings.nodes:
                # Perhaps there is a way that no edge of the tree takes.
                self.planner.grow(self.settings.nodes // SPROUTS)
        self._asked = time, inside
        self._change(
            time,
            bool(changes),
            add=[solid for _, solid in changes.add],
            remove=changes.remove,
            move=changes.move,
            robot=inside,
        )
        for (key, _), handle in zip(changes.add, self._update.handles, strict=True):
            self.perceived.remember(key, handle)
        self.perceived.refresh(time)
        return bool(changes)

    def _change(self, time: float, record: bool, **changes: object) -> None:
        self._update = update = self.planner.change(**changes)  # pyright: ignore[reportArgumentType]
        if record:
            causes = tuple(c for c in update.causes if c is not Cause.ROBOT)
            self.replans.append(
                Replan(time, causes, update.seconds, update.repaired, update.route is not None)
            )

    # The paper's rules.

    def _augment(self, time: float, state: Array) -> bool:
        """Lines 8 to 11 and 17 of Algorithm 1: D_rob, D_kin, and the augmentation (7)."""
        deviation = 0.0 if self._leg is None else self._leg.deviation(state)
        if deviation <= self.largest_deviation:
            return False
        self.largest_deviation = deviation
        self._change(time, True, padding=self.settings.robot_radius + deviation)
        return True

    def _plain_leg(self, time: float, state: Array, changed: bool) -> None:
        leg, route = self._leg, self._update.route
        if route is None:
            if self.phase is not Phase.STOPPED:
                self._send(time, state, self._at_rest(state[: self._d]))
            self._stop(str(self._update.blockage))
            return
        blocked = changed and leg is not None and not self._is_free(state, leg.waypoint)
        if self._leg_is_over(time, state) or self.phase is not Phase.DRIVING or blocked:
            self._send(time, state, self._at_rest(self._next_waypoint(route.points)))
        self._drive()

    def _leg_is_over(self, time: float, state: Array) -> bool:
        leg = self._leg
        if leg is None or time - leg.begun >= self.settings.horizon - 1e-9:
            return True
        last = np.array_equal(leg.waypoint[: self._d], self._goal)
        return not last and leg.arrived(state, self.settings.admissible_window)

    def _next_waypoint(self, points: Array) -> Array:
        """The route's first waypoint that is not too near, `[d]`."""
        away = np.linalg.norm(points[1:] - points[0], axis=1)
        far = np.flatnonzero(away >= SHORTEST)
        return points[1 + far[0]] if len(far) else points[-1]

    def _is_free(self, state: Array, waypoint: Array) -> bool:
        d = self._d
        line = state[None, :d], waypoint[None, :d]
        return bool(self._world.certify(*line, self.planner.padding)[0])

    # Ours.

    def _choose_padding(self, time: float, changed: bool) -> None:
        """Comfort where there is a route that has it, else what is necessary."""
        settings = self.settings
        comfort = settings.robot_radius + settings.comfort
        least = min(settings.least_padding + SLACK, comfort)
        blockage = self._update.blockage
        if blockage is not None and blockage.barrier is Barrier.PADDING:
            # The robot itself may stand a little within the padding.
            wanted = max(settings.robot_radius, min(least, 0.98 * blockage.largest_padding))
            if wanted < self.planner.padding - 1e-6:
                self._change(time, True, padding=wanted)
                self._retried = time
        elif self.planner.padding < comfort and time - self._retried >= RETRY:
            self._retried = time
            route = self._update.route
            self._change(time, changed, padding=comfort)
            if self._update.route is None and route is not None:
                self._change(time, changed, padding=least)

    def _run_ahead(self, time: float, state: Array) -> None:
        route = self._update.route
        if route is None:
            self._brake(time, state, str(self._update.blockage))
            return
        lead = self.settings.farthest
        # The first corner too: close to obstacles every chord past it may be barred.
        corner = min(float(np.linalg.norm(route.points[1] - route.points[0])), lead)
        ahead = along_route(route.points, np.append(SHARES * lead, corner))
        chosen = self._foretold.farthest_clear(state, ahead)
        if chosen is None:
            self._brake(time, state, "no way of driving on keeps clear of the obstacles")
            return
        self._pass_waypoints(time, state, chosen)
        self._reference = self._at_rest(chosen)
        self.controller.new_leg()
        self._drive()

    def _foretold_leg(self, time: float, state: Array, changed: bool) -> None:
        route, leg = self._update.route, self._leg
        if route is None:
            self._brake(time, state, str(self._update.blockage))
            return
        over = self._leg_is_over(time, state) or self.phase is not Phase.DRIVING
        if not over and leg is not None and not changed and not self.perceived.moving:
            return
        if not over and leg is not None and self._foretold.still_clear(time - leg.begun, state):
            return
        begin, end = state[: self._d], self._next_waypoint(route.points)
        chosen = self._foretold.farthest_clear(state, begin + SHARES[:, None] * (end - begin))
        if chosen is None:
            self._brake(time, state, "no way of driving on keeps clear of the obstacles")
            return
        self._send(time, state, self._at_rest(chosen))
        self._drive()

    def _brake(self, time: float, state: Array, reason: str) -> None:
        stopped = self.phase is Phase.STOPPED
        chosen = self._foretold.safest_stop(state, self._reference[: self._d], stopped)
        # While the robot stands, the horizon recedes whatever the rule: it may wait for long.
        self._send(time, state, self._at_rest(chosen), count=False)
        self._stop(reason)

    # Shared.

    def _pass_waypoints(self, time: float, state: Array, reference: Array) -> None:
        """With a moving reference a leg leads to where the reference was when the leg began.

        It ends within the window, measured in positions, or when the robot has come as far.
        """
        leg, d = self._leg, self._d
        if leg is not None and self.phase is Phase.DRIVING:
            whole = float(np.linalg.norm(leg.waypoint[:d] - leg.origin[:d]))
            left = float(np.linalg.norm(leg.waypoint[:d] - state[:d]))
            gone = float(np.linalg.norm(state[:d] - leg.origin[:d]))
            last = np.array_equal(leg.waypoint[:d], self._goal)
            if last or (left > self.settings.admissible_window * whole and gone < whole):
                return
        self._begin(time, state, self._at_rest(reference))

    def _send(self, time: float, state: Array, reference: Array, count: bool = True) -> None:
        self._reference = reference
        self._begin(time, state, reference, count)
        self.controller.new_leg()

    def _begin(self, time: float, state: Array, waypoint: Array, count: bool = True) -> None:
        self._leg = Leg(state.copy(), waypoint, self._d, time)
        self.legs += count

    def _drive(self) -> None:
        self.phase, self.reason = Phase.DRIVING, ""

    def _stop(self, reason: str) -> None:
        self.phase, self.reason = Phase.STOPPED, reason

    def _at_rest(self, position: Array) -> Array:
        return np.concatenate([position, np.zeros(len(self.start) - self._d)])

    def _order(self, state: Array) -> Order:
        deviation = 0.0
        if self._leg is not None and self.phase is Phase.DRIVING:
            deviation = self._leg.deviation(state)
            self.largest_deviation = max(self.largest_deviation, deviation)
        return Order(
            self._reference,
            self.phase,
            self.reason,
            self.legs,
            deviation,
            self.largest_deviation,
            self.planner.padding,
        )
