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
from ocp.compiled.jit import MATRIX, SCALAR, VECTOR, compiled
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
        rows = states.reshape(-1, system.n)
        grid = self.value.grid
        free = ~np.array(grid.periodic)
        rows = np.where(free, np.clip(rows, grid.lower, grid.upper), rows)
        inputs = np.empty((len(rows), system.m))
        _lookahead(rows, *self._arguments, self.value.flat, self._geometry, inputs)
        return inputs.reshape(*states.shape[:-1], system.m)

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
        MATRIX, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX
    )
)
def _lookahead(
    states, candidates, spread, rounds, functions, q, settings, values, geometry, inputs
):
    n, m, d = states.shape[1], inputs.shape[1], settings.shape[0] - 4
    state_cost = scalar_at(functions[1, 0], functions[1, 1])
    feedback = bellman_at(functions[6, 0], functions[6, 1])
    scratch = np.empty((SCRATCH_ROWS, max(2 * n, m)))
    for row in range(states.shape[0]):
        x, u = states[row], inputs[row]
        squared = 0.0
        for i in range(d):
            squared += (x[i] - settings[4 + i]) ** 2
        u[:] = np.nan
        if squared <= settings[3] ** 2:
            u[:] = 0.0
            continue
        feedback(
            x, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch
        )
        if settings[2] > 0.0:
            u *= np.sqrt(state_cost(x, q))
