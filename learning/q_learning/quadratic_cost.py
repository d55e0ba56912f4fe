"""What a regulator is asked to minimise; all that a model-free learner is told."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.riccati import LinearQuadratic

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """x(T)'P_T x(T) + integral of x'M x + u'R u over the horizon T.

    P and K do not change when every term carries one half, as in Kontoudis et al., eq. (2).

    Attributes:
        M: `[n, n]`, symmetric positive semidefinite.
        R: `[m, m]`, symmetric positive definite.
        terminal: P_T `[n, n]`, symmetric positive semidefinite.
        horizon: T, seconds.

    Raises:
        ValueError: if a matrix has a wrong shape, is not finite or is not definite as stated, or
            the horizon is not positive and finite.
    """

    M: Array
    R: Array
    terminal: Array
    horizon: float

    def __post_init__(self) -> None:
        checked = _checked(self.M, self.R)
        object.__setattr__(self, "M", checked.M)
        object.__setattr__(self, "R", checked.R)
        try:
            terminal = _checked(self.terminal, self.R).M
        except ValueError as error:
            raise ValueError(str(error).replace("M:", "terminal:", 1)) from error
        if terminal.shape != checked.M.shape:
            raise ValueError(f"terminal: must have shape {checked.M.shape}, got {terminal.shape}")
        object.__setattr__(self, "terminal", terminal)
        if not (np.isfinite(self.horizon) and self.horizon > 0):
            raise ValueError(
                f"horizon: must be a positive finite number of seconds, got {self.horizon}"
            )

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.M)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.R)

    def with_constant(self) -> "QuadraticCost":
        """The same cost of the state [x, 1], whose last coordinate is free."""
        pad = ((0, 1), (0, 1))
        return QuadraticCost(np.pad(self.M, pad), self.R, np.pad(self.terminal, pad), self.horizon)


def _checked(M: ArrayLike, R: ArrayLike) -> LinearQuadratic:
    """M and R, checked where every linear-quadratic problem is; the dynamics are blank."""
    n, m = np.atleast_1d(M).shape[0], np.atleast_1d(R).shape[0]
    return LinearQuadratic(np.zeros((n, n)), np.zeros((n, m)), np.array(M), np.array(R))
