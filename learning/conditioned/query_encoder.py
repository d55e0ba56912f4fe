"""What the conditioned network sees: a state and its query in coordinates that move with both.

V does not change when query and state are moved, turned by quarter turns (by any angle, if all
obstacles are circles) or when the robot is turned round (heading + pi). So the features are taken
in the frame that looks from the robot along the ray to the goal, and the heading enters by its
doubled angle. Reflection changes the sign of the features in `ODD_STATE` and `ODD_OBSTACLE`.

One kernel makes features and their derivatives, for training and for driving.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL_WITH_JACOBIAN, MATRIX, SCALAR, VECTOR, compiled
from ocp.grids.goal_look_up import VALUE_AND_GRADIENT, value_and_gradient
from ocp.grids.goal_table import GoalTable, goal_table, has_goal_table
from ocp.kernels import Kernels, kernels, parameters
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.trajectory import SolveError, Status

Floats = NDArray[np.float64]

REACH = 16.0  # metres from the goal up to which the value without obstacles is known
NEAREST = 1e-3
"""V without obstacles below which its logarithm is a feature no longer.

Hardly a state of the training lies nearer the goal. Extrapolated along the logarithm, the learned
factor might grow faster than V falls, and robots stop short.
"""
STATE_FEATURES, OBSTACLE_FEATURES = 9, 12
ODD_STATE, ODD_OBSTACLE = (1,), (1, 5, 8)

lookup_at = function_at(VALUE_AND_GRADIENT)
derivatives_at = function_at(KERNEL_WITH_JACOBIAN)
scalar_at = function_at(SCALAR)


def why_not_encodable(query: Query) -> str | None:
    """Why a query is none that the shipped networks can know, or `None` if they can.

    They know the unicycle without input bounds, the default cost, and soft circles and diamonds.
    """
    if query.model != "unicycle":
        return f"the networks are trained for the unicycle, not for {query.system.name}"
    if not isinstance(query.goal, Goal):
        return "the networks are trained for goals that are balls"
    if query.is_bounded:
        return "the networks are trained without input bounds"
    if query.hard_obstacles:
        return "the networks are trained without hard obstacles"
    if query.cost != paper_query((4.0, 4.0)).cost:
        return "the networks are trained for the default running cost"
    if any(o.shape == "polygon" for o in query.obstacles):
        return "the networks are trained with circles and diamonds, not with polygons"
    return None


@dataclass(frozen=True, eq=False)
class QueryEncoder:
    """Features of states for one query, and what the compiled network needs to make them.

    Attributes:
        query: what is encoded.
        table: the exact value without obstacles.
    """

    query: Query
    table: GoalTable

    @classmethod
    def of(cls, query: Query) -> "QueryEncoder":
        """The encoder of a query.

        Raises:
            SolveError: NOT_APPLICABLE, see `why_not_encodable`.
        """
        reason = why_not_encodable(query)
        if reason is None and not has_goal_table(query, REACH):
            reason = f"no table of the value without obstacles for radius {query.goal.radius:g}"
        if reason is not None:
            raise SolveError(Status.NOT_APPLICABLE, reason)
        return cls(query, goal_table(query, REACH))

    @cached_property
    def arguments(self) -> tuple[NDArray[np.intp], Floats, Floats, Floats, Floats, Floats]:
        """Addresses, table, its numbers, q, q without obstacles, obstacles `[o, 4]`."""
        obstacles = [
            [*o.center, o.radius, float(o.shape == "diamond")] for o in self.query.obstacles
        ]
        return (
            _addresses(kernels(self.query)),
            self.table.table,
            self.table.numbers,
            parameters(self.query),
            parameters(replace(self.query, obstacles=())),
            np.array(obstacles).reshape(-1, 4),
        )

    def encode(self, states: ArrayLike) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Features of states `[k, 3]` outside the goal, and their derivatives in the state.

        Returns:
            V and grad V without obstacles `[k, 4]`, state features `[k, s]` and their derivatives
            `[k, s, 3]`, obstacle features `[k, o, f]` and theirs `[k, o, f, 3]`.
        """
        rows = np.ascontiguousarray(states, dtype=float)
        count, o = len(rows), len(self.query.obstacles)
        free = np.empty((count, 4))
        features = np.empty((count, STATE_FEATURES))
        slopes = np.empty((count, STATE_FEATURES, 3))
        per_obstacle = np.empty((count, o, OBSTACLE_FEATURES))
        obstacle_slopes = np.empty((count, o, OBSTACLE_FEATURES, 3))
        _encode_rows(*self.arguments, rows, free, features, slopes, per_obstacle, obstacle_slopes)
        return free, features, slopes, per_obstacle, obstacle_slopes


@cache
def _addresses(of_query: Kernels) -> NDArray[np.intp]:
    lookup = addresses([value_and_gradient])
    derivatives, cost = of_query.state_cost_derivatives, of_query.state_cost
    return np.concatenate([lookup, addresses([derivatives]), addresses([cost])])


CUBE = types.Array(types.float64, 3, "C")


@compiled(types.UniTuple(types.float64, 2)(types.float64, types.float64))
def _doubled(c, s):
    """Cosine and sine of the doubled angle."""
    return c * c - s * s, 2.0 * c * s


_SIGNATURE = types.void(
    ADDRESSES, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, CUBE
)
ENCODE = types.FunctionType(_SIGNATURE)


@compiled(_SIGNATURE)
def encode_state(
    functions, table, numbers, q, bare, obstacles, x, free, features, slopes, per_obstacle,
    obstacle_slopes,
):  # fmt: skip
    """Fill free `[4]`, features `[s]`, slopes `[s, 3]` and the obstacles' at one state `[3]`."""
    lookup = lookup_at(functions[0, 0], functions[0, 1])
    derivatives = derivatives_at(functions[1, 0], functions[1, 1])
    cost = scalar_at(functions[2, 0], functions[2, 1])
    gx, gy = numbers[0] - x[0], numbers[1] - x[1]
    rho = max(math.hypot(gx, gy), 1e-9)
    ex, ey = gx / rho, gy / rho
    nx, ny = -ey, ex
    hx, hy = math.cos(x[2]), math.sin(x[2])
    c, s = hx * ex + hy * ey, hx * nx + hy * ny  # of the heading against the ray to the goal
    turn_x, turn_y = ey / rho, -ex / rho  # derivatives of the ray's bearing
    cos2, sin2 = c * c - s * s, 2.0 * c * s
    gap = max(rho - numbers[2], 0.0)
    lookup(table, numbers, x, free)

    # The state.
    slopes[:] = 0.0
    features[0], features[1], features[2] = cos2, sin2, abs(c)
    side = 1.0 if c >= 0.0 else -1.0
    for k, slope in ((0, -2.0 * sin2), (1, 2.0 * cos2), (2, -side * s)):
        slopes[k, 0], slopes[k, 1], slopes[k, 2] = -slope * turn_x, -slope * turn_y, slope
    features[3] = rho
    slopes[3, 0], slopes[3, 1] = -ex, -ey
    features[4] = math.log(gap + 0.1)
    slopes[4, 0], slopes[4, 1] = -ex / (gap + 0.1), -ey / (gap + 0.1)
    features[5] = numbers[2]
    features[6] = math.log(max(free[0], NEAREST) + 1e-3)
    if free[0] > NEAREST:
        for i in range(3):
            slopes[6, i] = free[1 + i] / (free[0] + 1e-3)
    # W with all obstacles, and by how much they raise it.
    gradient, hessian = np.empty(3), np.empty((3, 3))
    derivatives(x, q, gradient, hessian)
    W = cost(x, q) + 0.02
    features[7] = math.log(W)
    slopes[7] = gradient / W
    derivatives(x, bare, gradient, hessian)
    bare_W = cost(x, bare) + 0.02
    features[8] = features[7] - math.log(bare_W)
    slopes[8] = slopes[7] - gradient / bare_W

    # The obstacles, each at (a, b) along and across the ray.
    cos4, sin4 = _doubled(*_doubled(ex, ey))
    for o in range(obstacles.shape[0]):
        f, df = per_obstacle[o], obstacle_slopes[o]
        df[:] = 0.0
        radius, diamond = obstacles[o, 2], obstacles[o, 3]
        dx, dy = obstacles[o, 0] - x[0], obstacles[o, 1] - x[1]
        a, b = dx * ex + dy * ey, dx * nx + dy * ny
        ax, ay = -ex + b * turn_x, -ey + b * turn_y
        bx, by = -nx - a * turn_x, -ny - a * turn_y
        f[0], f[1], f[2], f[3] = a, b, radius, diamond
        df[0, 0], df[0, 1], df[1, 0], df[1, 1] = ax, ay, bx, by
        # A diamond is turned against the ray.
        f[4], f[5] = diamond * cos4, diamond * sin4
        df[4, 0], df[4, 1] = -4.0 * f[5] * turn_x, -4.0 * f[5] * turn_y
        df[5, 0], df[5, 1] = 4.0 * f[4] * turn_x, 4.0 * f[4] * turn_y
        # Distance, and bearing against the heading, doubled.
        squared = dx * dx + dy * dy
        f[6] = math.sqrt(squared + 0.04)
        df[6, 0], df[6, 1] = -dx / f[6], -dy / f[6]
        p, r, size = dx * hx + dy * hy, dy * hx - dx * hy, squared + 0.1
        f[7], f[8] = (p * p - r * r) / size, 2.0 * p * r / size
        df[7, 0] = 2.0 * (-p * hx - r * hy + f[7] * dx) / size
        df[7, 1] = 2.0 * (-p * hy + r * hx + f[7] * dy) / size
        df[7, 2] = 4.0 * p * r / size
        df[8, 0] = 2.0 * (p * hy - r * hx + f[8] * dx) / size
        df[8, 1] = 2.0 * (-p * hx - r * hy + f[8] * dy) / size
        df[8, 2] = 2.0 * (r * r - p * p) / size
        # How deep the robot is in it: the obstacle's own norm.
        norm = abs(dx) + abs(dy) if diamond > 0.0 else math.sqrt(squared)
        f[9] = math.tanh(radius * radius - norm * norm)
        slope = 2.0 * (1.0 - f[9] * f[9])
        if diamond > 0.0:
            df[9, 0] = slope * norm * (1.0 if dx >= 0.0 else -1.0)
            df[9, 1] = slope * norm * (1.0 if dy >= 0.0 else -1.0)
        else:
            df[9, 0], df[9, 1] = slope * dx, slope * dy
        # Its distance from the goal, and from the straight way there.
        f[10] = math.hypot(obstacles[o, 0] - numbers[0], obstacles[o, 1] - numbers[1])
        beside, beside_x, beside_y = 0.0, 0.0, 0.0
        if a < 0.0:
            beside, beside_x, beside_y = a, ax, ay
        elif a > rho:
            beside, beside_x, beside_y = a - rho, ax + ex, ay + ey
        scale = 1.0 / (radius * radius)
        f[11] = math.exp(-(beside * beside + b * b) * scale)
        df[11, 0] = -2.0 * f[11] * scale * (beside * beside_x + b * bx)
        df[11, 1] = -2.0 * f[11] * scale * (beside * beside_y + b * by)


@compiled(
    types.void(
        ADDRESSES, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, CUBE, CUBE,
        types.Array(types.float64, 4, "C"),
    )
)  # fmt: skip
def _encode_rows(
    functions, table, numbers, q, bare, obstacles, states, free, features, slopes, per_obstacle,
    obstacle_slopes,
):  # fmt: skip
    for row in range(states.shape[0]):
        encode_state(
            functions, table, numbers, q, bare, obstacles, states[row], free[row], features[row],
            slopes[row], per_obstacle[row], obstacle_slopes[row],
        )  # fmt: skip
