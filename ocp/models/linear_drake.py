"""Drake's LinearSystem and AffineSystem as Systems, and affine Systems as Drake's."""

from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.primitives import AffineSystem, LinearSystem

from ocp.system import Coordinate, Input, System

EXTENT = 10.0  # of the domain where nothing else is said


def from_affine(
    plant: AffineSystem | LinearSystem,
    name: str,
    coordinates: tuple[Coordinate, ...] | None = None,
    inputs: tuple[Input, ...] | None = None,
    position: tuple[int, ...] = (0,),
) -> System:
    """The System x' = A x + B u + f0 of a continuous Drake system.

    Args:
        plant: continuous, with states and inputs; its output equation plays no part.
        name: of the System.
        coordinates, inputs: by default x1, x2, ... and u1, u2, ... without units.
        position: the coordinates in which goals and obstacles live; they come first.

    Raises:
        ValueError: if the plant is in discrete time or has no state or no input.
    """
    if plant.time_period() != 0:
        raise ValueError(
            f"system {name!r}: must be continuous, its time period is {plant.time_period()} s"
        )
    A, B = np.array(plant.A()), np.array(plant.B())
    n, m = len(A), B.shape[1]
    if n == 0 or m == 0:
        raise ValueError(f"system {name!r}: needs a state and an input, has {n} and {m}")
    f0 = np.array(plant.f0()) if isinstance(plant, AffineSystem) else np.zeros(n)
    x = ca.SX.sym("x", n)  # pyright: ignore[reportArgumentType]
    rate = ca.sparsify(ca.DM(A)) @ x + ca.sparsify(ca.DM(f0))
    return System(
        name,
        coordinates or tuple(Coordinate(f"x{i + 1}", "1", -EXTENT, EXTENT) for i in range(n)),
        inputs or tuple(Input(f"u{i + 1}", "1") for i in range(m)),
        x,
        ca.densify(rate),
        ca.SX(ca.DM(B)),
        position,
    )


def to_affine(system: System) -> AffineSystem | LinearSystem:
    """The Drake system x' = A x + B u (+ f0), y = x, of a System that is affine.

    Raises:
        ValueError: if the System is not affine in its state.
    """
    A, B = ca.jacobian(system.drift, system.state), system.input_matrix
    depends = ca.which_depends(ca.vertcat(ca.vec(A), ca.vec(B)), system.state, 1, False)
    if any(depends):
        raise ValueError(f"system {system.name!r}: is not affine in its state")
    zero = np.zeros(system.n)
    matrices = ca.Function("matrices", [system.state], [A, B, system.drift])(zero)
    # Drake's stubs mistype matrices.
    values: list[Any] = [np.array(ca.densify(x)) for x in matrices]
    a, b, f0 = values
    outputs: list[Any] = [np.eye(system.n), np.zeros((system.n, system.m))]
    C, D = outputs
    if not f0.any():
        return LinearSystem(a, b, C, D)
    zero: Any = np.zeros(system.n)
    return AffineSystem(a, b, f0[:, 0], C, D, zero)
