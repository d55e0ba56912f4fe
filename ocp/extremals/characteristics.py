"""Backward characteristics: extremals grown from the goal's boundary, no boundary value problem.

Every point of one is a state with the costate and cost of *an* extremal through it. Far from the
goal most are not globally optimal: hold them against a value before use.
"""

from dataclasses import dataclass

import numpy as np
from numba import int64, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.function_address import ADDRESSES, function_at
from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.extremals.hamiltonian_flow import INTEGERS, PROPAGATE, flow_layout
from ocp.extremals.shooting import shooting_addresses
from ocp.extremals.transversality import TERMINAL, goal_condition
from ocp.kernels import parameters
from ocp.query import Query

Array = NDArray[np.float64]
CUBE = float64[:, :, ::1]

propagate_at = function_at(PROPAGATE)
terminal_at = function_at(TERMINAL)


@dataclass(frozen=True)
class Characteristics:
    """`k` extremals that end on the goal's boundary, `s` points each, from the goal outward.

    Points after the `lengths[i]`-th of extremal i do not exist and are NaN.

    Attributes:
        times: `[k, s]`, seconds to the goal.
        states, costates: `[k, s, n]`.
        costs: `[k, s]`, cost-to-go along the extremal.
        lengths: `[k]`.
    """

    times: Array
    states: Array
    costates: Array
    costs: Array
    lengths: NDArray[np.int64]

    def points(self) -> tuple[Array, Array, Array]:
        """All points that exist: states `[p, n]`, costates `[p, n]`, costs `[p]`."""
        exists = np.isfinite(self.costs)
        return self.states[exists], self.costates[exists], self.costs[exists]


def backward_characteristics(
    query: Query,
    ends: ArrayLike,
    cost_limit: float,
    *,
    margin: float = 1.0,
    tolerance: float = 1e-10,
    max_points: int = 400,
) -> Characteristics:
    """The extremals that end at `ends`, backward until they cost more than `cost_limit`.

    Args:
        query: the query.
        ends: `[k, n]`, states on the goal's boundary (their positions are projected on it).
        cost_limit: an extremal ends with the first point that costs more.
        margin: it also ends with the first point that far outside the robot's domain, as a multiple
            of the coordinate's extent; periodic coordinates are not bounded.
        tolerance: of an integration step; its points are the steps of the integration.
        max_points: the most points of an extremal, the one on the boundary included.

    Raises:
        ValueError: if an argument does not fit.
    """
    system = query.system
    rows = np.array(np.atleast_2d(np.asarray(ends, dtype=float)), order="C")
    if rows.ndim != 2 or rows.shape[1] != system.n or not np.isfinite(rows).all():
        raise ValueError(f"ends: need finite states [k, {system.n}], got shape {rows.shape}")
    if not (np.isfinite(cost_limit) and cost_limit > 0):
        raise ValueError(f"cost_limit: must be a positive finite number, got {cost_limit}")
    if max_points < 2:
        raise ValueError(f"max_points: must be at least 2, got {max_points}")
    room = np.where(system.period > 0, np.inf, margin * (system.upper - system.lower))
    limits = np.concatenate([[cost_limit], system.lower - room, system.upper + room])
    record = np.full((len(rows), max_points, 2 * system.n + 2), np.nan)
    lengths = np.zeros(len(rows), dtype=np.int64)
    condition = goal_condition(query)
    _grow(
        condition.kind,
        shooting_addresses(query),
        parameters(query),
        flow_layout(query),
        condition.terms,
        rows,
        tolerance,
        limits,
        record,
        lengths,
    )
    n = system.n
    return Characteristics(
        record[..., 0], record[..., 1 : n + 1], record[..., n + 1 : -1], record[..., -1], lengths
    )


@compiled(
    types.void(
        *(int64, ADDRESSES, VECTOR, INTEGERS, VECTOR, MATRIX, float64, VECTOR, CUBE, int64[::1])
    )
)
def _grow(kind, functions, q, layout, terms, ends, tolerance, limits, record, lengths):
    n = layout[0]
    integrate = propagate_at(functions[3, 0], functions[3, 1])
    on_manifold = terminal_at(functions[4, 0], functions[4, 1])
    y, edge = np.zeros(2 * n + 1), np.empty((2 * n, n - 1))
    no_tangents, pace = np.empty((2 * n, 0)), np.zeros(1)
    for row in range(ends.shape[0]):
        if not on_manifold(kind, functions, q, layout, terms, ends[row], y[: 2 * n], edge):
            continue
        y[2 * n] = 0.0
        record[row, 0, 0] = 0.0
        record[row, 0, 1:] = y
        # So long a duration that a limit, or the end of the record, comes first.
        pace[0] = 0.0
        steps = record[row, 1:]
        integrate(functions, q, layout, y, no_tangents, -1e6, tolerance, pace, limits, steps)
        for point in range(record.shape[1]):
            if not np.isnan(record[row, point, 0]):
                lengths[row] += 1
