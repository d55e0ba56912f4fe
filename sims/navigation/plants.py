"""The linear robots that navigate, and what each of them assumes."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ocp.models.linear import double_integrator, rover, springless_rover
from ocp.riccati import linear_dynamics
from ocp.system import System

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plant:
    """x' = A x + B u; the first `dimension` states are the position.

    Attributes:
        name: as in the scenario file.
        A: `[n, n]`.
        B: `[n, m]`.
        dimension: d, of the position.
        anchored: the paper's simulation: the plant acts on the error, x' = A (x - x_r) + B u, so
            that whatever pulls it home pulls it to every waypoint instead (its (1) drops A x_r).
        probing: standard deviation of the input while it is learned, in the input's unit.
        behaviour_gain: `[m, n]`, the feedback while it is learned.
    """

    name: str
    A: Array
    B: Array
    dimension: int
    anchored: bool = False
    probing: float = 2.0
    behaviour_gain: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.behaviour_gain.size == 0:
            object.__setattr__(self, "behaviour_gain", np.zeros(self.B.T.shape))

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    def holding_input(self, state: Array) -> Array:
        """The input `[m]` that comes nearest to keeping the robot at `state` `[n]`."""
        if self.anchored:
            return np.zeros(self.m)
        return np.asarray(-np.linalg.lstsq(self.B, self.A @ state, rcond=None)[0], float)


def _plant(name: str, system: System, anchored: bool = False, probing: float = 2.0) -> Plant:
    A, B = linear_dynamics(system)
    return Plant(name, A, B, len(system.position), anchored, probing)


# Probing accelerates each of them by some 2 m/s^2, as a driver would who tries the pedals.
PLANTS: dict[str, Callable[[], Plant]] = {
    "rover": lambda: _plant("rover", rover(), True, 100.0),
    "rover-physical": lambda: _plant("rover-physical", rover(), False, 100.0),
    "springless-rover": lambda: _plant("springless-rover", springless_rover()),
    "double-integrator": lambda: _plant("double-integrator", double_integrator(2)),
    "double-integrator-3d": lambda: _plant("double-integrator-3d", double_integrator(3)),
}
"""`rover` is eq. (26) of Kontoudis, Xu and Vamvoudakis in error coordinates, as they simulated it;
`rover-physical` the same with its spring fixed to the origin."""
