"""Drake's symbolic dynamics as CasADi expressions.

Drake evaluates a plant's mass matrix, forces and velocities on symbolic expressions; here those are
rewritten, operation by operation, in CasADi. Drake's expressions are trees that share nothing and
grow about fivefold with each joint of a chain in space, so this serves small robots; CasADi shares
the common parts again. Larger ones go by `recursion`, which builds the same functions from the
model's data.
"""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces_
from pydrake.symbolic import Expression, ExpressionKind, Variable

from ocp.models.equations_of_motion import (
    EquationsOfMotion,
    FramePoint,
    position_rates,
    symbols,
)

MAX_NODES = 100_000
MAX_CHAIN = 4

_FUNCTIONS = {
    ExpressionKind.Abs: ca.fabs,
    ExpressionKind.Acos: ca.acos,
    ExpressionKind.Asin: ca.asin,
    ExpressionKind.Atan: ca.atan,
    ExpressionKind.Atan2: ca.atan2,
    ExpressionKind.Cos: ca.cos,
    ExpressionKind.Cosh: ca.cosh,
    ExpressionKind.Div: lambda a, b: a / b,
    ExpressionKind.Exp: ca.exp,
    ExpressionKind.Log: ca.log,
    ExpressionKind.Max: ca.fmax,
    ExpressionKind.Min: ca.fmin,
    ExpressionKind.Sin: ca.sin,
    ExpressionKind.Sinh: ca.sinh,
    ExpressionKind.Sqrt: ca.sqrt,
    ExpressionKind.Tan: ca.tan,
    ExpressionKind.Tanh: ca.tanh,
}


class ExpressionTooLargeError(ValueError):
    """A robot whose symbolic dynamics are too large to be written out."""

    def __init__(self, robot: str, detail: str) -> None:
        super().__init__(
            f"model: the symbolic dynamics of {robot!r} are too large ({detail}); "
            "build it with dynamics=by_recursion"
        )


class _Translator:
    def __init__(self, robot: str, names: dict[int, ca.SX]) -> None:
        self.robot = robot
        self.names = names
        self.nodes = 0

    def __call__(self, value: Any) -> ca.SX:
        if isinstance(value, float | int):
            return ca.SX(value)
        self.nodes += 1
        if self.nodes > MAX_NODES:
            raise ExpressionTooLargeError(self.robot, f"over {MAX_NODES} operations")
        kind = value.get_kind()
        if kind == ExpressionKind.Constant:
            return ca.SX(value.Evaluate())
        if kind == ExpressionKind.Var:
            (variable,) = value.GetVariables()
            return self.names[variable.get_id()]
        arguments = [self(a) for a in value.Unapply()[1]]
        if kind == ExpressionKind.Add:
            return _total(arguments)
        if kind == ExpressionKind.Mul:
            product = arguments[0]
            for factor in arguments[1:]:
                product = product * factor
            return product
        if kind == ExpressionKind.Pow:
            base, exponent = arguments
            return base**2 if exponent.is_constant() and float(exponent) == 2 else base**exponent
        if kind not in _FUNCTIONS:
            raise ValueError(f"model: {self.robot!r} uses {kind}, which has no translation")
        return _FUNCTIONS[kind](*arguments)

    def column(self, values: Sequence[Any]) -> ca.SX:
        return ca.vertcat(*(self(value) for value in np.asarray(values).ravel()))


def _total(terms: list[ca.SX]) -> ca.SX:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def by_symbols(plant: MultibodyPlant, points: Sequence[FramePoint] = ()) -> EquationsOfMotion:
    """The equations of motion of a finalized plant, from Drake's own symbolic evaluation.

    Every force element is taken along: gravity, springs, joint damping.

    Args:
        plant: finalized.
        points: frames whose velocities are wanted.

    Raises:
        ExpressionTooLargeError: before long work, if the robot has too many joints in a chain.
    """
    robot = robot_name(plant)
    longest = longest_chain(plant)
    if longest > MAX_CHAIN:
        raise ExpressionTooLargeError(
            robot, f"{longest} moving joints in a chain, at most {MAX_CHAIN}"
        )
    n, k = plant.num_positions(), plant.num_velocities()
    q, v = symbols("q", n), symbols("v", k)
    drake_q = np.array([Variable(f"q{i}") for i in range(n)], dtype=object)
    drake_v = np.array([Variable(f"v{i}") for i in range(k)], dtype=object)
    names = {d.get_id(): q[i] for i, d in enumerate(drake_q)}
    names |= {d.get_id(): v[i] for i, d in enumerate(drake_v)}
    translate = _Translator(robot, names)

    symbolic: Any = plant.ToSymbolic()
    context = symbolic.CreateDefaultContext()
    symbolic.SetPositions(context, drake_q)
    symbolic.SetVelocities(context, drake_v)
    mass = translate.column(symbolic.CalcMassMatrix(context)).reshape((k, k))
    forces = MultibodyForces_[Expression](symbolic)
    symbolic.CalcForceElementsContribution(context, forces)
    still = np.array([Expression(0.0)] * k)
    force = -translate.column(symbolic.CalcInverseDynamics(context, still, forces))
    velocities = []
    for point in points:
        moving = symbolic.get_frame(point.frame.index()).CalcSpatialVelocityInWorld(context)
        pose = symbolic.get_frame(point.frame.index()).CalcPoseInWorld(context)
        axis = translate.column(pose.rotation().matrix()[:, 2])
        velocities.append(
            ca.vertcat(
                ca.dot(axis, translate.column(moving.rotational())),
                ca.dot(axis, translate.column(moving.translational())),
            )
        )
    return EquationsOfMotion(q, v, mass, force, position_rates(plant, q), tuple(velocities))


def robot_name(plant: MultibodyPlant) -> str:
    """The name of the last model instance that has bodies, or the plant's."""
    for instance in reversed(range(plant.num_model_instances())):
        from pydrake.multibody.tree import ModelInstanceIndex

        index = ModelInstanceIndex(instance)
        if instance > 1 and plant.GetBodyIndices(index):
            return plant.GetModelInstanceName(index)
    return plant.get_name() or "robot"


def longest_chain(plant: MultibodyPlant) -> int:
    """The most joints that move between the world and a body."""
    depth = {plant.world_body().index(): 0}
    joints: list[Any] = [plant.get_joint(i) for i in plant.GetJointIndices()]
    while joints:
        ready = [j for j in joints if j.parent_body().index() in depth]
        if not ready:
            break  # reversed joints: the other end hangs on the world
        for joint in ready:
            above = depth[joint.parent_body().index()]
            depth[joint.child_body().index()] = above + (joint.num_velocities() > 0)
            joints.remove(joint)
    return max([*depth.values(), len(joints)])
