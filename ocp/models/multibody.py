"""A Drake MultibodyPlant, or a robot in SDF or URDF, as a System: the same dynamics, compiled.

State. Positions first: translations, then angles; then the velocities in the same order; within
each the plant's own order is kept. A free body moves in the chart of Drake's RpyFloatingJoint:
position and roll, pitch, yaw; it is singular at pitch +-pi/2, which the domain leaves out.

Inputs. The plant's joint actuators in their order, then the propellers. Effort limits become limits
of the inputs.

Left out: contact and joint stops (limits of joints become the domain of starts and grids).

In a robot file, elements of the XML namespace "zermelo" say what SDF and URDF cannot; Drake ignores
them:
    <zermelo:propeller frame="left" moment_ratio="0.02" max_thrust="8"/>
        thrust along the z axis of a frame, from 0 to `max_thrust`; the moment about that axis is
        `moment_ratio` times the thrust (as in Drake's Propeller)
    <zermelo:domain coordinate="x" lower="-4" upper="4"/>
        the domain of one coordinate, by its name
"""

import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    WeldJoint,
)

from ocp.models.equations_of_motion import EquationsOfMotion, FramePoint
from ocp.models.symbolic_translation import by_symbols, robot_name
from ocp.system import Coordinate, Input, System

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Dynamics = Callable[[MultibodyPlant, Sequence[FramePoint]], EquationsOfMotion]

NAMESPACE = "{zermelo}"
LENGTH, SPEED, TURN_RATE = 5.0, 10.0, 10.0  # domain where nothing else is said: m, m/s, rad/s
PITCH = 0.49 * math.pi  # largest pitch of a free body


@dataclass(frozen=True)
class Thruster:
    """A propeller: its input is a thrust in newtons.

    Attributes:
        frame: name of the plant's frame along whose z axis it pushes.
        moment_ratio: moment about that axis over thrust, metres.
        max_thrust: newtons; the least is 0.
    """

    frame: str
    moment_ratio: float = 0.0
    max_thrust: float = math.inf


@dataclass(frozen=True, eq=False)
class MultibodyModel:
    """A plant and the System that moves alike.

    Attributes:
        plant: finalized.
        thrusters: its propellers.
        system: the same robot as a System.
        position_order, velocity_order: the plant's index of each position, each velocity of the
            System.
    """

    plant: MultibodyPlant
    thrusters: tuple[Thruster, ...]
    system: System
    position_order: tuple[int, ...]
    velocity_order: tuple[int, ...]

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """`[n]`, the plant's index of each state of the System."""
        k = len(self.position_order)
        return np.array([*self.position_order, *(k + i for i in self.velocity_order)])

    def to_drake(self, states: ArrayLike) -> Array:
        """The plant's [q, v] `[..., n]` of states `[..., n]`."""
        states = np.asarray(states, dtype=float)
        plain = np.empty_like(states)
        plain[..., self.order] = states
        return plain

    def from_drake(self, states: ArrayLike) -> Array:
        """States `[..., n]` of the plant's [q, v] `[..., n]`."""
        return np.asarray(states, dtype=float)[..., self.order]

    def diagram(self) -> Any:
        """The robot in Drake alone, its propellers Drake's: input "u" `[m]`, output "state" `[n]`.

        The state is in the plant's order. A copy of the plant is used.
        """
        from pydrake.math import RigidTransform
        from pydrake.multibody.plant import Propeller, PropellerInfo
        from pydrake.systems.framework import DiagramBuilder
        from pydrake.systems.primitives import Demultiplexer

        builder: Any = DiagramBuilder()
        plant = builder.AddSystem(self.plant.Clone())
        plant.set_name("plant")
        actuators, thrusters = plant.num_actuators(), len(self.thrusters)
        joints = plant.get_actuation_input_port()
        commands: Any = None
        if thrusters:
            rotors = builder.AddSystem(
                Propeller(
                    [
                        PropellerInfo(frame.body().index(), pose, 1.0, t.moment_ratio)
                        for t in self.thrusters
                        for frame in [plant.GetFrameByName(t.frame)]
                        for pose in [RigidTransform(frame.GetFixedPoseInBodyFrame())]
                    ]
                )
            )
            forces = plant.get_applied_spatial_force_input_port()
            builder.Connect(rotors.get_spatial_forces_output_port(), forces)
            builder.Connect(plant.get_body_poses_output_port(), rotors.get_body_poses_input_port())
            commands = rotors.get_command_input_port()
        if actuators and thrusters:
            split = builder.AddSystem(Demultiplexer([actuators, thrusters]))
            builder.Connect(split.get_output_port(0), joints)
            builder.Connect(split.get_output_port(1), commands)
            builder.ExportInput(split.get_input_port(), "u")
        else:
            builder.ExportInput(commands if thrusters else joints, "u")
        builder.ExportOutput(plant.get_state_output_port(), "state")
        return builder.Build()


def multibody_model(
    source: str | os.PathLike[str] | MultibodyPlant,
    *,
    name: str | None = None,
    dynamics: Dynamics = by_symbols,
    thrusters: Sequence[Thruster] = (),
    domain: dict[str, tuple[float, float]] | None = None,
) -> MultibodyModel:
    """A robot's System, exactly Drake's dynamics.

    Args:
        source: a file in SDF or URDF, or a finalized plant.
        name: of the System; by default the robot's.
        dynamics: `by_symbols`, Drake's own symbolic dynamics translated (small robots), or
            `recursion.by_recursion`, Newton-Euler from the model's data (any size).
        thrusters: propellers, beyond those the file names.
        domain: (lower, upper) of coordinates by their names, beyond those the file gives.

    Raises:
        ValueError: if the robot has something that cannot be taken along; it is named.
    """
    domain = dict(domain or {})
    if isinstance(source, MultibodyPlant):
        if not source.is_finalized():
            raise ValueError("model: the plant must be finalized (plant.Finalize())")
        plant = source
    else:
        plant, named, given = load_plant(source)
        thrusters = (*named, *thrusters)
        domain = given | domain
    for thruster in thrusters:
        if not plant.HasFrameNamed(thruster.frame):
            raise ValueError(f"propeller: there is no frame {thruster.frame!r}")
    if plant.num_constraints():
        raise ValueError("model: the plant has constraints between joints; none are supported")
    if not plant.num_velocities():
        raise ValueError("model: the robot cannot move, it has no degree of freedom")
    if not plant.num_actuators() and not thrusters:
        raise ValueError("model: the robot has no actuator and no propeller")
    name = name or robot_name(plant)
    coordinates = _coordinates(plant)
    translations = [c for c in coordinates if c.unit == "m"]
    angles = [c for c in coordinates if c.unit == "rad"]
    positions = [*translations, *angles]
    velocities = [_speed_of(plant, c) for c in positions]
    order = [c.index for c in positions]
    speed_order = [c.index for c in velocities]
    chosen = _bounded([*positions, *velocities], domain)
    equations = dynamics(plant, [FramePoint(plant.GetFrameByName(t.frame)) for t in thrusters])
    state, drift, matrix = _first_order(plant, equations, thrusters, order, speed_order)
    system = System(
        name=name,
        coordinates=chosen,
        inputs=_inputs(plant, thrusters),
        state=state,
        drift=drift,
        input_matrix=matrix,
        position=tuple(range(len(translations) or len(angles))),
    )
    return MultibodyModel(plant, tuple(thrusters), system, tuple(order), tuple(speed_order))


def multibody_system(source: str | os.PathLike[str] | MultibodyPlant, **options: Any) -> System:
    """The System of `multibody_model`."""
    return multibody_model(source, **options).system


def load_plant(
    path: str | os.PathLike[str],
) -> tuple[MultibodyPlant, tuple[Thruster, ...], dict[str, tuple[float, float]]]:
    """A finalized plant from an SDF or URDF file, the propellers and domains the file names.

    Free bodies get the roll-pitch-yaw chart.

    Raises:
        ValueError: if the file is not a robot.
        OSError: if it cannot be read.
    """
    path = Path(path)
    if path.suffix not in (".sdf", ".urdf"):
        raise ValueError(f"model: a robot file ends in .sdf or .urdf, got {path.name!r}")
    text = path.read_text(encoding="utf-8")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"model: {path.name} is no XML: {error}") from error
    thrusters = tuple(
        Thruster(
            _attribute(e, "frame"),
            _number(e, "moment_ratio", 0.0),
            _number(e, "max_thrust", math.inf),
        )
        for e in root.iter(f"{NAMESPACE}propeller")
    )
    domain = {
        _attribute(e, "coordinate"): (_number(e, "lower"), _number(e, "upper"))
        for e in root.iter(f"{NAMESPACE}domain")
    }
    plant = MultibodyPlant(0.0)
    try:
        Parser(plant).AddModelsFromString(_without_ours(root), path.suffix[1:])
    except RuntimeError as error:
        raise ValueError(f"model: {path.name}: {error}") from error
    children = {plant.get_joint(i).child_body().index() for i in plant.GetJointIndices()}
    for index in range(1, plant.num_bodies()):
        from pydrake.multibody.tree import BodyIndex

        body = plant.get_body(BodyIndex(index))
        if body.index() not in children:
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
    plant.Finalize()
    return plant, thrusters, domain


def _without_ours(root: ElementTree.Element) -> str:
    """The robot's XML without the elements that Drake does not know."""
    for parent in root.iter():
        for child in [c for c in parent if c.tag.startswith(NAMESPACE)]:
            parent.remove(child)
    ElementTree.register_namespace("drake", "drake.mit.edu")
    return ElementTree.tostring(root, encoding="unicode")


def _attribute(element: ElementTree.Element, name: str) -> str:
    value = element.get(name)
    if value is None:
        raise ValueError(f"model: <{element.tag.replace(NAMESPACE, 'zermelo:')}> lacks {name!r}")
    return value


def _number(element: ElementTree.Element, name: str, default: float | None = None) -> float:
    if default is not None and element.get(name) is None:
        return default
    text = _attribute(element, name)
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"model: {name}={text!r} must be a number") from None


@dataclass(frozen=True)
class _PlantCoordinate:
    """A position or velocity of the plant: its index there, and what a Coordinate needs."""

    index: int
    name: str
    unit: str
    lower: float
    upper: float
    periodic: bool
    joint: Any
    which: int


def _coordinates(plant: MultibodyPlant) -> list[_PlantCoordinate]:
    """The positions, in the plant's order."""
    names = plant.GetPositionNames(False)
    found = []
    for index in plant.GetJointIndices():
        joint: Any = plant.get_joint(index)
        lower, upper = joint.position_lower_limits(), joint.position_upper_limits()
        for i, unit in enumerate(_units(joint)):
            at = joint.position_start() + i
            low, high, periodic = float(lower[i]), float(upper[i]), False
            if not (math.isfinite(low) and math.isfinite(high)):
                if isinstance(joint, RpyFloatingJoint) and i == 1:
                    low, high = -PITCH, PITCH
                elif unit == "rad":
                    low, high, periodic = -math.pi, math.pi, True
                else:
                    low, high = -LENGTH, LENGTH
            found.append(_PlantCoordinate(at, names[at], unit, low, high, periodic, joint, i))
    return sorted(found, key=lambda c: c.index)


def _units(joint: Any) -> tuple[str, ...]:
    """The unit of each of a joint's positions."""
    units = {
        WeldJoint: (),
        RevoluteJoint: ("rad",),
        PrismaticJoint: ("m",),
        PlanarJoint: ("m", "m", "rad"),
        RpyFloatingJoint: ("rad", "rad", "rad", "m", "m", "m"),
    }
    for kind, unit in units.items():
        if isinstance(joint, kind):
            return unit
    if type(joint).__name__ == "QuaternionFloatingJoint":
        raise ValueError(
            f"model: body {joint.child_body().name()!r} floats on a quaternion; before "
            "plant.Finalize() add a RpyFloatingJoint from the world to it"
        )
    kind = type(joint).__name__
    raise ValueError(f"model: joint {joint.name()!r} is a {kind}, which is not supported")


def _speed_of(plant: MultibodyPlant, position: _PlantCoordinate) -> _PlantCoordinate:
    """The velocity that goes with a position: of these joints, the one of the same place."""
    joint, i = position.joint, position.which
    at = joint.velocity_start() + i
    low, high = (
        float(x[i]) for x in (joint.velocity_lower_limits(), joint.velocity_upper_limits())
    )
    reach = SPEED if position.unit == "m" else TURN_RATE
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = -reach, reach
    name = plant.GetVelocityNames(False)[at]
    return _PlantCoordinate(at, name, f"{position.unit}/s", low, high, False, joint, i)


def _bounded(
    found: list[_PlantCoordinate], domain: dict[str, tuple[float, float]]
) -> tuple[Coordinate, ...]:
    """Coordinates, with the bounds that were asked for."""
    names = [c.name for c in found]
    for name in domain:
        if name not in names:
            raise ValueError(f"domain: there is no coordinate {name!r}; known: {', '.join(names)}")
    made = []
    for c in found:
        lower, upper = domain.get(c.name, (c.lower, c.upper))
        made.append(Coordinate(c.name, c.unit, lower, upper, c.periodic and c.name not in domain))
    return tuple(made)


def _inputs(plant: MultibodyPlant, thrusters: Sequence[Thruster]) -> tuple[Input, ...]:
    found = []
    for index in plant.GetJointActuatorIndices():
        actuator: Any = plant.get_joint_actuator(index)
        unit = "N m" if isinstance(actuator.joint(), RevoluteJoint) else "N"
        limit = float(actuator.effort_limit())
        found.append(Input(actuator.name(), unit, -limit, limit))
    return (*found, *(Input(f"{t.frame} thrust", "N", 0.0, t.max_thrust) for t in thrusters))


def _first_order(
    plant: MultibodyPlant,
    equations: EquationsOfMotion,
    thrusters: Sequence[Thruster],
    order: list[int],
    speed_order: list[int],
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """State, drift and input matrix in the System's order."""
    e = equations
    columns: list[Any] = []
    if plant.num_actuators():
        columns.append(ca.DM(np.array(plant.MakeActuationMatrix())))
    for thruster, velocity in zip(thrusters, e.velocities, strict=True):
        # The power of a thrust is thrust times speed; so its column is the speed's gradient in v.
        along = ca.jacobian(velocity[1] + thruster.moment_ratio * velocity[0], e.v).T
        columns.append(along)
    solved = e.accelerations(ca.horzcat(e.force, *columns))
    position_rate = e.kinematics @ e.v
    drift = ca.vertcat(position_rate[order], solved[speed_order, 0])
    matrix = ca.vertcat(
        ca.SX.zeros(len(order), len(thrusters) + plant.num_actuators()), solved[speed_order, 1:]
    )
    drift, matrix = ca.cse([ca.densify(ca.simplify(drift)), ca.densify(ca.simplify(matrix))])
    return ca.vertcat(e.q[order], e.v[speed_order]), drift, matrix
