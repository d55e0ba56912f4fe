"""How far a multilinear function of three coordinates is from a subsolution, on whole cells.

In a cell let p^q be the difference quotients at its eight corners q. The gradient at a point is
the mean of the p^q with the point's multilinear weights. Let G, scaled by R^(-1/2), depend on the
last coordinate only, with ends G0, G1 in the cell, and split the corners by it: means p0 and p1.
At fraction t between the ends, with E the deviation of G from linear,

    G' grad w = (1 - t) G0' p0 + t G1' p1 + t (1 - t) (G1 - G0)' (p0 - p1) + E' p,

so its norm is at most the mean of |G_q' p^q| + x, with x = 1/4 the largest |(G1 - G0)' (p0 - p1)|
+ the bound of |E' p|, both at their largest over corners. The square of a mean is at most the mean
of squares, and W is at least the same mean of its values at corners less a bound e of how far it
can hang below: so 4 W >= |G' grad w|^2 in the whole cell if 4 (W_q - e) >= (|G_q' p^q| + x)^2 at
every corner. Or, more simply, if 4 min W does; the better of the two counts.
"""

import math

import numpy as np
from numba import float64, int64, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled

CUBE = float64[:, :, ::1]


@compiled(types.void(CUBE, VECTOR, CUBE, MATRIX, MATRIX, MATRIX, MATRIX, CUBE, CUBE, CUBE))
def cell_ratios(w, spacing, inputs, bend, corner, sag, cost, out, low, high):
    """The bound of |G' grad w| / (2 sqrt W) in every cell, and w's range there.

    Args:
        w: `[a + 1, b + 1, c + 1]` values at the nodes.
        spacing: `[3]`.
        inputs: `[c + 1, m, 3]`, the columns of G R^(-1/2) at the nodes of the last axis.
        bend: `[m, 3]`, bounds of |E|.
        corner: `[a + 1, b + 1]`, W at the nodes.
        sag: `[a, b]`, how far W can be below the mean of a cell's corners.
        cost: `[a, b]`, lower bounds of W in the cells.
        out, low, high: `[a, b, c]`.
    """
    m = inputs.shape[1]
    sizes = np.empty((2, 2))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                largest, twist, stray = 0.0, 0.0, 0.0
                least, most = math.inf, -math.inf
                for a in range(2):
                    for b in range(2):
                        v0, v1 = w[i + a, j + b, k], w[i + a, j + b, k + 1]
                        least = min(least, min(v0, v1))
                        most = max(most, max(v0, v1))
                        last = (v1 - v0) / spacing[2]
                        x0 = (w[i + 1, j + b, k] - w[i, j + b, k]) / spacing[0]
                        x1 = (w[i + 1, j + b, k + 1] - w[i, j + b, k + 1]) / spacing[0]
                        y0 = (w[i + a, j + 1, k] - w[i + a, j, k]) / spacing[1]
                        y1 = (w[i + a, j + 1, k + 1] - w[i + a, j, k + 1]) / spacing[1]
                        n0, n1, t2, e2 = 0.0, 0.0, 0.0, 0.0
                        for u in range(m):
                            g0, g1 = inputs[k, u], inputs[k + 1, u]
                            along0 = g0[0] * x0 + g0[1] * y0 + g0[2] * last
                            along1 = g1[0] * x1 + g1[1] * y1 + g1[2] * last
                            turned = (g1[0] - g0[0]) * (x0 - x1) + (g1[1] - g0[1]) * (y0 - y1)
                            swing = (
                                bend[u, 0] * max(abs(x0), abs(x1))
                                + bend[u, 1] * max(abs(y0), abs(y1))
                                + bend[u, 2] * abs(last)
                            )
                            n0 += along0 * along0
                            n1 += along1 * along1
                            t2 += turned * turned
                            e2 += swing * swing
                        sizes[a, b] = math.sqrt(max(n0, n1))
                        largest = max(largest, sizes[a, b])
                        twist = max(twist, t2)
                        stray = max(stray, e2)
                extra = math.sqrt(twist) / 4.0 + math.sqrt(stray)
                simple = math.inf if largest + extra > 0.0 else 0.0
                if cost[i, j] > 0.0:
                    simple = (largest + extra) / (2.0 * math.sqrt(cost[i, j]))
                by_corner = 0.0
                for a in range(2):
                    for b in range(2):
                        here = corner[i + a, j + b] - sag[i, j]
                        if here > 0.0:
                            size = (sizes[a, b] + extra) / (2.0 * math.sqrt(here))
                            by_corner = max(by_corner, size)
                        else:
                            by_corner = math.inf
                out[i, j, k] = min(simple, by_corner)
                low[i, j, k] = least
                high[i, j, k] = most


@compiled(types.void(CUBE, CUBE, CUBE, CUBE, float64, VECTOR))
def level_ratios(ratio, low, high, active, step, out):
    """The largest ratio of the active cells that meet each level set; levels are `step` apart."""
    count = out.shape[0]
    for i in range(ratio.shape[0]):
        for j in range(ratio.shape[1]):
            for k in range(ratio.shape[2]):
                if active[i, j, k] > 0.0:
                    first = min(max(int(low[i, j, k] / step), 0), count - 1)
                    last = min(max(int(high[i, j, k] / step), 0), count - 1)
                    for level in range(first, last + 1):
                        out[level] = max(out[level], ratio[i, j, k])


@compiled(types.void(CUBE, CUBE, int64, int64, CUBE))
def node_ratios(ratio, active, factor, reach, out):
    """The largest ratio of the active fine cells around each node of the `factor` times coarser
    grid, or of a node up to `reach` further; at least what `out` holds. The last axis is
    periodic."""
    nodes, least = out.shape, out.min()
    for i in range(ratio.shape[0]):
        for j in range(ratio.shape[1]):
            for k in range(ratio.shape[2]):
                r = ratio[i, j, k]
                if active[i, j, k] > 0.0 and r > least:
                    x, y, z = i // factor, j // factor, k // factor
                    for p in range(max(x - reach, 0), min(x + reach + 2, nodes[0])):
                        for q in range(max(y - reach, 0), min(y + reach + 2, nodes[1])):
                            for c in range(-reach, reach + 2):
                                s = (z + c) % nodes[2]
                                out[p, q, s] = max(out[p, q, s], r)
