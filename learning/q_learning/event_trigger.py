"""Regulation that renews its input only when the state has drifted past a trigger.

Kontoudis, Xu and Vamvoudakis, "Online, model-free motion planning in dynamic environments: an
intermittent, finite horizon approach with continuous-time Q-learning", ACC 2020, drive the legs by
an event-triggered form of the law. The condition used here is derived, so nothing rests on a
reading of theirs. With V = x'P x on the differential Riccati equation and any input u, let
d = u + K x be its distance from the optimal one. Completing the square,

    dV/dt = -(x'M x + u'R u) + d'R d,

so the cost exceeds the optimum by exactly the integral of d'R d, and while

    d'R d <= s (x'M x + u'R u),    0 < s < 1,

V falls and the cost is at most V/(1 - s). `QuadraticTrigger` is this condition; the Q-function
supplies K(t), M and R are the user's, and A and B do not appear. `NormTrigger` is the coarser test
by norms that the event-triggered Q-learning literature states (Vamvoudakis and Ferraz, Automatica
2018): with the gap e = x_held - x, L = |K|, and 0 < b < 1,

    |e|^2 <= (1 - b^2) l_min(M)/(L^2 l_max(R)) |x|^2 + l_min(R)/(L^2 l_max(R)) |u|^2,

which implies d'R d <= (1 - b^2) x'M x + u'R u where K is constant. It needs M positive definite.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.learned_regulator import LearnedRegulator
from learning.q_learning.quadratic_cost import QuadraticCost

Array = NDArray[np.float64]


class Trigger(Protocol):
    """When the held input may no longer be held."""

    def is_due(self, x: Array, x_held: Array, u_held: Array, gain: Array) -> bool:
        """At state x `[n]`, input u `[m]` held since the state x_held, present gain K `[m, n]`."""
        ...


@dataclass(frozen=True, eq=False)
class QuadraticTrigger:
    """d'R d > share (x'M x + u'R u); the cost stays below V/(1 - share), 0 < share < 1."""

    cost: QuadraticCost
    share: float = 0.05

    def __post_init__(self) -> None:
        if not 0 < self.share < 1:
            raise ValueError(f"share: must lie in (0, 1), got {self.share}")

    def is_due(self, x: Array, x_held: Array, u_held: Array, gain: Array) -> bool:  # noqa: ARG002
        gap = u_held + gain @ x
        M, R = self.cost.M, self.cost.R
        return bool(gap @ R @ gap > self.share * (x @ M @ x + u_held @ R @ u_held))


@dataclass(frozen=True, eq=False)
class NormTrigger:
    """The test by norms of the literature; `decay` is b above."""

    cost: QuadraticCost
    decay: float = 0.9

    def __post_init__(self) -> None:
        if not 0 < self.decay < 1:
            raise ValueError(f"decay: must lie in (0, 1), got {self.decay}")

    @cached_property
    def _eigenvalues(self) -> tuple[float, float, float]:
        M, R = np.linalg.eigvalsh(self.cost.M), np.linalg.eigvalsh(self.cost.R)
        return float(M[0]), float(R[0]), float(R[-1])

    def is_due(self, x: Array, x_held: Array, u_held: Array, gain: Array) -> bool:
        least_M, least_R, largest_R = self._eigenvalues
        gap = x_held - x
        bound = (1 - self.decay**2) * least_M * (x @ x) + least_R * (u_held @ u_held)
        return bool(np.linalg.norm(gain, 2) ** 2 * largest_R * (gap @ gap) > bound)


@dataclass(eq=False)
class IntermittentController:
    """A learned regulator whose input is held until the trigger is due; looked at every sample.

    Attributes:
        regulator: the gains (without a constant term).
        trigger: when to renew.
        sample_period: seconds between two looks.
        updates, looks: how often the input was renewed, and how often it could have been.
    """

    regulator: LearnedRegulator
    trigger: Trigger
    sample_period: float
    updates: int = 0
    looks: int = 0
    clock: float = 0.0
    _held: tuple[Array, Array] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.regulator.affine:
            raise ValueError("regulator: the trigger is derived for a plant without constant term")

    def control(self, state: ArrayLike) -> Array:
        """The input `[m]` to hold until the next sample, at the state `[n]`."""
        x = np.asarray(state, dtype=float)
        gain = self.regulator.gain(self.clock)
        if self._held is None or self.trigger.is_due(x, *self._held, gain):
            self._held = x, -gain @ x
            self.updates += 1
        self.looks += 1
        self.clock += self.sample_period
        return self._held[1]

    def new_leg(self) -> None:
        """Renew at once: the state is measured from another waypoint."""
        self.clock = 0.0
        self._held = None
