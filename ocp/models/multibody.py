"""A Drake MultibodyPlant, or a robot in SDF or URDF, as a System: the same dynamics, compiled.

State. Positions first: translations, then angles; then the velocities in the same order; within
each the plant's own order is kept. A free body moves in the chart of Drake's RpyFloatingJoint:
position and roll, pitch, yaw; it is singular at pitch +-pi/2, which the domain leaves out.

Inputs. The plant's joint actuators in their order, then the propellers. Effort limits become limits
of the inputs.

Left out: contact and joint stops (limits of joints become the domain of starts and grids).

Robot files are read by `plant_file`.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    WeldJoint,
)

from ocp.models.equations_of_motion import EquationsOfMotion, FramePoint
from ocp.models.plant_file import Thruster, load_plant
from ocp.models.symbolic_translation import by_symbols, robot_name
from ocp.system import Coordinate, Input, System

Array = NDArray[np.float64]
Dynamics = Callable[[MultibodyPlant, Sequence[FramePoint]], EquationsOfMotion]

LENGTH, SPEED, TURN_RATE = 5.0, 10.0, 10.0  # domain where nothing else is said: m, m/s, rad/s
PITCH = 0.49 * math.pi  # largest pitch of a free body


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
