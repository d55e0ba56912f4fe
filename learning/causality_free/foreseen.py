"""A layout of obstacles as a network sees it: the penalty foreseen along the regulator's motion.

From the offset e the linear regulator's closed loop moves on e^(At) e, which is linear in e. The
penalty summed over obstacles and integrated along that motion,

    J_s(e) = int_0^T sum_k phi_k(p(t); b / s^2) dt,   p(t) of e^(At) e,

with phi_k the running cost's penalty (`ocp.cost.circle_penalty`) at steepness b / s^2, is for s = 1
the first-order change of the value by the obstacles (their penalty along the motion that is optimal
without them). Wider ones, s > 1, and the same with p(t) - c_k in the integrand say on which side
the obstacles lie. All are sums over obstacles: any number of them, in any order. They are smooth,
their derivatives are exact, and they hardly change near the goal, where no penalty is.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ocp.cost import circle_penalty
from ocp.query import Query
from ocp.regulation import regulator

Array = NDArray[np.float64]

NODES = 48  # of the quadrature over time
DECAYS = 4.0  # of the regulator's slowest mode, that the time lasts
WIDTHS = (1.0, 1.6)
SIDES = 1.6  # width of the penalty in the integrals that tell sides
HALVES = (0.0, 0.25)  # the integrals start at these shares of the time


@dataclass(frozen=True, eq=False)
class _Flow:
    """Along the regulator's motion.

    Attributes:
        positions: `[t d, n]`, of unit offsets.
        weights: `[t, f]`, of the times in the integrals from each share of the time on.
        weighted: `[f, t d, n]`, positions times weights.
    """

    positions: Array
    weights: Array
    weighted: Array


@lru_cache(maxsize=256)
def _flow(query: Query) -> _Flow:
    lq = regulator(query).problem
    closed = lq.A - lq.B @ regulator(query).gain()
    times = np.linspace(0.0, DECAYS / regulator(query).decay_rate, NODES)
    rates, modes = np.linalg.eig(closed)
    inverse = np.linalg.inv(modes)
    place = list(query.system.position)
    moved = np.einsum("ij,tj,jk->tik", modes[place], np.exp(np.outer(times, rates)), inverse)
    simple = np.full(NODES, times[1])
    simple[[0, -1]] /= 2
    later = np.arange(NODES)[:, None] >= NODES * np.array(HALVES)
    weights = np.where(later, simple[:, None], 0.0)
    weighted = np.einsum("tf,tdn->ftdn", weights, moved.real)
    n = len(rates)
    return _Flow(
        moved.real.reshape(-1, n).copy(), weights, weighted.reshape(len(HALVES), -1, n).copy()
    )


def foreseen(query: Query, offsets: Array) -> tuple[Array, Array]:
    """Features `[k, f]` of offsets e `[k, n]` from the goal, and their derivatives `[k, n, f]`.

    None (f = 0) for a query without obstacles.
    """
    count, n = offsets.shape
    if not query.obstacles:
        return np.zeros((count, 0)), np.zeros((count, n, 0))
    flow, cost = _flow(query), query.cost
    p = (offsets @ flow.positions.T).reshape(count, NODES, -1)
    columns: list[Array] = []
    slopes: list[Array] = []

    def integrated(value: Array, slope: Array) -> None:
        """Features from an integrand `[k, t]` and its derivative by position `[k, t, d]`."""
        columns.extend((value @ flow.weights).T)
        slopes.extend(slope.reshape(count, -1) @ weighted for weighted in flow.weighted)

    for width in WIDTHS:
        integrand, by_place = np.zeros(p.shape[:2]), np.zeros_like(p)
        for gap, phi, sharp in _penalties(query, p, width):
            integrand += phi
            by_place -= 2 * sharp * phi[..., None] * gap
        integrated(integrand, by_place)
    for axis in range(p.shape[2]):
        integrand, by_place = np.zeros(p.shape[:2]), np.zeros_like(p)
        for gap, phi, sharp in _penalties(query, p, SIDES):
            integrand += phi * gap[..., axis]
            by_place -= 2 * sharp * (phi * gap[..., axis])[..., None] * gap
            by_place[..., axis] += phi
        integrated(integrand, by_place)
    return np.stack(columns, axis=-1) / cost.obstacle, np.stack(slopes, axis=-1) / cost.obstacle


def _penalties(query: Query, places: Array, width: float) -> list[tuple[Array, Array, float]]:
    """Of every obstacle: gap `[..., d]` from its centre, penalty `[...]`, steepness."""
    cost, found = query.cost, []
    sharp = cost.obstacle_steepness / width**2
    for o in query.obstacles:
        gap = places - np.array(o.center) + query.goal_position
        phi = circle_penalty((gap**2).sum(axis=-1), o.radius, cost.obstacle, sharp, np.exp)
        found.append((gap, phi, sharp))
    return found
