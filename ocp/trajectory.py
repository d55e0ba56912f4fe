"""Trajectories, and how a solve ended."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray


class Status(Enum):
    """How a solve ended; the text says what to do about it."""

    SOLVED = "solved"
    NOT_CONVERGED = "the iteration did not converge: give a better guess or more iterations"
    WRONG_EXTREMAL = "converged to an extremal that does not reach the goal: give another guess"
    NOT_APPLICABLE = "the method does not apply to this query: choose another method"
    INFEASIBLE = "no admissible motion was found: check hard obstacles and input bounds"
    DID_NOT_REACH = "the closed loop did not reach the goal in the time allowed"
    TIME_LIMIT = "the time limit ended the solve: allow more time"


class SolveError(RuntimeError):
    """A solve that did not succeed; `status` says how it ended."""

    def __init__(self, status: Status, detail: str = "") -> None:
        self.status, self.detail = status, detail
        super().__init__(f"{status.value}{': ' + detail if detail else ''}")

    def __reduce__(self) -> tuple[type["SolveError"], tuple[Status, str]]:
        """Made again from what it was made of, so that it travels between processes."""
        return SolveError, (self.status, self.detail)


@dataclass(frozen=True)
class Trajectory:
    """A motion on a time grid of `k` points.

    Attributes:
        times: `[k]`, seconds, from 0.
        states: `[k, n]`; periodic coordinates unwrapped, so that they are continuous.
        inputs: `[k, m]`.
        costates: `[k, n]`, grad V along an optimal motion; `None` if the method has none.
        cost_so_far: `[k]`, the running cost accumulated from the start.
        status: how the solve that made it ended.
    """

    times: NDArray[np.float64]
    states: NDArray[np.float64]
    inputs: NDArray[np.float64]
    costates: NDArray[np.float64] | None
    cost_so_far: NDArray[np.float64]
    status: Status = Status.SOLVED

    @property
    def start(self) -> NDArray[np.float64]:
        return self.states[0]

    @property
    def cost(self) -> float:
        """Total running cost; on an optimal motion, V at the start."""
        return float(self.cost_so_far[-1])

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @property
    def cost_to_go(self) -> NDArray[np.float64]:
        """`[k]`, the cost from each point to the end; V along an optimal motion."""
        return self.cost_so_far[-1] - self.cost_so_far
