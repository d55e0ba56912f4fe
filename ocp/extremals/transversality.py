"""Where extremals end: the transversality conditions, as a manifold of states and costates.

At the goal V counts the cost to the *first hit*. On the goal's boundary V = 0, so the costate is
normal to it, p = nu n, and H = 0 with the motion inward gives nu >= 0. Without drift
nu = 2 sqrt(W / (n' G R^-1 G' n)): nu vanishes with W, and the condition H = 0 is then degenerate,
but the manifold, written as nu of the state, is not. Where W is negligible all round the boundary
(GOAL_AT_REST), p = 0 is used instead: at a boundary where W = w that ends the motion early, at
H = w instead of 0, and costs of the order of w^1.5 too much.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import int64, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import state_costs
from ocp.compiled.function_address import ADDRESSES, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled
from ocp.extremals.hamiltonian_flow import INTEGERS
from ocp.query import Query

GOAL_AT_REST, GOAL_PUSHED, QUADRATIC, EXPONENTIAL = 0, 1, 2, 3

NEGLIGIBLE = 1e-8  # running cost on the goal's boundary; see above
# Just outside the goal, so that rounding cannot put the end where the goal cost is cut off.
BOUNDARY = 1.0 + 1e-11

kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)


@dataclass(frozen=True)
class Condition:
    """How extremals end.

    Attributes:
        kind: GOAL_AT_REST, GOAL_PUSHED, QUADRATIC or EXPONENTIAL.
        terms: the `terms` of `terminal_point`.
    """

    kind: int
    terms: NDArray[np.float64]

    @property
    def at_goal(self) -> bool:
        """Whether the motion ends on the goal's boundary, at a free time; else at a fixed time."""
        return self.kind in (GOAL_AT_REST, GOAL_PUSHED)


@lru_cache(maxsize=1024)
def goal_condition(query: Query) -> Condition:
    """On the goal's boundary: at rest where that is good enough, else pushed."""
    terms = np.array([*query.goal_position, query.goal.radius])
    lower, upper = query.input_bounds
    can_rest = not query.system.has_drift and (lower <= 0).all() and (upper >= 0).all()
    if can_rest and query.cost.state is None:
        states = np.zeros((512, query.system.n))
        states[:, : len(query.goal_position)] = goal_boundary(query, 512)
        if state_costs(query, states).max() < NEGLIGIBLE:
            return Condition(GOAL_AT_REST, terms)
    return Condition(GOAL_PUSHED, terms)


def quadratic_condition(reference: ArrayLike, matrix: ArrayLike) -> Condition:
    """Anywhere, at the terminal cost (x - c)' P (x - c): c `[n]`, P `[n, n]` symmetric."""
    terms = np.concatenate([np.ravel(reference), np.ravel(matrix)]).astype(float)
    return Condition(QUADRATIC, terms)


def exponential_condition(query: Query, steepness: float) -> Condition:
    """Anywhere, at the terminal cost exp(a (|p - x_g|^2 - r_g^2)), a = `steepness`."""
    terms = np.array([*query.goal_position, query.goal.radius, steepness])
    return Condition(EXPONENTIAL, terms)


def goal_boundary(query: Query, count: int) -> NDArray[np.float64]:
    """`count` points `[k, d]` spread over the boundary of the goal ball."""
    d = len(query.goal_position)
    k = np.arange(count)
    if d == 1:
        normals = np.where(k % 2 == 0, 1.0, -1.0)[:, None]
    elif d == 2:
        angles = 2 * np.pi * k / count
        normals = np.column_stack([np.cos(angles), np.sin(angles)])
    else:  # a spiral of equal areas (golden angle)
        height = 1.0 - (2.0 * k + 1.0) / count
        around = np.pi * (3.0 - np.sqrt(5.0)) * k
        width = np.sqrt(1.0 - height**2)
        normals = np.column_stack([width * np.cos(around), width * np.sin(around), height])
    return query.goal_position + query.goal.radius * BOUNDARY * normals


# The type of `terminal_point`
TERMINAL = types.FunctionType(
    types.boolean(int64, ADDRESSES, VECTOR, INTEGERS, VECTOR, VECTOR, VECTOR, MATRIX)
)


@compiled(types.boolean(int64, ADDRESSES, VECTOR, INTEGERS, VECTOR, VECTOR, VECTOR, MATRIX))
def terminal_point(kind, functions, q, layout, terms, end, z, tangents):
    """The terminal manifold at the state `end` `[n]`.

    Args:
        kind: GOAL_AT_REST: on the goal's boundary, p = 0. GOAL_PUSHED: on the goal's boundary,
            p = nu times the outward normal in the position coordinates, else 0, with nu >= 0 from
            H = 0 and moving inward. QUADRATIC: anywhere, p = the gradient of
            (x - c)' P (x - c). EXPONENTIAL: anywhere, p = the gradient of
            S = exp(a (|position - c|^2 - r^2)).
        functions, q, layout: as for `propagate`.
        terms: the goal's centre `[d]` and radius; or c `[n]` and P `[n, n]`; or c `[d]`, r and a.
        end: replaced by the nearest state on the manifold.
        z: filled with [x, p].
        tangents: `[2n, n - 1]` at the goal, else `[2n, n]`; filled with dz by the manifold's
            coordinates: turns of the normal, then the other coordinates.

    Returns:
        Whether there is such a point.
    """
    n, d = layout[0], layout[2]
    tangents[:] = 0.0
    z[n:] = 0.0
    if kind == QUADRATIC:
        for i in range(n):
            z[i] = end[i]
            tangents[i, i] = 1.0
            for j in range(n):
                z[n + i] += 2.0 * terms[n + n * i + j] * (end[j] - terms[j])
                tangents[n + i, j] = 2.0 * terms[n + n * i + j]
        return True
    if kind == EXPONENTIAL:
        exponent = -(terms[d] ** 2)
        for j in range(d):
            exponent += (end[j] - terms[j]) ** 2
        exponent *= terms[d + 1]
        if not exponent < 100.0:
            return False
        slope = 2.0 * terms[d + 1] * math.exp(exponent)
        for i in range(n):
            z[i] = end[i]
            tangents[i, i] = 1.0
        for i in range(d):
            z[n + i] = slope * (end[i] - terms[i])
            for j in range(d):
                tangents[n + i, j] = 2.0 * terms[d + 1] * z[n + i] * (end[j] - terms[j])
            tangents[n + i, i] += slope
        return True

    normal = np.empty(d)
    length = 0.0
    for j in range(d):
        normal[j] = end[j] - terms[j]
        length += normal[j] ** 2
    length = math.sqrt(length)
    if not length > 0.0:
        return False
    radius = terms[d] * BOUNDARY
    for j in range(d):
        normal[j] /= length
        end[j] = terms[j] + radius * normal[j]
    z[:n] = end

    # Householder: I - 2 v v' maps an axis to the normal, and the other axes to its tangents.
    axis = 0
    for j in range(d):
        if abs(normal[j]) > abs(normal[axis]):
            axis = j
    mirror = normal.copy()
    mirror[axis] += 1.0 if normal[axis] >= 0.0 else -1.0
    square = 0.0
    for j in range(d):
        square += mirror[j] ** 2
    column = 0
    for a in range(d):
        if a == axis:
            continue
        for j in range(d):
            unit = (1.0 if j == a else 0.0) - 2.0 * mirror[a] * mirror[j] / square
            tangents[j, column] = radius * unit
        column += 1
    for i in range(d, n):
        tangents[i, column] = 1.0
        column += 1
    if kind == GOAL_AT_REST:
        return True

    flow = kernel_at(functions[0, 0], functions[0, 1])
    hamiltonian = scalar_at(functions[2, 0], functions[2, 1])
    rate = np.empty(2 * n)
    # While no bound is active H(nu) = free + drift nu - bend nu^2: its decreasing root, stably.
    free = hamiltonian(z, q)
    flow(z, q, rate)
    drift = 0.0
    for j in range(d):
        drift += normal[j] * rate[j]
        z[n + j] = normal[j]
    flow(z, q, rate)
    bend = 0.5 * drift
    for j in range(d):
        bend -= 0.5 * normal[j] * rate[j]
    root = math.sqrt(max(drift * drift + 4.0 * bend * free, 0.0))
    if drift <= 0.0:
        push = 2.0 * free / (root - drift) if root - drift > 0.0 else np.inf
    else:
        push = (drift + root) / (2.0 * bend) if bend > 0.0 else np.inf
    # Newton on the concave H(nu): one step unless bounds are active.
    inward = 0.0
    for _ in range(60):
        if not push < 1e8:
            return False
        for j in range(d):
            z[n + j] = push * normal[j]
        flow(z, q, rate)
        inward = 0.0
        for j in range(d):
            inward += normal[j] * rate[j]
        if not inward < 0.0:
            if push == 0.0 or inward > 0.0:
                push = 2.0 * push + 1e-6
                continue
            return False
        change = hamiltonian(z, q) / inward
        push -= change
        if not abs(change) > 1e-14 * (1.0 + push):
            break
    for j in range(d):
        z[n + j] = push * normal[j]
    # d(nu) from dH = 0.
    for c in range(n - 1):
        for j in range(d):
            tangents[n + j, c] = push * tangents[j, c] / radius
        change = 0.0
        for i in range(n):
            change += rate[i] * tangents[n + i, c] - rate[n + i] * tangents[i, c]
        for j in range(d):
            tangents[n + j, c] -= normal[j] * change / inward
    return True
