"""The truth that robots drive in: obstacles that come, go and move in Drake's SceneGraph."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value  # pyright: ignore[reportAttributeAccessIssue]
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    QueryObject,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, LeafSystem

from planners.drake_geometry import drake_shape
from planners.perceived import Sighting
from planners.solids import Solid
from sims.navigation.scenario_file import Scenario
from sims.navigation.scenario_parts import Visitor, gap

Array = NDArray[np.float64]

_HIGH: Any = np.array([0.0, 0.0, 1e4])
AWAY = RigidTransform(_HIGH)
"""Where obstacles wait that are not there."""
ABSENT = -1.0
"""As the time of appearance: not there."""
LEAST_BODY = 1e-3
"""Metres: the body that others see of a robot without extent."""


def state_places(scenario: Scenario) -> list[slice]:
    """Where each robot's state is among those of all robots."""
    sizes = [robot.plant.n for robot in scenario.robots]
    return [slice(int(e) - s, int(e)) for s, e in zip(sizes, np.cumsum(sizes), strict=True)]


def in_space(position: Array) -> Any:
    """`[3]` from `[2 or 3]`."""
    out = np.zeros(3)
    out[: len(position)] = position
    return out


class Visitors(LeafSystem):
    """When each obstacle is there, and where: the scenario's script.

    An obstacle that is due keeps away while a robot is nearer than the scenario's
    `appearance_distance` and the robot's stopping distance.

    Ports: input "states" of all robots, one after the other; outputs "poses" for the scene and
    "present", the solids that are there now, by key (one that stands is the same object). Discrete
    state `[k]`: when each obstacle appeared, negative while it is not there.
    """

    def __init__(self, scenario: Scenario, graph: SceneGraph, stopping: Array) -> None:
        """`stopping` `[robots]`: seconds, the stopping distance over the speed."""
        super().__init__()
        self._scenario, self._stopping = scenario, stopping
        self.source = graph.RegisterSource("visitors")
        self._frames, self._here, self.keys = [], [], {}
        for key, visitor in enumerate(scenario.visitors):
            solid = visitor.solid
            frame = graph.RegisterFrame(self.source, GeometryFrame(f"visitor {key}"))
            rotation: Any = np.eye(3)
            rotation[: solid.dimension, : solid.dimension] = solid.rotation
            origin: Any = np.zeros(3)
            pose = RigidTransform(RotationMatrix(rotation), origin)
            instance = GeometryInstance(pose, drake_shape(solid), f"visitor {key}")
            instance.set_proximity_properties(ProximityProperties())
            self.keys[graph.RegisterGeometry(self.source, frame, instance)] = key
            self._frames.append(frame)
            self._here.append(RigidTransform(in_space(solid.center)))
        self._places = state_places(scenario)
        self.DeclareVectorInputPort("states", self._places[-1].stop)
        absent: Any = np.full(len(scenario.visitors), ABSENT)
        self._present = self.DeclareDiscreteState(absent)
        self.DeclareInitializationDiscreteUpdateEvent(self._turn)
        self.DeclarePeriodicDiscreteUpdateEvent(scenario.sample_period, 0.0, self._turn)
        self.DeclareAbstractOutputPort(
            "poses", lambda: Value(FramePoseVector()), self._poses, {self.all_sources_ticket()}
        )
        self.DeclareAbstractOutputPort(
            "present", lambda: Value({}), self._solids, {self.all_sources_ticket()}
        )

    def _solids(self, context: Any, out: Any) -> None:
        now = context.get_time()
        since = _values(context, self._present)
        every = enumerate(zip(self._scenario.visitors, since, strict=True))
        out.set_value({k: _moved(v, now - s) for k, (v, s) in every if s != ABSENT})

    def _turn(self, context: Context, discrete: Any) -> None:
        now = context.get_time()
        since = _values(context, self._present)
        states: Any = self.get_input_port(0).Eval(context)
        for key, visitor in enumerate(self._scenario.visitors):
            due = visitor.appears - 1e-9 <= now < visitor.vanishes - 1e-9
            if not due:
                since[key] = ABSENT
            elif since[key] == ABSENT and not self._in_the_way(visitor, states):
                since[key] = now
        discrete.set_value(self._present, since)

    def _in_the_way(self, visitor: Visitor, states: Array) -> bool:
        courtesy = self._scenario.appearance_distance
        if courtesy == 0:
            return False
        d = self._scenario.dimension
        for robot, place, seconds in zip(
            self._scenario.robots, self._places, self._stopping, strict=True
        ):
            state = states[place]
            stop = seconds * float(np.linalg.norm(state[d : 2 * d]))
            if gap(visitor.solid, state[:d]) - robot.radius < courtesy + stop:
                return True
        return False

    def _poses(self, context: Any, out: Any) -> None:
        now = context.get_time()
        since = _values(context, self._present)
        poses = out.get_mutable_value()
        for frame, visitor, here, begun in zip(
            self._frames, self._scenario.visitors, self._here, since, strict=True
        ):
            if begun == ABSENT:
                poses.set_value(frame, AWAY)
            elif visitor.moves:
                at = visitor.solid.center + visitor.velocity * (now - begun)
                poses.set_value(frame, RigidTransform(in_space(at)))
            else:
                poses.set_value(frame, here)


class Bodies(LeafSystem):
    """Where the robots' bodies are. Ports: input "states"; output "poses" for the scene."""

    def __init__(self, scenario: Scenario, graph: SceneGraph) -> None:
        super().__init__()
        self._d = scenario.dimension
        self.source = graph.RegisterSource("robots")
        self._frames, self.keys = [], {}
        for key, robot in enumerate(scenario.robots):
            frame = graph.RegisterFrame(self.source, GeometryFrame(f"robot {key}"))
            shape = Sphere(max(robot.radius, LEAST_BODY))
            instance = GeometryInstance(RigidTransform(), shape, f"robot {key}")
            instance.set_proximity_properties(ProximityProperties())
            self.keys[graph.RegisterGeometry(self.source, frame, instance)] = key
            self._frames.append(frame)
        self.places = state_places(scenario)
        self.width = self.places[-1].stop
        self.DeclareVectorInputPort("states", self.width)
        self.DeclareAbstractOutputPort(
            "poses", lambda: Value(FramePoseVector()), self._poses, {self.all_sources_ticket()}
        )

    def _poses(self, context: Any, out: Any) -> None:
        states: Any = self.get_input_port(0).Eval(context)
        poses = out.get_mutable_value()
        for frame, place in zip(self._frames, self.places, strict=True):
            poses.set_value(frame, RigidTransform(in_space(states[place][: self._d])))


class Eyes(LeafSystem):
    """Omnidirectional perception up to a radius, nothing hides anything.

    An obstacle is seen as soon as some part of it is within the radius, and then whole. Other
    robots are seen as balls.

    Ports: inputs "scene" (a QueryObject), "present" (solids by key) and "states" of all robots;
    output "sightings", a list of `Sighting`.
    """

    def __init__(self, scenario: Scenario, own: int, visitors: Visitors, bodies: Bodies) -> None:
        super().__init__()
        self._own, self._d = own, scenario.dimension
        self._radius = scenario.perception_radius
        self._robots = scenario.robots
        self._visitors, self._bodies = visitors.keys, bodies.keys
        self._places = bodies.places
        self.DeclareAbstractInputPort("scene", Value(QueryObject()))
        self.DeclareAbstractInputPort("present", Value({}))
        self.DeclareVectorInputPort("states", bodies.width)
        self.DeclareAbstractOutputPort(
            "sightings", lambda: Value([]), self._see, {self.all_sources_ticket()}
        )

    def _see(self, context: Any, out: Any) -> None:
        query: Any = self.get_input_port(0).Eval(context)
        present: Any = self.get_input_port(1).Eval(context)
        states: Any = self.get_input_port(2).Eval(context)
        position = states[self._places[self._own]][: self._d]
        seen = []
        for answer in query.ComputeSignedDistanceToPoint(in_space(position), self._radius):
            robot = self._bodies.get(answer.id_G)
            if robot is None:
                key = self._visitors[answer.id_G]
                if key in present:
                    seen.append(Sighting(key, present[key]))
            elif robot != self._own:
                body = max(self._robots[robot].radius, LEAST_BODY)
                center = states[self._places[robot]][: self._d]
                seen.append(Sighting(-1 - robot, Solid.ball(center, body), mobile=True))
        out.set_value(sorted(seen, key=lambda s: s.key))


def _values(context: Any, index: Any) -> Array:
    return np.array(context.get_discrete_state(index).value())


def _moved(visitor: Visitor, seconds: float) -> Solid:
    return visitor.solid.moved(visitor.velocity * seconds) if visitor.moves else visitor.solid
