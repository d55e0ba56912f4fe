"""How an iteration for the values on a grid ended."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ocp.trajectory import SolveError, Status


@dataclass(frozen=True)
class FixedPoint:
    """Values on a grid, and the iteration that found them.

    Attributes:
        values: `[*grid.shape]`; infinite where no admissible motion was found.
        sweeps: passes over the grid; 1 for a single-pass method.
        updates: how often a node's value was computed.
        change: largest change of a value in the last sweep.
        tolerance: the iteration ends once no value changes by more.
    """

    values: NDArray[np.float64]
    sweeps: int
    updates: int
    change: float
    tolerance: float

    @property
    def status(self) -> Status:
        if not self.change <= self.tolerance:
            return Status.NOT_CONVERGED
        positive = self.values[self.values > 0]
        return Status.SOLVED if np.isfinite(positive).any() else Status.INFEASIBLE

    def checked(self) -> "FixedPoint":
        """Itself.

        Raises:
            SolveError: if the iteration did not converge, or nothing outside the goal reaches it.
        """
        if self.status is not Status.SOLVED:
            detail = f"{self.sweeps} sweeps, last change {self.change:.3g}"
            raise SolveError(self.status, detail)
        return self
