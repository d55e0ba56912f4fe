"""A robot: named coordinates and the control-affine dynamics x' = f(x) + G(x) u.

This is the only definition of a robot. Solvers, compiled kernels, simulators and networks all
derive what they need from the CasADi expressions held here.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Coordinate:
    """One state coordinate.

    `lower` and `upper` bound the domain of starts and grids; they are no state constraint.
    A `periodic` coordinate is identified modulo `upper - lower`.
    """

    name: str
    unit: str
    lower: float
    upper: float
    periodic: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lower) and np.isfinite(self.upper) and self.lower < self.upper):
            raise ValueError(
                f"coordinate {self.name!r}: bounds must be finite and increasing, "
                f"got [{self.lower}, {self.upper}]"
            )

    @property
    def extent(self) -> float:
        return self.upper - self.lower


@dataclass(frozen=True)
class Input:
    """One control input with its unit and what the actuator can do; by default anything."""

    name: str
    unit: str
    lower: float = -np.inf
    upper: float = np.inf

    def __post_init__(self) -> None:
        if not self.lower < self.upper:  # NaN fails too
            raise ValueError(
                f"input {self.name!r}: limits must be increasing, got [{self.lower}, {self.upper}]"
            )


@dataclass(frozen=True, eq=False)
class System:
    """A control-affine robot x' = f(x) + G(x) u with `n` states and `m` inputs.

    Attributes:
        name: registered name.
        coordinates: the `n` state coordinates, in order.
        inputs: the `m` inputs, in order.
        state: `n x 1` CasADi symbols in which the dynamics are written.
        drift: f, `n x 1`, in `state`.
        input_matrix: G, `n x m`, in `state`.
        position: indices of the coordinates in which goals and obstacles live.
        half_turn: index of a periodic coordinate such that a shift by half its period changes
            G's columns at most in sign. With no drift and a quadratic control cost the value is
            then unchanged by the shift. `None` if there is no such symmetry.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    inputs: tuple[Input, ...]
    state: ca.SX
    drift: ca.SX
    input_matrix: ca.SX
    position: tuple[int, ...]
    half_turn: int | None = None

    def __post_init__(self) -> None:
        n, m = len(self.coordinates), len(self.inputs)
        for label, expression, shape in (
            ("state", self.state, (n, 1)),
            ("drift", self.drift, (n, 1)),
            ("input_matrix", self.input_matrix, (n, m)),
        ):
            if expression.shape != shape:
                raise ValueError(
                    f"system {self.name!r}: {label} has shape {expression.shape}, expected {shape}"
                )
        if not self.position or any(not 0 <= i < n for i in self.position):
            raise ValueError(f"system {self.name!r}: position indices {self.position} out of range")
        if self.half_turn is not None and not self.coordinates[self.half_turn].periodic:
            raise ValueError(f"system {self.name!r}: half_turn coordinate must be periodic")

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.coordinates)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @cached_property
    def has_drift(self) -> bool:
        """Whether f is not identically zero."""
        return not bool(ca.simplify(self.drift).is_zero())

    @cached_property
    def dynamics(self) -> ca.Function:
        """CasADi function (x, u) -> x'."""
        u = ca.SX.sym("u", self.m)  # pyright: ignore[reportArgumentType]
        rate = self.drift + self.input_matrix @ u
        return ca.Function("dynamics", [self.state, u], [rate], ["x", "u"], ["rate"])

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the dynamics: two systems with equal fingerprints move alike."""
        return hashlib.sha256(self.dynamics.serialize().encode()).hexdigest()[:16]

    @cached_property
    def lower(self) -> NDArray[np.float64]:
        """`[n]` lower bounds of the domain."""
        return np.array([c.lower for c in self.coordinates])

    @cached_property
    def upper(self) -> NDArray[np.float64]:
        """`[n]` upper bounds of the domain."""
        return np.array([c.upper for c in self.coordinates])

    @cached_property
    def period(self) -> NDArray[np.float64]:
        """`[n]` periods; 0 where a coordinate is not periodic."""
        return np.array([c.extent if c.periodic else 0.0 for c in self.coordinates])

    def wrap(self, states: ArrayLike) -> NDArray[np.float64]:
        """States `[..., n]` with periodic coordinates brought into [lower, upper)."""
        wrapped = np.array(states, dtype=float)
        for i, c in enumerate(self.coordinates):
            if c.periodic:
                x = wrapped[..., i]
                outside = (x < c.lower) | (x >= c.upper)  # others keep their last bit
                wrapped[..., i] = np.where(outside, c.lower + np.mod(x - c.lower, c.extent), x)
        return wrapped

    def difference(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
        """a - b, `[..., n]`, the short way round in periodic coordinates."""
        gap = np.asarray(a, dtype=float) - np.asarray(b, dtype=float)
        for i, c in enumerate(self.coordinates):
            if c.periodic:
                gap[..., i] -= c.extent * np.round(gap[..., i] / c.extent)
        return gap

    def check_state(self, state: ArrayLike, field: str = "start") -> NDArray[np.float64]:
        """`state` as a finite float vector `[n]` inside the domain (periodic ones wrapped).

        Raises:
            ValueError: naming `field`, the value and what would be right.
        """
        vector = np.asarray(state, dtype=float)
        names = ", ".join(c.name for c in self.coordinates)
        if vector.shape != (self.n,):
            raise ValueError(
                f"{field}: {self.name} needs {self.n} numbers ({names}), got {vector.tolist()}"
            )
        if not np.isfinite(vector).all():
            raise ValueError(f"{field}: numbers must be finite, got {vector.tolist()}")
        vector = self.wrap(vector)
        for x, c in zip(vector, self.coordinates, strict=True):
            if not c.periodic and not c.lower <= x <= c.upper:
                raise ValueError(
                    f"{field}: {c.name} = {x:g} {c.unit} lies outside [{c.lower:g}, {c.upper:g}]"
                )
        return vector
