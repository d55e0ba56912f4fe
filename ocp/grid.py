"""A regular grid over a box of states, and the multilinear value that lives on it."""

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.query import Query
from ocp.system import System

MAX_DIMENSION = 4
EDGE_TOLERANCE = 1e-9  # in cells: so close to a node is on it, so close to the box is inside

# (values `[nodes]`, geometry `[4n]`, point `[n]`) -> value: the type of `interpolate`
INTERPOLATION = types.FunctionType(float64(VECTOR, VECTOR, VECTOR))


@dataclass(frozen=True)
class Grid:
    """A regular grid in 1 to 4 dimensions, nodes in row-major order.

    An axis that is not periodic has its first node at `lower` and its last at `upper`. A periodic
    axis has `shape` nodes over its period `upper - lower` and does not repeat the end node.

    Attributes:
        lower, upper: `n` bounds each.
        shape: `n` numbers of nodes.
        periodic: `n` flags.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    shape: tuple[int, ...]
    periodic: tuple[bool, ...]

    def __post_init__(self) -> None:
        n = len(self.shape)
        if not 1 <= n <= MAX_DIMENSION:
            raise ValueError(f"grid.shape: needs 1 to {MAX_DIMENSION} axes, got {n}")
        for name in ("lower", "upper", "periodic"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"grid.{name}: needs {n} entries, got {len(getattr(self, name))}")
        bounds = np.array([self.lower, self.upper], dtype=float)
        if not (np.isfinite(bounds).all() and (bounds[0] < bounds[1]).all()):
            raise ValueError(
                f"grid: bounds must be finite and increasing, got {self.lower}, {self.upper}"
            )
        if min(self.shape) < 3:
            raise ValueError(f"grid.shape: an axis needs at least 3 nodes, got {self.shape}")

    @classmethod
    def of(
        cls, system: System, shape: tuple[int, ...], half_turn: bool = False, margin: float = 0.0
    ) -> "Grid":
        """The grid of `shape` over a robot's domain.

        Args:
            system: gives bounds and periodicity.
            shape: `n` numbers of nodes.
            half_turn: let the axis of the system's `half_turn` symmetry cover half its period
                (and be periodic with that): half the nodes for the same spacing. Only for values
                that have the symmetry, those of time-free queries.
            margin: metres added on every side of the position coordinates, since optimal motions
                may leave the box of starts.

        Raises:
            ValueError: if `shape` does not fit, or the system has no such symmetry.
        """
        if len(shape) != system.n:
            raise ValueError(f"grid.shape: {system.name} has {system.n} states, got {shape}")
        lower, upper = system.lower.copy(), system.upper.copy()
        lower[list(system.position)] -= margin
        upper[list(system.position)] += margin
        if half_turn:
            i = system.half_turn
            if i is None:
                raise ValueError(f"grid.half_turn: {system.name} has no half-turn symmetry")
            upper[i] = lower[i] + system.coordinates[i].extent / 2
        return cls(
            tuple(map(float, lower)),
            tuple(map(float, upper)),
            tuple(map(int, shape)),
            tuple(c.periodic for c in system.coordinates),
        )

    @classmethod
    def for_query(cls, query: Query, nodes: int, margin: float = 0.0) -> "Grid":
        """A grid of about `nodes` nodes that suits `query`.

        For a time-free query, a cell takes about the same effort to cross along every axis (for the
        unicycle, as many radians as metres), and a half-turn symmetry is used. Otherwise all axes
        have about the same number of nodes.

        Raises:
            ValueError: if the system has more than 4 states, or `nodes` is too small.
        """
        system = query.system
        half = query.is_time_free and system.half_turn is not None
        if system.n > MAX_DIMENSION:
            raise ValueError(f"grid: {system.name} has {system.n} states, at most {MAX_DIMENSION}")
        if nodes < 3**system.n:
            raise ValueError(f"grid.nodes: needs at least {3**system.n}, got {nodes}")
        box = cls.of(system, (3,) * system.n, half, margin)
        extent = np.subtract(box.upper, box.lower)
        effort = np.ones(system.n)
        if query.is_time_free:
            effort = extent / _axis_speeds(system, tuple(query.input_weights))
        # A periodic axis has as many cells as nodes, another one fewer.
        closed = 1.0 - np.array(box.periodic)

        def counts(density: float) -> NDArray[np.float64]:
            return np.maximum(density * effort + closed, 3.0)

        low, high = 0.0, nodes / effort.min()
        for _ in range(100):  # bisect the number of cells per unit of effort
            density = (low + high) / 2
            low, high = (low, density) if counts(density).prod() > nodes else (density, high)
        return cls.of(system, tuple(round(float(c)) for c in counts(low)), half, margin)

    # Derived numbers

    @property
    def dimension(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    @cached_property
    def spacing(self) -> NDArray[np.float64]:
        """`[n]` distances between neighbouring nodes."""
        cells = np.array(self.shape) - 1 + np.array(self.periodic)
        return np.subtract(self.upper, self.lower) / cells

    @cached_property
    def axes(self) -> tuple[NDArray[np.float64], ...]:
        """The nodes' coordinates along each axis."""
        rows = zip(self.lower, self.spacing, self.shape, strict=True)
        return tuple(low + h * np.arange(count) for low, h, count in rows)

    def nodes(self) -> NDArray[np.float64]:
        """`[*shape, n]` states of the nodes."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1)

    @cached_property
    def strides(self) -> NDArray[np.int64]:
        """`[n]` steps in the flat (row-major) index from a node to the next along each axis."""
        return np.array([int(np.prod(self.shape[i + 1 :])) for i in range(self.dimension)])

    @cached_property
    def geometry(self) -> NDArray[np.float64]:
        """`[4n]`: lower bounds, 1 / spacings, shape, periodic flags; what kernels are given."""
        rows = [self.lower, 1.0 / self.spacing, self.shape, self.periodic]
        return np.concatenate([np.asarray(row, dtype=float) for row in rows])

    def refined(self, factor: int = 2) -> "Grid":
        """The grid with spacings divided by `factor`; its nodes include this grid's."""
        rows = zip(self.shape, self.periodic, strict=True)
        shape = tuple(c * factor if p else (c - 1) * factor + 1 for c, p in rows)
        return Grid(self.lower, self.upper, shape, self.periodic)

    def contains(self, states: ArrayLike) -> Any:
        """Whether states `[..., n]` lie in the box, `[...]`; periodic axes hold everything."""
        states = np.asarray(states, dtype=float)
        slack = EDGE_TOLERANCE * self.spacing
        inside = (states >= self.lower - slack) & (states <= self.upper + slack)
        return np.all(inside | np.array(self.periodic), axis=-1)


@cache
def _axis_speeds(system: System, weights: tuple[float, ...]) -> NDArray[np.float64]:
    """`[n]` largest rate of each coordinate under inputs with u' R u = 1, no drift."""
    matrix = ca.Function("input_matrix", [system.state], [ca.densify(system.input_matrix)])
    rng = np.random.default_rng(0)
    states = rng.uniform(system.lower, system.upper, (64, system.n))
    rows = [np.array(matrix(x)) / np.sqrt(weights) for x in states]
    speeds = np.linalg.norm(rows, axis=2).max(axis=0)
    if not (speeds > 0).all():
        stuck = system.coordinates[int(speeds.argmin())].name
        raise ValueError(f"grid: no input of {system.name} moves {stuck}")
    return speeds


@dataclass(frozen=True, eq=False)
class GridValue:
    """A value on a grid, multilinear between the nodes.

    Attributes:
        grid: where the nodes are.
        values: `[*grid.shape]`, at the nodes; may be infinite, never NaN.

    Outside the box (along axes that are not periodic) the value is infinite: the grid knows nothing
    there. It is also infinite wherever a corner that counts is: a point next to a hard obstacle is
    not mixed from what lies behind it.
    """

    grid: Grid
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=float)
        if values.shape != self.grid.shape:
            raise ValueError(f"values: expected shape {self.grid.shape}, got {values.shape}")
        if np.isnan(values).any():
            raise ValueError("values: must not be NaN")
        object.__setattr__(self, "values", values)

    @cached_property
    def flat(self) -> NDArray[np.float64]:
        """`[nodes]`, the values in row-major order (a view)."""
        return self.values.reshape(-1)

    def value(self, states: ArrayLike) -> NDArray[np.float64]:
        """V `[...]` at states `[..., n]`.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        rows, shape = self._rows(states)
        out = np.empty(len(rows))
        _interpolate_rows(self.flat, self.grid.geometry, rows, out)
        return out.reshape(shape)

    def gradient(self, states: ArrayLike) -> NDArray[np.float64]:
        """The gradient `[..., n]` of V at states `[..., n]`, by differences of the interpolant.

        They reach a cell to both sides, which interpolates the nodes' central differences: of
        second order, exact for quadratic V, and continuous. (The interpolant's own derivative is of
        first order and jumps; a control read off it costs several times as much above the optimum.)
        At the box's edge and beside infinite values the difference is to one side, and 0 along an
        axis with infinite values to both. Outside the box it is that at the nearest point of it.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        rows, shape = self._rows(states)
        grid = self.grid
        free = ~np.array(grid.periodic)
        rows = np.where(free, np.clip(rows, grid.lower, grid.upper), rows)
        out = np.empty_like(rows)
        _gradient_rows(self.flat, grid.geometry, rows, out)
        return out.reshape(*shape, grid.dimension)

    def _rows(self, states: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
        states = np.asarray(states, dtype=float)
        n = self.grid.dimension
        if states.shape[-1:] != (n,):
            raise ValueError(f"states: expected [..., {n}], got shape {states.shape}")
        if not np.isfinite(states).all():
            raise ValueError("states: numbers must be finite")
        return np.ascontiguousarray(states.reshape(-1, n)), states.shape[:-1]


@compiled(
    types.Tuple((types.int64, types.int64, float64, types.int64))(
        float64, VECTOR, types.int64, types.int64, types.int64
    )
)
def _locate(x, geometry, axis, n, stride):
    """Flat offsets of the nodes below and above `x` on an axis, the fraction, the next stride.

    The offset below is -1 outside the box.
    """
    count = int(geometry[2 * n + axis])
    t = (x - geometry[axis]) * geometry[n + axis]
    if geometry[3 * n + axis] > 0.0:
        t -= math.floor(t / count) * count
        if not 0.0 <= t <= count:
            return -1, -1, 0.0, stride * count
        low = min(int(t), count - 1)
        high = low + 1 if low + 1 < count else 0
    else:
        if not -EDGE_TOLERANCE <= t <= count - 1 + EDGE_TOLERANCE:
            return -1, -1, 0.0, stride * count
        t = min(max(t, 0.0), count - 1.0)
        low = min(int(t), count - 2)
        high = low + 1
    fraction = t - low
    if fraction < EDGE_TOLERANCE:  # rounding must not touch an infinite neighbour
        fraction = 0.0
    elif fraction > 1.0 - EDGE_TOLERANCE:
        fraction = 1.0
    return low * stride, high * stride, fraction, stride * count


@compiled(float64(VECTOR, VECTOR, VECTOR))
def interpolate(values, geometry, point):
    """Multilinear value at `point` `[n]`; infinite outside the box or next to an infinite corner.

    `values` `[nodes]` and `geometry` `[4n]` are `GridValue.flat` and `Grid.geometry`.
    """
    n = point.shape[0]
    total = 0.0
    low3, high3, f3, stride = _locate(point[n - 1], geometry, n - 1, n, 1)
    low2, high2, f2, low1, high1, f1, low0, high0, f0 = 0, 0, 0.0, 0, 0, 0.0, 0, 0, 0.0
    if n > 1:
        low2, high2, f2, stride = _locate(point[n - 2], geometry, n - 2, n, stride)
    if n > 2:
        low1, high1, f1, stride = _locate(point[n - 3], geometry, n - 3, n, stride)
    if n > 3:
        low0, high0, f0, stride = _locate(point[n - 4], geometry, n - 4, n, stride)
    if low0 < 0 or low1 < 0 or low2 < 0 or low3 < 0:
        return np.inf
    # Corners of weight 0 are skipped: 0 times infinity would be NaN.
    for s0 in range(2):
        w0, k0 = (f0, high0) if s0 else (1.0 - f0, low0)
        if w0 > 0.0:
            for s1 in range(2):
                w1, k1 = (f1, high1) if s1 else (1.0 - f1, low1)
                if w1 > 0.0:
                    for s2 in range(2):
                        w2, k2 = (f2, high2) if s2 else (1.0 - f2, low2)
                        if w2 > 0.0:
                            k = k0 + k1 + k2
                            if f3 < 1.0:
                                total += w0 * w1 * w2 * (1.0 - f3) * values[k + low3]
                            if f3 > 0.0:
                                total += w0 * w1 * w2 * f3 * values[k + high3]
    return total


@compiled(types.void(VECTOR, VECTOR, MATRIX, VECTOR))
def _interpolate_rows(values, geometry, points, out):
    for row in range(points.shape[0]):
        out[row] = interpolate(values, geometry, points[row])


@compiled(types.void(VECTOR, VECTOR, MATRIX, MATRIX))
def _gradient_rows(values, geometry, points, out):
    n = points.shape[1]
    for row in range(points.shape[0]):
        point = points[row]
        here = interpolate(values, geometry, point)
        for i in range(n):
            x, h = point[i], 1.0 / geometry[n + i]
            point[i] = x + h
            above = interpolate(values, geometry, point)
            point[i] = x - h
            below = interpolate(values, geometry, point)
            point[i] = x
            if above < np.inf and below < np.inf:
                out[row, i] = (above - below) / (2.0 * h)
            elif above < np.inf and here < np.inf:
                out[row, i] = (above - here) / h
            elif below < np.inf and here < np.inf:
                out[row, i] = (here - below) / h
            else:
                out[row, i] = 0.0
