"""A grid's value with two continuous derivatives: the cubic B-spline through its nodes.

Multilinear interpolation is what the solvers and the lookahead use; it has no derivative on cell
faces, where Newton's method stalls. The spline is for optimisers that put V at the end of a motion.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled
from ocp.grid import Grid, GridValue

PAD = 16  # nodes added on every side of an axis that is not periodic; what is beyond counts 1e-9


@dataclass(frozen=True, eq=False)
class SplineValue:
    """The tensor-product cubic spline through a grid's values; linear beyond the grid's box.

    It overshoots by a few percent of a jump in slope: near the goal's boundary it may be slightly
    negative.

    Attributes:
        on_grid: the nodes' values, all finite.
    """

    on_grid: GridValue

    def __post_init__(self) -> None:
        if not np.isfinite(self.on_grid.values).all():
            raise ValueError("values: a spline needs finite values at all nodes")

    @property
    def grid(self) -> Grid:
        return self.on_grid.grid

    def value(self, states: ArrayLike) -> NDArray[np.float64]:
        """V `[...]` at states `[..., n]`."""
        return self._both(states)[0]

    def gradient(self, states: ArrayLike) -> NDArray[np.float64]:
        """Its gradient `[..., n]` at states `[..., n]`."""
        return self._both(states)[1]

    def _both(self, states: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        states = np.asarray(states, dtype=float)
        n = self.grid.dimension
        if states.shape[-1:] != (n,) or not np.isfinite(states).all():
            raise ValueError(f"states: need finite numbers [..., {n}], got shape {states.shape}")
        rows = states.reshape(-1, n)
        free = ~np.array(self.grid.periodic)
        inside = np.where(free, np.clip(rows, self.grid.lower, self.grid.upper), rows)
        values, slopes = np.empty(len(rows)), np.empty(rows.shape)
        _spline_rows(self._coefficients.ravel(), self._geometry, inside, values, slopes)
        values += (slopes * (rows - inside)).sum(axis=1)
        return values.reshape(states.shape[:-1]), slopes.reshape(states.shape)

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        """B-spline coefficients; beyond the ends of an axis V goes on as an odd reflection."""
        from scipy.ndimage import spline_filter1d

        padded = self.on_grid.values
        widths = [(0, 0) if periodic else (PAD, PAD) for periodic in self.grid.periodic]
        padded = np.pad(padded, widths, mode="reflect", reflect_type="odd")
        for axis, periodic in enumerate(self.grid.periodic):
            mode = "grid-wrap" if periodic else "mirror"
            padded = spline_filter1d(padded, 3, axis, mode=mode)
        return np.ascontiguousarray(padded)

    @cached_property
    def _geometry(self) -> NDArray[np.float64]:
        """`[4, n]`: first node, nodes a unit, number of nodes, whether periodic; pads included."""
        grid = self.grid
        periodic = np.array(grid.periodic)
        lower = np.array(grid.lower) - np.where(periodic, 0.0, PAD * grid.spacing)
        return np.stack([lower, 1.0 / grid.spacing, self._coefficients.shape, periodic])


@compiled(types.void(VECTOR, MATRIX, MATRIX, VECTOR, MATRIX))
def _spline_rows(coefficients, geometry, rows, values, slopes):
    n = rows.shape[1]
    weights, rates = np.empty((n, 4)), np.empty((n, 4))
    index = np.empty((n, 4), dtype=np.int64)
    for row in range(rows.shape[0]):
        for i in range(n):
            count = int(geometry[2, i])
            t = (rows[row, i] - geometry[0, i]) * geometry[1, i]
            low = int(np.floor(t))
            f = t - low
            g = 1.0 - f
            weights[i, 0], weights[i, 3] = g * g * g / 6.0, f * f * f / 6.0
            weights[i, 1] = 2.0 / 3.0 - f * f * (2.0 - f) / 2.0
            weights[i, 2] = 2.0 / 3.0 - g * g * (2.0 - g) / 2.0
            rates[i, 0], rates[i, 3] = -g * g / 2.0, f * f / 2.0
            rates[i, 1] = f * (3.0 * f - 4.0) / 2.0
            rates[i, 2] = -g * (3.0 * g - 4.0) / 2.0
            for k in range(4):
                j = low - 1 + k
                j = j % count if geometry[3, i] > 0.0 else min(max(j, 0), count - 1)
                index[i, k] = j
        values[row] = 0.0
        slopes[row] = 0.0
        for corner in range(4**n):
            flat, product, rest = 0, 1.0, corner
            for i in range(n):
                k = rest % 4
                rest //= 4
                flat = flat * int(geometry[2, i]) + index[i, k]
                product *= weights[i, k]
            c = coefficients[flat]
            values[row] += c * product
            for j in range(n):
                product, rest = 1.0, corner
                for i in range(n):
                    k = rest % 4
                    rest //= 4
                    product *= rates[i, k] if i == j else weights[i, k]
                slopes[row, j] += c * product * geometry[1, j]
