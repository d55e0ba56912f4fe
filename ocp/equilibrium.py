"""Rest and its neighbourhood: equilibria of a robot, its linearisation, the regulator there."""

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.system import System

Array = NDArray[np.float64]

REST = 1e-9  # largest rate, relative to the drift's size, that counts as rest


def equilibrium_input(system: System, state: ArrayLike) -> Array:
    """The smallest input `[m]` that holds `system` at rest in `state` `[n]`.

    Raises:
        ValueError: if no input does; the rate that is left is named.
    """
    x = np.asarray(state, dtype=float)
    drift, matrix = (np.array(v) for v in _parts(system)(x))
    drift = drift[:, 0]
    u: Array = np.linalg.lstsq(matrix, -drift, rcond=None)[0].astype(float)
    left = drift + matrix @ u
    if np.abs(left).max() > REST * (1 + np.abs(drift).max()):
        worst = int(np.abs(left).argmax())
        coordinate = system.coordinates[worst]
        raise ValueError(
            f"goal.state: {system.name} cannot rest at {x.tolist()}: {coordinate.name} moves at "
            f"{left[worst]:.3g} {coordinate.unit}/s whatever the input"
        )
    return u


def linearise(system: System, state: ArrayLike, inputs: ArrayLike) -> tuple[Array, Array]:
    """A `[n, n]` and B `[n, m]`, the derivatives of x' at `state` `[n]` and `inputs` `[m]`."""
    A, B = _jacobians(system)(np.asarray(state, float), np.asarray(inputs, float))
    return np.array(A), np.array(B)


@lru_cache(maxsize=64)
def _parts(system: System) -> ca.Function:
    return ca.Function(
        "parts", [system.state], [ca.densify(system.drift), ca.densify(system.input_matrix)]
    )


@lru_cache(maxsize=64)
def _jacobians(system: System) -> ca.Function:
    u = ca.SX.sym("u", system.m)  # pyright: ignore[reportArgumentType]
    rate = system.drift + system.input_matrix @ u
    A = ca.densify(ca.jacobian(rate, system.state))
    return ca.Function("jacobians", [system.state, u], [A, ca.densify(system.input_matrix)])
