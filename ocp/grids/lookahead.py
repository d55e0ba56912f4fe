"""Feedback on grid values: the gradient's input if a lookahead confirms it, else the lookahead's.

Reading the control off the nearest node cycles, and off the derivative of a multilinear value it
jumps from cell to cell. Differences over two cells give a gradient of second order, whose control
is the best where V is smooth. Where it is not, a lookahead decides: the best step of about one
cell, refined so that the control is not quantised, with the interpolated value at its end.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.function_address import ADDRESSES, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.compiled.kernel_call import KernelCall
from ocp.compiled.parameters import parameters
from ocp.grid import GridValue
from ocp.grids.bellman import (
    SCRATCH_ROWS,
    bellman_addresses,
    bellman_at,
    bellman_geometry,
    bellman_settings,
)
from ocp.grids.input_samples import sampled_inputs
from ocp.query import Query

CELLS = 1.0  # length of the lookahead; between 0.7 and 1.5 the closed loop's cost hardly changes
ROUNDS = 3  # of refinement

CUBE = float64[:, :, ::1]

kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)


@dataclass(frozen=True, eq=False)
class LookaheadPolicy:
    """u(x) = argmin over u of the cost of a step of about one cell, plus V at its end; or the input
    that minimises the Hamiltonian with V's gradient, where such a step confirms it.

    For a time-free query u has the size that is optimal, u' R u = W(x). The input is 0 in the goal,
    and where no step leads to a finite value (there V is infinite: the robot stands still). From
    outside the grid's box it steers as from the nearest point of the box.

    Attributes:
        query: the query that `value` solves.
        value: its value on a grid.
        margin: metres that the lookahead adds to the robot's radius around hard obstacles, since
            an input is held for a while; as long as the robot keeps that distance.
    """

    query: Query
    value: GridValue
    margin: float = 0.0

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        """Inputs `[..., m]` at states `[..., n]`.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        system = self.query.system
        states = np.asarray(states, dtype=float)
        if states.shape[-1:] != (system.n,):
            raise ValueError(f"states: expected [..., {system.n}], got shape {states.shape}")
        if not np.isfinite(states).all():
            raise ValueError("states: numbers must be finite")
        rows = np.require(states.reshape(-1, system.n), requirements=["C", "W"])
        inputs = np.empty((len(rows), system.m))
        _lookahead(rows, *self._arguments, self.value.flat, self._geometry, self._box, inputs)
        return inputs.reshape(*states.shape[:-1], system.m)

    def motions(
        self, goal: NDArray[np.float64], starts: NDArray[np.float64], step: float, most: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Rough closed loops into a ball of positions, all in one compiled call.

        Args:
            goal: the ball's centre and radius, `[d + 1]`.
            starts: `[k, n]`.
            step: length of a midpoint step; where time is free in the R-norm, else in seconds.
            most: number of steps after which a motion ends.

        Returns:
            States `[k, most + 1, n]`, inputs `[k, most, m]` and durations `[k, most]` of the steps
            between them, and the number of steps `[k]` to the first state in the ball; -1 where
            there is none (numbers behind it, or of such a motion, are not set).
        """
        count, (n, m) = len(starts), (self.query.system.n, self.query.system.m)
        path, inputs = np.empty((count, most + 1, n)), np.empty((count, most, m))
        durations, lengths = np.empty((count, most)), np.empty(count, dtype=np.int64)
        path[:, 0] = starts
        _drive(
            goal, step, *self._arguments, self.value.flat, self._geometry, self._box,
            path, inputs, durations, lengths,
        )  # fmt: skip
        return path, inputs, durations, lengths

    @cached_property
    def _box(self) -> NDArray[np.float64]:
        """Lower and upper bounds `[2, n]` that states are taken into, infinite where periodic."""
        grid = self.value.grid
        free = ~np.array(grid.periodic)
        return np.array([np.where(free, grid.lower, -np.inf), np.where(free, grid.upper, np.inf)])

    @property
    def kernel_call(self) -> KernelCall:
        """The one compiled function behind the policy."""
        return KernelCall(
            _lookahead, (), (*self._arguments, self.value.flat, self._geometry, self._box)
        )

    @cached_property
    def _arguments(self):
        query = self.query
        candidates, spread = sampled_inputs(query)
        settings = bellman_settings(query, CELLS)
        return candidates, spread, ROUNDS, bellman_addresses(query), parameters(query), settings

    @cached_property
    def _geometry(self) -> NDArray[np.float64]:
        return bellman_geometry(self.query, self.value.grid, self.margin)


@compiled(
    types.void(
        VECTOR, VECTOR, MATRIX, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR,
        VECTOR, MATRIX, MATRIX,
    )
)  # fmt: skip
def _input(
    x, u, scratch, candidates, spread, rounds, functions, q, settings, values, geometry, box, room
):
    """The policy's input `u` `[m]` at `x` `[n]`; `room` `[1, n]` is overwritten."""
    inside = room[0]
    squared = 0.0
    for i in range(x.shape[0]):
        inside[i] = min(max(x[i], box[0, i]), box[1, i])
    for i in range(settings.shape[0] - 4):
        squared += (inside[i] - settings[4 + i]) ** 2
    u[:] = np.nan
    if squared <= settings[3] ** 2:
        u[:] = 0.0
        return
    feedback = bellman_at(functions[6, 0], functions[6, 1])
    feedback(
        inside, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch
    )
    if settings[2] > 0.0:
        u *= np.sqrt(scalar_at(functions[1, 0], functions[1, 1])(inside, q))


@compiled(
    types.void(
        MATRIX, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX,
        MATRIX,
    )
)  # fmt: skip
def _lookahead(
    states, candidates, spread, rounds, functions, q, settings, values, geometry, box, inputs
):
    n, m = states.shape[1], inputs.shape[1]
    scratch, room = np.empty((SCRATCH_ROWS, max(2 * n, m))), np.empty((1, n))
    for row in range(states.shape[0]):
        _input(
            states[row], inputs[row], scratch, candidates, spread, rounds, functions, q, settings,
            values, geometry, box, room,
        )  # fmt: skip


@compiled(
    types.void(
        VECTOR, float64, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR,
        MATRIX, CUBE, CUBE, MATRIX, types.int64[::1],
    )
)  # fmt: skip
def _drive(
    goal, step, candidates, spread, rounds, functions, q, settings, values, geometry, box,
    path, inputs, durations, lengths,
):  # fmt: skip
    """Fills the last four but `path[:, 0]`; see `LookaheadPolicy.motions`."""
    n, m, d = path.shape[2], inputs.shape[2], goal.shape[0] - 1
    dynamics = kernel_at(functions[0, 0], functions[0, 1])
    scratch, room = np.empty((SCRATCH_ROWS, max(2 * n, m))), np.empty((1, n))
    rate, half = np.empty(n), np.empty(n)
    for row in range(path.shape[0]):
        lengths[row] = -1
        for k in range(path.shape[1]):
            x = path[row, k]
            squared = 0.0
            for i in range(d):
                squared += (x[i] - goal[i]) ** 2
            if squared <= goal[d] ** 2:
                lengths[row] = k
                break
            if k == inputs.shape[1] or not squared < np.inf:
                break
            u = inputs[row, k]
            _input(
                x, u, scratch, candidates, spread, rounds, functions, q, settings, values,
                geometry, box, room,
            )  # fmt: skip
            h = step
            if settings[2] > 0.0:
                effort = 0.0
                for i in range(m):
                    effort += q[i] * u[i] ** 2
                h /= max(np.sqrt(effort), 1e-12)
            durations[row, k] = h
            dynamics(x, u, rate)
            for i in range(n):
                half[i] = x[i] + h / 2 * rate[i]
            dynamics(half, u, rate)
            for i in range(n):
                path[row, k + 1, i] = x[i] + h * rate[i]
