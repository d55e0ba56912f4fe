"""M(q) v' = force(q, v) + B(q) u, q' = N(q) v: what a rigid-body robot is made of, in CasADi."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RpyFloatingJoint


@dataclass(frozen=True, eq=False)
class FramePoint:
    """A frame of the plant whose velocity along and about its z axis is wanted."""

    frame: Any


@dataclass(frozen=True, eq=False)
class EquationsOfMotion:
    """The equations of motion of a plant with `n` positions and `k` velocities.

    Attributes:
        q: `n x 1` symbols, positions in the plant's order.
        v: `k x 1` symbols, velocities in the plant's order.
        mass: M, `k x k`, symmetric positive definite.
        force: `k x 1`, applied forces less the Coriolis and centrifugal terms.
        kinematics: N, `n x k`.
        velocities: for each frame asked for, `2 x 1`: its angular and linear velocity in the world
            along its own z axis, linear in v.
    """

    q: ca.SX
    v: ca.SX
    mass: ca.SX
    force: ca.SX
    kinematics: ca.SX
    velocities: tuple[ca.SX, ...] = ()

    def accelerations(self, right_sides: ca.SX) -> ca.SX:
        """M^-1 times the columns of `right_sides` `k x c`, by M = L D L'."""
        k = self.v.numel()
        L, D = ca.SX.eye(k), ca.SX.zeros(k, 1)
        for j in range(k):
            D[j] = self.mass[j, j] - _weighted(L[j, :j], D[:j], L[j, :j])
            for i in range(j + 1, k):
                L[i, j] = (self.mass[i, j] - _weighted(L[i, :j], D[:j], L[j, :j])) / D[j]
        solution = ca.SX(right_sides)
        for i in range(k):
            for j in range(i):
                solution[i, :] -= L[i, j] * solution[j, :]
        for i in reversed(range(k)):
            solution[i, :] /= D[i]
            for j in range(i + 1, k):
                solution[i, :] -= L[j, i] * solution[j, :]
        return solution


def _weighted(a: ca.SX, weights: ca.SX, b: ca.SX) -> ca.SX:
    return ca.sum2(a * weights.T * b) if a.numel() else ca.SX(0)


def symbols(name: str, count: int) -> ca.SX:
    """A column of `count` CasADi symbols."""
    return ca.SX.sym(name, count)  # pyright: ignore[reportArgumentType]


def position_rates(plant: MultibodyPlant, q: ca.SX) -> ca.SX:
    """N `n x k`: the identity but for free bodies.

    Drake's own symbolic evaluation has none for them: it tests for the singularity in numbers.
    """
    N = ca.SX.zeros(plant.num_positions(), plant.num_velocities())
    for index in plant.GetJointIndices():
        joint: Any = plant.get_joint(index)
        at, to = joint.position_start(), joint.velocity_start()
        if isinstance(joint, RpyFloatingJoint):
            pitch, yaw = q[at + 1], q[at + 2]
            c, s = ca.cos(yaw), ca.sin(yaw)
            # The columns of its inverse are the axes about which roll, pitch and yaw turn.
            N[at : at + 3, to : to + 3] = ca.vertcat(
                ca.horzcat(c / ca.cos(pitch), s / ca.cos(pitch), 0),
                ca.horzcat(-s, c, 0),
                ca.horzcat(c * ca.tan(pitch), s * ca.tan(pitch), 1),
            )
            at, to = at + 3, to + 3
        for i in range(joint.position_start() + joint.num_positions() - at):
            N[at + i, to + i] = 1
    return N
