"""Navigation as one Drake Diagram: plants, controllers, eyes, planners and the scene."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value  # pyright: ignore[reportAttributeAccessIssue]
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import LinearSystem, Multiplexer

from planners.orders import Order, Phase
from planners.rrt_qx import Navigator
from sims.navigation.controllers import Driver
from sims.navigation.record import Recorder
from sims.navigation.scenario_file import Scenario
from sims.navigation.scene import Bodies, Eyes, Visitors, in_space

Array = NDArray[np.float64]

STEPS = 4
"""Integration steps (Runge-Kutta 3) a sample period. With the input held, a step of h has the error
(h s)^4/24 for a mode of rate s: 4e-8 at 2.5/s and 50/4 ms."""
LOST = 10.0
"""Sides of the arena: a robot that far away will not come back."""
IN_SIGHT = 200.0
"""Metres: obstacles farther away do not count as there."""


class PlannerSystem(LeafSystem):
    """The navigator, asked once a sample. Its memory is the Python object: one run each.

    Ports: inputs "state", "sightings"; output "order". The order is computed when the controller
    asks for it, so that planning and control happen at the same instant.
    """

    def __init__(self, navigator: Navigator, n: int, recorder: Recorder | None) -> None:
        super().__init__()
        self._navigator, self._recorder = navigator, recorder
        self._time, self._order, self.seconds = -1.0, None, 0.0
        self.DeclareVectorInputPort("state", n)
        self.DeclareAbstractInputPort("sightings", Value([]))
        self.DeclareAbstractOutputPort(
            "order", lambda: Value(None), self._plan, {self.all_sources_ticket()}
        )

    def _plan(self, context: Any, out: Any) -> None:
        now = context.get_time()
        if now != self._time:
            state: Any = self.get_input_port(0).Eval(context)
            sightings: Any = self.get_input_port(1).Eval(context)
            begun = time.perf_counter()
            self._order = self._navigator.step(now, np.array(state), sightings)
            self.seconds = time.perf_counter() - begun
            self._time = now
            if self._recorder is not None:
                self._recorder.look(now, np.array(state), self._navigator, self._order)
        out.set_value(self._order)


@dataclass(frozen=True, eq=False)
class Sample:
    """A robot at one sample.

    Attributes:
        time: seconds.
        state: `[n]`.
        order: what the navigator said.
        input: `[m]`, what the controller answered.
        seconds: wall-clock time of planner and controller, the learner in it, over the sample.
    """

    time: float
    state: Array
    order: Order
    input: Array
    seconds: float


class ControllerSystem(LeafSystem):
    """A driver that meets its plant once a (sub)sample.

    Ports: inputs "state", "order"; output "u": the input `[m]`, and what the plant is anchored to
    `[n]` (zero unless it is simulated in error coordinates).
    """

    def __init__(
        self, driver: Driver, planner: PlannerSystem, n: int, m: int, anchored: bool, period: float
    ) -> None:
        super().__init__()
        self._driver, self._planner, self._anchored = driver, planner, anchored
        self._period, self._calls = period, 0
        self._order: Order | None = None
        self.samples: list[Sample] = []
        self.DeclareVectorInputPort("state", n)
        self.DeclareAbstractInputPort("order", Value(None))
        held = self.DeclareDiscreteState(m + n)
        self.DeclarePeriodicDiscreteUpdateEvent(period / driver.substeps, 0.0, self._sample)
        self.DeclareStateOutputPort("u", held)

    def _sample(self, context: Context, discrete: Any) -> None:
        state = np.array(self.get_input_port(0).Eval(context))
        first = self._calls % self._driver.substeps == 0
        self._calls += 1
        if first:
            order: Any = self.get_input_port(1).Eval(context)
            self._order = order
        assert self._order is not None
        reference = self._order.reference
        begun = time.perf_counter()
        feedforward = self._driver.feedforward(reference)
        u = feedforward + self._driver.control(state - reference)
        seconds = time.perf_counter() - begun
        if first:
            seconds += self._planner.seconds
            self.samples.append(Sample(context.get_time(), state, self._order, u, seconds))
        else:
            last = self.samples[-1]
            self.samples[-1] = Sample(
                last.time, last.state, last.order, last.input, last.seconds + seconds
            )
        anchor = reference if self._anchored else np.zeros(len(state))
        discrete.get_mutable_vector().SetFromVector(np.concatenate([u, anchor]))


class Judge:
    """Looks at the plants at every integration step: collisions, clearances, the ways gone.

    Attributes:
        times: `[k]`.
        positions: `[k, robots, d]`.
        clearances: `[k, robots]`, metres between each body and what is nearest; infinite if
            nothing is in sight.
        hit: the robots that collided.
        lost: the robots that left the arena for good: ten sides away, or without a finite state.
    """

    def __init__(self, scenario: Scenario, diagram: Any, scene: Any, bodies: Bodies) -> None:
        self._scenario, self._diagram, self._scene = scenario, diagram, scene
        self._bodies = bodies
        self.times: list[float] = []
        self.positions: list[Array] = []
        self.clearances: list[Array] = []
        self.hit: set[int] = set()
        self.lost: set[int] = set()
        self._middle = (scenario.lower + scenario.upper) / 2
        self._leash = LOST * float((scenario.upper - scenario.lower).max())

    def look(self, context: Context) -> None:
        """Record the present instant."""
        query = self._scene.get_query_output_port().Eval(self._scene.GetMyContextFromRoot(context))
        states: Any = self._bodies.get_input_port(0).Eval(
            self._bodies.GetMyContextFromRoot(context)
        )
        d = self._scenario.dimension
        positions, clearances = [], []
        for number, robot in enumerate(self._scenario.robots):
            position = states[self._bodies.places[number]][:d]
            if not np.linalg.norm(position - self._middle) < self._leash:
                self.lost.add(number)
                return
            near = query.ComputeSignedDistanceToPoint(in_space(position), IN_SIGHT)
            away = [a.distance for a in near if self._bodies.keys.get(a.id_G) != number]
            clearance = min(away, default=np.inf) - robot.radius
            if clearance <= 0:
                self.hit.add(number)
            positions.append(position)
            clearances.append(clearance)
        self.times.append(context.get_time())
        self.positions.append(np.array(positions))
        self.clearances.append(np.array(clearances))


@dataclass(frozen=True, eq=False)
class Drive:
    """What happened.

    Attributes:
        samples: of each robot.
        judge: what was seen at every integration step.
        wall_seconds: of the whole simulation.
    """

    samples: list[list[Sample]]
    judge: Judge
    wall_seconds: float


def drive(
    scenario: Scenario,
    navigators: list[Navigator],
    drivers: list[Driver],
    stopping: Array,
    recorders: Sequence[Recorder | None],
) -> Drive:
    """Run a scenario in Drake, until all arrived, one collided or was lost, or time is up.

    Args:
        scenario: the world and its robots.
        navigators, drivers: of each robot; used up by the run.
        stopping: `[robots]`, seconds: stopping distance over speed, for obstacles that keep away.
        recorders: of each robot; `None` keeps nothing for pictures.
    """
    builder: Any = DiagramBuilder()
    scene = builder.AddSystem(SceneGraph())
    visitors = builder.AddSystem(Visitors(scenario, scene, stopping))
    bodies = builder.AddSystem(Bodies(scenario, scene))
    sizes = [robot.plant.n for robot in scenario.robots]
    together = builder.AddSystem(Multiplexer(sizes))
    for system in (visitors, bodies):
        builder.Connect(together.get_output_port(0), system.get_input_port(0))
        builder.Connect(system.GetOutputPort("poses"), scene.get_source_pose_port(system.source))
    plants, controllers = [], []
    for number, robot in enumerate(scenario.robots):
        plant, n, m = robot.plant, robot.plant.n, robot.plant.m
        # Inputs: u, and the state that the plant is anchored to: x' = A (x - anchor) + B u.
        matrices: tuple[Any, ...] = (
            np.array(plant.A),
            np.hstack([plant.B, -plant.A]),
            np.eye(n),
            np.zeros((n, m + n)),
        )
        body = builder.AddSystem(LinearSystem(*matrices))
        eyes = builder.AddSystem(Eyes(scenario, number, visitors, bodies))
        planner = builder.AddSystem(PlannerSystem(navigators[number], n, recorders[number]))
        controller = builder.AddSystem(
            ControllerSystem(drivers[number], planner, n, m, plant.anchored, scenario.sample_period)
        )
        builder.Connect(body.get_output_port(), together.get_input_port(number))
        builder.Connect(scene.get_query_output_port(), eyes.GetInputPort("scene"))
        builder.Connect(visitors.GetOutputPort("present"), eyes.GetInputPort("present"))
        builder.Connect(together.get_output_port(0), eyes.GetInputPort("states"))
        builder.Connect(body.get_output_port(), planner.GetInputPort("state"))
        builder.Connect(eyes.GetOutputPort("sightings"), planner.GetInputPort("sightings"))
        builder.Connect(body.get_output_port(), controller.GetInputPort("state"))
        builder.Connect(planner.GetOutputPort("order"), controller.GetInputPort("order"))
        builder.Connect(controller.GetOutputPort("u"), body.get_input_port())
        plants.append(body)
        controllers.append(controller)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    step = scenario.sample_period / STEPS
    ResetIntegratorFromFlags(simulator, "runge_kutta3", step)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context = simulator.get_mutable_context()
    for body, robot in zip(plants, scenario.robots, strict=True):
        body.GetMyMutableContextFromRoot(context).SetContinuousState(robot.at_rest(robot.start))
    judge = Judge(scenario, diagram, scene, bodies)

    def watch(root: Context) -> EventStatus:
        judge.look(root)
        if judge.hit:
            return EventStatus.ReachedTermination(diagram, "a robot collided")
        if judge.lost:
            return EventStatus.ReachedTermination(diagram, "a robot is lost")
        if all(n.phase is Phase.ARRIVED for n in navigators):
            return EventStatus.ReachedTermination(diagram, "every robot arrived")
        return EventStatus.DidNothing()

    begun = time.perf_counter()
    simulator.set_monitor(watch)
    simulator.Initialize()
    simulator.AdvanceTo(scenario.time_limit)
    simulator.clear_monitor()
    return Drive([c.samples for c in controllers], judge, time.perf_counter() - begun)
