"""Linear robots x' = A x + B u: integrators, and the rover of Kontoudis et al. (eq. 26)."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ocp.system import Coordinate, Input, System

AXES = ("x", "y", "z")


def linear_system(
    name: str,
    A: ArrayLike,
    B: ArrayLike,
    coordinates: tuple[Coordinate, ...],
    inputs: tuple[Input, ...],
    position: tuple[int, ...],
) -> System:
    """The robot x' = A x + B u, with A `[n, n]` and B `[n, m]`.

    Raises:
        ValueError: if A and B are not finite or their shapes do not fit.
    """
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    n, m = len(coordinates), len(inputs)
    if A.shape != (n, n) or B.shape != (n, m):
        raise ValueError(
            f"system {name!r}: A must be {n} x {n} and B {n} x {m}, got {A.shape} and {B.shape}"
        )
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise ValueError(f"system {name!r}: A and B must be finite")
    state = ca.SX.sym("x", n)  # pyright: ignore[reportArgumentType]
    drift = ca.sparsify(ca.DM(A)) @ state
    return System(name, coordinates, inputs, state, ca.densify(drift), ca.SX(ca.DM(B)), position)


def single_integrator(dimension: int) -> System:
    """p' = u in 1 to 3 dimensions: velocity is the input."""
    return linear_system(
        f"single-integrator-{dimension}d",
        np.zeros((dimension, dimension)),
        np.eye(dimension),
        _positions(dimension, 5.0),
        tuple(Input(f"{a} velocity", "m/s") for a in AXES[:dimension]),
        tuple(range(dimension)),
    )


def double_integrator(dimension: int) -> System:
    """p'' = u in 1 to 3 dimensions: acceleration is the input."""
    return _second_order(f"double-integrator-{dimension}d", dimension, 0.0, 0.0, 1.0, "m/s^2", 5.0)


def rover() -> System:
    """The rover of eq. (26): per axis p'' = -0.5 p - 1.125 p' + 0.025 f, force input.

    The term -0.5 p is a spring that pulls the rover back to the origin. Used in error coordinates,
    as the paper does, the spring is re-anchored at every waypoint.
    """
    return _second_order("rover", 2, -0.5, -1.125, 0.025, "N", 20.0)


def springless_rover() -> System:
    """The rover without its spring and with unit input gain: p'' = -1.125 p' + f."""
    return _second_order("springless-rover", 2, 0.0, -1.125, 1.0, "m/s^2", 20.0)


def _positions(dimension: int, bound: float) -> tuple[Coordinate, ...]:
    if dimension not in (1, 2, 3):
        raise ValueError(f"dimension must be 1, 2 or 3, got {dimension}")
    return tuple(Coordinate(a, "m", -bound, bound) for a in AXES[:dimension])


def _second_order(
    name: str, d: int, stiffness: float, damping: float, gain: float, unit: str, bound: float
) -> System:
    """p'' = stiffness p + damping p' + gain u on each of `d` axes; state [p, p']."""
    identity, zero = np.eye(d), np.zeros((d, d))
    velocities = tuple(Coordinate(f"{a} velocity", "m/s", -bound, bound) for a in AXES[:d])
    return linear_system(
        name,
        np.block([[zero, identity], [stiffness * identity, damping * identity]]),
        np.vstack([zero, gain * identity]),
        _positions(d, bound) + velocities,
        tuple(Input(f"{a} input", unit) for a in AXES[:d]),
        tuple(range(d)),
    )
