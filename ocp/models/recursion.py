"""Equations of motion by recursive Newton-Euler in CasADi, from a Drake plant's model data.

Out from the world: velocities and accelerations of every body; back in: the forces that they need
(Luh, Walker and Paul 1980). The generalised force is linear in the accelerations, so its Jacobian
in them is the mass matrix. The size grows with the number of joints, not exponentially.

All vectors are in the world frame. A joint moves frame M on the child relative to frame F on the
parent; its velocity is (turning v, sliding v) in F, both matrices constant in F.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    PlanarJoint,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RpyFloatingJoint,
    UniformGravityFieldElement,
    WeldJoint,
)

from ocp.models.equations_of_motion import (
    EquationsOfMotion,
    FramePoint,
    position_rates,
    symbols,
)

Array = NDArray[np.float64]


@dataclass(eq=False)
class _Motion:
    """A body's (or frame's) pose, velocity and acceleration in the world."""

    rotation: ca.SX
    position: ca.SX
    spin: ca.SX
    velocity: ca.SX
    turning: ca.SX
    acceleration: ca.SX

    def carried(self, pose: Any) -> "_Motion":
        """The motion of a frame fixed to this one at `pose`."""
        arm = self.rotation @ _column(pose.translation())
        return _Motion(
            self.rotation @ ca.DM(pose.rotation().matrix()),
            self.position + arm,
            self.spin,
            self.velocity + ca.cross(self.spin, arm),
            self.turning,
            self.acceleration
            + ca.cross(self.turning, arm)
            + ca.cross(self.spin, ca.cross(self.spin, arm)),
        )


def by_recursion(plant: MultibodyPlant, points: Sequence[FramePoint] = ()) -> EquationsOfMotion:
    """The equations of motion of a finalized plant.

    Joints may be weld, revolute, prismatic, planar and roll-pitch-yaw floating; forces gravity,
    joint damping and joint springs.

    Args:
        plant: finalized.
        points: frames whose velocities are wanted.

    Raises:
        ValueError: if the plant has a joint or a force of another kind; it is named.
    """
    n, k = plant.num_positions(), plant.num_velocities()
    q, v, rates = symbols("q", n), symbols("v", k), symbols("a", k)
    context = plant.CreateDefaultContext()
    zero = ca.SX.zeros(3, 1)
    world = _Motion(ca.SX.eye(3), zero, zero, zero, zero, zero)
    motions: dict[int, _Motion] = {int(plant.world_body().index()): world}
    order: list[tuple[Any, _Motion]] = []
    for joint in _outward(plant):
        parent = motions[int(joint.parent_body().index())]
        fixed = parent.carried(joint.frame_on_parent().GetFixedPoseInBodyFrame())
        at, to = joint.position_start(), joint.velocity_start()
        places = q[at : at + joint.num_positions()]
        speeds, gains = (x[to : to + joint.num_velocities()] for x in (v, rates))
        moved = _across(joint, fixed, places, speeds, gains)
        child = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        motions[int(joint.child_body().index())] = moved.carried(child)
        order.append((joint, moved))
    need = _needed(plant, context, order, motions, k)
    mass = ca.jacobian(need, rates)
    mass += ca.DM(np.diag(_reflected_inertia(plant, k)))
    bias = ca.substitute(need, rates, ca.SX.zeros(k, 1))
    force = _joint_forces(plant, q, v) - bias
    velocities = []
    for point in points:
        body = motions[int(point.frame.body().index())]
        motion = body.carried(point.frame.GetFixedPoseInBodyFrame())
        axis = motion.rotation[:, 2]
        velocities.append(ca.vertcat(ca.dot(axis, motion.spin), ca.dot(axis, motion.velocity)))
    return EquationsOfMotion(q, v, mass, force, position_rates(plant, q), tuple(velocities))


def _outward(plant: MultibodyPlant) -> list[Any]:
    """The joints, each after the one that carries its parent body."""
    left: list[Any] = [plant.get_joint(i) for i in plant.GetJointIndices()]
    known = {int(plant.world_body().index())}
    order = []
    while left:
        ready = [j for j in left if int(j.parent_body().index()) in known]
        if not ready:
            names = ", ".join(j.name() for j in left)
            raise ValueError(f"model: joints {names}: their parents do not hang on the world")
        for joint in ready:
            known.add(int(joint.child_body().index()))
            left.remove(joint)
        order += ready
    return order


def _axes(joint: Any) -> tuple[Array, Array]:
    """(turning, sliding), `[3, k]` each: the velocity of M in F is these times v."""
    none = np.zeros((3, 0))
    if isinstance(joint, WeldJoint):
        return none, none
    if isinstance(joint, RevoluteJoint):
        axis = np.array(joint.revolute_axis()).reshape(3, 1)
        return axis, np.zeros((3, 1))
    if isinstance(joint, PrismaticJoint):
        axis = np.array(joint.translation_axis()).reshape(3, 1)
        return np.zeros((3, 1)), axis
    if isinstance(joint, PlanarJoint):
        return np.diag([0.0, 0.0, 1.0]), np.diag([1.0, 1.0, 0.0])
    if isinstance(joint, RpyFloatingJoint):
        return np.eye(3, 6), np.eye(3, 6, 3)
    kind = type(joint).__name__
    raise ValueError(f"model: joint {joint.name()!r} is a {kind}, which is not supported")


def _placed(joint: Any, places: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Rotation and position of M in F."""
    if isinstance(joint, WeldJoint):
        pose: Any = joint.X_FM()
        return ca.SX(ca.DM(pose.rotation().matrix())), ca.SX(_column(pose.translation()))
    if isinstance(joint, RevoluteJoint):
        return _turned(joint.revolute_axis(), places[0]), ca.SX.zeros(3, 1)
    if isinstance(joint, PrismaticJoint):
        return ca.SX.eye(3), _column(joint.translation_axis()) * places[0]
    if isinstance(joint, PlanarJoint):
        return _turned((0, 0, 1), places[2]), ca.vertcat(places[:2], 0)
    roll, pitch, yaw = (places[i] for i in range(3))
    rotation = _turned((0, 0, 1), yaw) @ _turned((0, 1, 0), pitch) @ _turned((1, 0, 0), roll)
    return rotation, places[3:6]


def _column(vector: Any) -> ca.DM:
    return ca.DM(np.array(vector, dtype=float).reshape(-1, 1))


def _turned(axis: Any, angle: ca.SX) -> ca.SX:
    """The rotation about a unit axis (Rodrigues)."""
    x, y, z = (float(a) for a in axis)
    skew = ca.DM([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return ca.SX.eye(3) + ca.sin(angle) * skew + (1 - ca.cos(angle)) * (skew @ skew)


def _across(joint: Any, fixed: _Motion, places: ca.SX, speeds: ca.SX, gains: ca.SX) -> _Motion:
    """The motion of M from that of F."""
    turning, sliding = (fixed.rotation @ ca.DM(a) for a in _axes(joint))
    rotation, position = _placed(joint, places)
    arm = fixed.rotation @ position
    if not speeds.numel():
        speeds, gains, turning, sliding = ca.SX(1, 1), ca.SX(1, 1), ca.SX(3, 1), ca.SX(3, 1)
    spin, slide = turning @ speeds, sliding @ speeds
    return _Motion(
        fixed.rotation @ rotation,
        fixed.position + arm,
        fixed.spin + spin,
        fixed.velocity + ca.cross(fixed.spin, arm) + slide,
        fixed.turning + ca.cross(fixed.spin, spin) + turning @ gains,
        fixed.acceleration
        + ca.cross(fixed.turning, arm)
        + ca.cross(fixed.spin, ca.cross(fixed.spin, arm))
        + 2 * ca.cross(fixed.spin, slide)
        + sliding @ gains,
    )


def _needed(
    plant: MultibodyPlant,
    context: Any,
    order: list[tuple[Any, _Motion]],
    motions: dict[int, _Motion],
    k: int,
) -> ca.SX:
    """Generalised forces `k x 1` that the motion needs, gravity taken off."""
    gravity = _column(plant.gravity_field().gravity_vector())
    loads: dict[int, tuple[ca.SX, ca.SX]] = {}  # moment about the body's origin, and force
    for _, body in ((j, j.child_body()) for j, _ in order):
        motion = motions[int(body.index())]
        inertia = body.CalcSpatialInertiaInBodyFrame(context)
        mass = inertia.get_mass()
        if mass == 0:
            loads[int(body.index())] = (ca.SX.zeros(3, 1), ca.SX.zeros(3, 1))
            continue
        offset = np.array(inertia.get_com())
        arm = motion.rotation @ _column(offset)
        about = np.array(inertia.Shift(offset).CalcRotationalInertia().CopyToFullMatrix3())
        tensor = motion.rotation @ ca.DM(about) @ motion.rotation.T
        acceleration = (
            motion.acceleration
            + ca.cross(motion.turning, arm)
            + ca.cross(motion.spin, ca.cross(motion.spin, arm))
        )
        force = mass * (acceleration - gravity)
        moment = tensor @ motion.turning + ca.cross(motion.spin, tensor @ motion.spin)
        loads[int(body.index())] = (moment + ca.cross(arm, force), force)
    need = ca.SX.zeros(k, 1)
    for joint, moved in reversed(order):
        child, parent = (int(b.index()) for b in (joint.child_body(), joint.parent_body()))
        moment, force = loads[child]
        about_joint = moment + ca.cross(motions[child].position - moved.position, force)
        fixed = motions[parent].carried(joint.frame_on_parent().GetFixedPoseInBodyFrame())
        turning, sliding = (fixed.rotation @ ca.DM(a) for a in _axes(joint))
        for i in range(joint.num_velocities()):
            need[joint.velocity_start() + i] = ca.dot(turning[:, i], about_joint) + ca.dot(
                sliding[:, i], force
            )
        if parent in loads:
            above_moment, above = loads[parent]
            arm = motions[child].position - motions[parent].position
            loads[parent] = (above_moment + moment + ca.cross(arm, force), above + force)
    return need


def _joint_forces(plant: MultibodyPlant, q: ca.SX, v: ca.SX) -> ca.SX:
    """Damping and springs of the joints, `k x 1`."""
    force = ca.SX.zeros(plant.num_velocities(), 1)
    for index in plant.GetJointIndices():
        joint: Any = plant.get_joint(index)
        for i, damping in enumerate(joint.default_damping_vector()):
            force[joint.velocity_start() + i] -= float(damping) * v[joint.velocity_start() + i]
    from pydrake.multibody.tree import ForceElementIndex

    for i in range(plant.num_force_elements()):
        element: Any = plant.get_force_element(ForceElementIndex(i))
        if isinstance(element, UniformGravityFieldElement):
            continue
        if isinstance(element, RevoluteSpring):
            rest, stiffness = element.default_nominal_angle(), element.default_stiffness()
        elif isinstance(element, PrismaticSpring):
            rest, stiffness = element.nominal_position(), element.stiffness()
        else:
            kind = type(element).__name__
            raise ValueError(f"model: force element {i} is a {kind}, which is not supported")
        joint = element.joint()
        force[joint.velocity_start()] -= stiffness * (q[joint.position_start()] - rest)
    return force


def _reflected_inertia(plant: MultibodyPlant, k: int) -> Array:
    """`[k]`, inertia of the rotors as their joints feel it."""
    inertia = np.zeros(k)
    for index in plant.GetJointActuatorIndices():
        actuator: Any = plant.get_joint_actuator(index)
        reflected = actuator.default_gear_ratio() ** 2 * actuator.default_rotor_inertia()
        inertia[actuator.joint().velocity_start()] += reflected
    return inertia
