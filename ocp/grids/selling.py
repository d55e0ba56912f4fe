"""Selling's decomposition: a metric as a non-negative sum of squares of integer offsets.

For a symmetric positive definite D in 1 to 3 dimensions there are weights w_e >= 0 and integer
vectors e with D = sum_e w_e e e', hence p' D p = sum_e w_e (e . p)^2 for every p. Upwind
differences along the grid offsets e then discretise an anisotropic eikonal equation causally.

Source: E. Selling, "Ueber die binaeren und ternaeren quadratischen Formen", J. reine angew. Math.
77 (1874); J.-M. Mirebeau, "Fast-marching methods for curvature penalized shortest paths", J. Math.
Imaging Vis. 60 (2018), section 2. A superbase (b_0, ..., b_n) is n + 1 integer vectors with sum 0
of which any n span the lattice. It is obtuse if b_i . D b_j <= 0 for all i != j; then the weight of
each pair is -b_i . D b_j, and its offset is orthogonal to the other vectors of the superbase.
"""

import numpy as np
from numba import int64, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import MATRIX, compiled, float64

MAX_STEPS = 10_000  # a step lowers sum_i b_i . D b_i; an anisotropy of 1e6 takes about 1,000
ROUNDING = 1e-12  # relative to the product of two vectors' lengths in the metric


def offset_count(dimension: int) -> int:
    """Number of offsets: n (n + 1) / 2."""
    return dimension * (dimension + 1) // 2


def decompose(metrics: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Weights `[..., k]` and integer offsets `[..., k, n]` of metrics D `[..., n, n]`, n <= 3.

    k is 1, 3 or 6; a weight may be 0. An offset stands for its opposite too.

    Raises:
        ValueError: if the dimension is not 1 to 3, or a metric is not symmetric positive definite.
    """
    metrics = np.asarray(metrics, dtype=float)
    n = metrics.shape[-1]
    if metrics.ndim < 2 or metrics.shape[-2] != n or not 1 <= n <= 3:
        raise ValueError(f"metrics: need [..., n, n] with n from 1 to 3, got {metrics.shape}")
    if not np.isfinite(metrics).all() or not np.allclose(metrics, np.swapaxes(metrics, -1, -2)):
        raise ValueError("metrics: must be finite and symmetric")
    if metrics.size and np.linalg.eigvalsh(metrics).min() <= 0:
        raise ValueError("metrics: must be positive definite")
    flat = np.ascontiguousarray(metrics.reshape(-1, n, n))
    weights = np.zeros((len(flat), offset_count(n)))
    offsets = np.zeros((len(flat), offset_count(n), n), dtype=np.int64)
    if not _decompose_all(flat, weights, offsets):
        raise ValueError(f"metrics: an anisotropy is beyond {MAX_STEPS} steps of Selling's method")
    shape = metrics.shape[:-2]
    return weights.reshape(*shape, -1), offsets.reshape(*shape, -1, n)


@compiled(float64(MATRIX, int64[::1], int64[::1]))
def _product(metric, a, b):
    """a . D b."""
    total = 0.0
    for i in range(len(a)):
        for j in range(len(b)):
            total += a[i] * metric[i, j] * b[j]
    return total


@compiled(types.boolean(MATRIX, int64[:, ::1]))
def _make_obtuse(metric, base):
    """Selling's steps on the superbase `base` `[n + 1, n]` until it is obtuse."""
    n = base.shape[1]
    for _ in range(MAX_STEPS):
        found = False
        for i in range(n):
            for j in range(i + 1, n + 1):
                acute = _product(metric, base[i], base[j])
                bound = _product(metric, base[i], base[i]) * _product(metric, base[j], base[j])
                if found or acute <= ROUNDING * np.sqrt(bound):
                    continue
                found = True
                for k in range(n + 1):  # the other vectors take up b_i, which is turned round
                    if n == 2 and k != i and k != j:
                        base[k] += 2 * base[i]
                    elif n == 3 and k != i and k != j:
                        base[k] += base[i]
                base[i] *= -1
        if not found:
            return True
    return False


@compiled(types.boolean(float64[:, :, ::1], float64[:, ::1], int64[:, :, ::1]))
def _decompose_all(metrics, weights, offsets):
    n = metrics.shape[1]
    base = np.zeros((n + 1, n), dtype=np.int64)
    for m in range(metrics.shape[0]):
        metric = metrics[m]
        base[:] = 0
        for i in range(n):
            base[i, i] = 1
            base[n, i] = -1
        if not _make_obtuse(metric, base):
            return False
        pair = 0
        for i in range(n):
            for j in range(i + 1, n + 1):
                weights[m, pair] = max(0.0, -_product(metric, base[i], base[j]))
                if n == 1:
                    offsets[m, pair, 0] = 1
                elif n == 2:
                    k = 3 - i - j
                    offsets[m, pair, 0] = -base[k, 1]
                    offsets[m, pair, 1] = base[k, 0]
                else:
                    k = 0
                    while k in (i, j):
                        k += 1
                    a, b = base[k], base[6 - i - j - k]
                    offsets[m, pair, 0] = a[1] * b[2] - a[2] * b[1]
                    offsets[m, pair, 1] = a[2] * b[0] - a[0] * b[2]
                    offsets[m, pair, 2] = a[0] * b[1] - a[1] * b[0]
                pair += 1
    return True
