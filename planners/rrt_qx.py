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
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planners.blockage import Barrier
from planners.leg import Leg, along_route
from planners.leg_clearance import Surroundings
from planners.perceived import Perceived, Sighting
from planners.rrtx import RRTX, Cause, Update
from planners.world import SceneWorld

Array = NDArray[np.float64]

SHORTEST = 0.5
"""Metres: a waypoint nearer than this is passed over."""
SHARES = np.array([1.0, 0.85, 0.7, 0.57, 0.45, 0.35, 0.26, 0.19, 0.13, 0.08, 0.04])
"""Of the farthest reference, those that are tried."""
BRAKES = np.array([0.3, 0.15, 0.5, 0.0, 0.8, 1.2, -0.3, 1.8])
"""Seconds of the present velocity ahead: references that are tried to brake to."""
DIRECTIONS = 12
EVASIONS = (0.4, 1.2, 3.0)
"""Metres: how far away references are tried when braking alone is not enough."""
RETRY = 0.5
"""Seconds between two attempts at the padding that is preferred, or at a route where none was."""
SLACK = 0.03
"""Metres that routes keep beyond the margin at least, for forecasts are judged conservatively."""
SPROUTS = 40
"""At each such attempt, this part of the tree's nodes is added, until they have doubled."""
NEWS = 0.3
"""Metres that the robot moves without a route before one is asked for again."""


class LegController(Protocol):
    """What drives a leg: it is handed errors x - x_r and answers with inputs.

    Law: while `forecast` gives an answer, the robot does what it foretells.
    """

    @property
    def ready(self) -> bool:
        """Whether the robot may be sent anywhere; before, it is being learned where it stands."""
        ...

    def new_leg(self) -> None:
        """The error is measured from another reference from now on; the horizon begins anew."""
        ...

    def control(self, error: Array) -> Array:
        """The input `[m]` to hold until the next sample, at the error `[n]`."""
        ...

    def forecast(self, errors: Array, receding: bool) -> Array | None:
        """Positions `[c, k, d]`, a sample a period from now on, relative to the reference.

        From errors `[c, n]`, up to (almost) standstill, as if a leg began now. With `receding` the
        horizon begins anew at every sample. `None` if the controller cannot tell.
        """
        ...


class PaddingRule(Enum):
    """What obstacles are augmented by."""

    LARGEST_DEVIATION = "largest deviation so far"
    EACH_LEG = "each leg foretold"


class WaypointRule(Enum):
    """How the robot goes from one waypoint to the next."""

    WINDOW = "each until within its window"
    MOVING = "a reference that runs ahead"


class Phase(Enum):
    """What the robot is doing."""

    LEARNING = "learning where it stands"
    DRIVING = "driving"
    STOPPED = "stopped"
    ARRIVED = "arrived"


@dataclass(frozen=True)
class Rules:
    """Which of the paper's rules are kept."""

    padding: PaddingRule
    waypoints: WaypointRule

    @property
    def foretell(self) -> bool:
        """Whether they need a controller that can forecast."""
        return self.padding is PaddingRule.EACH_LEG


PAPER = Rules(PaddingRule.LARGEST_DEVIATION, WaypointRule.WINDOW)
FORETOLD = Rules(PaddingRule.EACH_LEG, WaypointRule.WINDOW)
FLOWING = Rules(PaddingRule.EACH_LEG, WaypointRule.MOVING)


@dataclass(frozen=True)
class NavigatorSettings:
    """A robot's numbers; lengths in metres, times in seconds.

    Attributes:
        sample_period: Delta t.
        horizon: T.
        admissible_window: rho.
        goal_tolerance: of the goal.
        perception_radius: how far the robot sees.
        robot_radius: of its body.
        rules: see the module.
        margin: kept between body and obstacles by every foretold motion.
        comfort: padding beyond the body that routes keep where there is room.
        lead: how far the reference runs ahead at most; by default three quarters of the perception.
        foresight: how long moving obstacles are extrapolated.
        growth: metres a second by which bodies are extended while they change their velocity.
        nodes: of the planner's tree.
    """

    sample_period: float = 0.05
    horizon: float = 10.0
    admissible_window: float = 0.15
    goal_tolerance: float = 0.25
    perception_radius: float = 8.0
    robot_radius: float = 0.0
    rules: Rules = FLOWING
    margin: float = 0.1
    comfort: float = 0.4
    lead: float | None = None
    foresight: float = 3.0
    growth: float = 0.5
    nodes: int = 2000

    @property
    def least_padding(self) -> float:
        return self.robot_radius + self.margin

    @property
    def farthest(self) -> float:
        return 0.75 * self.perception_radius if self.lead is None else self.lead


@dataclass(frozen=True)
class Replan:
    """The planner was told of a change.

    Attributes:
        time: seconds.
        causes: why.
        seconds: wall-clock time that the planner took.
        repaired: nodes whose cost-to-go was computed anew.
        route: whether there is one.
    """

    time: float
    causes: tuple[Cause, ...]
    seconds: float
    repaired: int
    route: bool


@dataclass(frozen=True, eq=False)
class Order:
    """What the controller is to do until the next sample.

    Attributes:
        reference: x_r `[n]`.
        phase: what the robot is doing.
        reason: why it stopped; empty unless it did.
        leg: number of the leg, from 1.
        deviation: D_rob, metres.
        largest_deviation: D_kin, metres.
        padding: of the planner, metres.
    """

    reference: Array
    phase: Phase
    reason: str
    leg: int
    deviation: float
    largest_deviation: float
    padding: float


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
        self.replans: list[Replan] = []
        self.phase, self.reason = Phase.LEARNING, ""
        self._update: Update = self.planner.construction
        self._leg: Leg | None = None
        self.legs = 0
        self.largest_deviation = 0.0
        self._reference = self.start.copy()
        self._retried = -np.inf
        self._told: Array | None = None
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
        chosen = self._farthest_clear(state, ahead)
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
        if not over and leg is not None and self._still_clear(time, state):
            return
        begin, end = state[: self._d], self._next_waypoint(route.points)
        chosen = self._farthest_clear(state, begin + SHARES[:, None] * (end - begin))
        if chosen is None:
            self._brake(time, state, "no way of driving on keeps clear of the obstacles")
            return
        self._send(time, state, self._at_rest(chosen))
        self._drive()

    def _still_clear(self, time: float, state: Array) -> bool:
        """Whether the rest of the leg's foretold motion is clear."""
        assert self._leg is not None
        assert self._told is not None
        done = round((time - self._leg.begun) / self.settings.sample_period)
        rest = self._told[min(done, len(self._told) - 1) :]
        return bool(self._clearances(rest[None])[0] >= self._needed(state))

    def _farthest_clear(self, state: Array, references: Array) -> Array | None:
        """The first of `references` `[c, d]` that is reached clear of everything, as foretold."""
        receding = self.settings.rules.waypoints is WaypointRule.MOVING
        paths = self._foretell(state, references, receding)
        settings = self.settings
        clear = self.perceived.surroundings.first_clear(
            paths, settings.sample_period, settings.foresight, self._needed(state)
        )
        if clear is None:
            return None
        self._told = paths[clear]
        return references[clear]

    def _brake(self, time: float, state: Array, reason: str) -> None:
        """Hold, brake or make way: the last reference if that is safe, else the safest other."""
        p, v = state[: self._d], state[self._d : 2 * self._d]
        needed = self._needed(state)
        body = self.settings.robot_radius
        held = self._reference[None, : self._d]
        references = np.concatenate([held, p + BRAKES[:, None] * v, p + self._evasions()])
        paths = self._foretell(state, references, True)
        clear = self._clearances(paths)
        ends = self._clearances(paths[:, -1:]) - body
        stay = self.settings.least_padding - body
        safe = clear >= needed
        roomy = safe & (ends >= stay)
        if self.phase is Phase.STOPPED and roomy[0]:
            chosen = 0
        elif roomy[1 : 1 + len(BRAKES)].any():
            # The brake that ends soonest: least motion beyond where the robot is.
            reach = np.linalg.norm(paths - p, axis=-1).max(axis=1)
            reach[~roomy] = np.inf
            chosen = 1 + int(np.argmin(reach[1 : 1 + len(BRAKES)]))
        elif roomy.any():
            far = np.linalg.norm(references - p, axis=1)
            chosen = int(np.argmin(np.where(roomy, far, np.inf)))
        else:
            # Nothing is safe: what keeps farthest from the obstacles, or leads away from them. What
            # moves is a guess that may not come true; what stands is not to be met for its sake.
            certain = self._clearances(paths, self.perceived.standing())
            spared = [certain >= needed, certain >= body, np.full(len(paths), True)]
            allowed = next(keeps for keeps in spared if keeps.any())
            worth = np.minimum(clear, needed) + 0.1 * np.minimum(ends, stay)
            chosen = int(np.argmax(np.where(allowed, worth, -np.inf)))
        # While the robot stands, the horizon recedes whatever the rule: it may wait for long.
        self._send(time, state, self._at_rest(references[chosen]), count=False)
        self._stop(reason)

    def _evasions(self) -> Array:
        """`[e, d]`, ways off in all directions."""
        if self._d == 2:
            turns = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
            rays = np.column_stack([np.cos(turns), np.sin(turns)])
        else:
            grid = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * self._d)).reshape(self._d, -1).T
            grid = grid[np.any(grid != 0, axis=1)]
            rays = grid / np.linalg.norm(grid, axis=1, keepdims=True)
        return np.concatenate([length * rays for length in EVASIONS])

    def _foretell(self, state: Array, references: Array, receding: bool) -> Array:
        """Positions `[c, k, d]` on the way to standstill at `references` `[c, d]`."""
        states = np.zeros((len(references), len(state)))
        states[:, : self._d] = references
        told = self.controller.forecast(state - states, receding)
        if told is None:
            raise ValueError(
                f"rules: {self.settings.rules.padding.value!r} needs a controller that can forecast"
            )
        return np.concatenate([told + references[:, None], references[:, None]], axis=1)

    def _clearances(self, paths: Array, obstacles: Surroundings | None = None) -> Array:
        """Least clearance `[c]` of motions `[c, k, d]` to `obstacles`, by default all."""
        settings = self.settings
        asked = self.perceived.surroundings if obstacles is None else obstacles
        return asked.clearances(
            paths, settings.sample_period, settings.foresight, settings.least_padding + 1.0
        )

    def _needed(self, state: Array) -> float:
        """Clearance that a motion has to keep: no less than now, if that is already too little."""
        here = self.perceived.clearance(state[: self._d])
        return max(self.settings.robot_radius, min(self.settings.least_padding, here - 1e-3))

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
