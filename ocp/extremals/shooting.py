"""Multiple shooting for extremals, compiled: a damped Newton method on the Hamiltonian flow.

The duration T is cut into N segments; the unknowns are z_k = [x, p] at the N - 1 inner nodes, the
free coordinates of the end, and T if it is free. Each segment is integrated *backward*, from its
end: the end then lies exactly on the terminal manifold, outside the goal ball, where the running
cost is smooth (in the ball the goal cost is cut off at 0), and nothing is asked of the costate at
the start.

The linear system of a Newton step is solved by carrying a basis of the terminal manifold's
tangents backward through the segments, made orthonormal at each node (Godunov 1961): those are the
growing solutions, so nothing is lost to their growth. At the nodes that basis [X; P] is also the
tangent of the field of extremals: P X^-1 is the Hessian of V, and where X becomes singular lies a
conjugate point.

Steps are damped by the natural monotonicity test with simplified Newton corrections (Deuflhard,
Newton Methods for Nonlinear Problems, 2004, algorithm NLEQ-ERR).
"""

import math
from functools import cache

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, MATRIX, VECTOR, compiled, float64
from ocp.extremals.hamiltonian_flow import FINISHED, INTEGERS, PROPAGATE, flow_addresses
from ocp.extremals.transversality import TERMINAL, terminal_point
from ocp.query import Query

CUBE = float64[:, :, ::1]

NOISE = 100.0  # a step that cannot be bettered may exceed the tolerance by this factor

CONVERGED, ITERATIONS, DAMPED_OUT, SINGULAR, BROKEN = 0, 1, 2, 3, 4  # how `shoot` ended

kernel_at = function_at(KERNEL)
propagate_at = function_at(PROPAGATE)
terminal_at = function_at(TERMINAL)


def shooting_addresses(query: Query) -> NDArray[np.intp]:
    """The functions that `shoot` calls for this query."""
    return np.concatenate([flow_addresses(query), _terminal_address()])


@cache
def _terminal_address() -> NDArray[np.intp]:
    return addresses([terminal_point])


@compiled(
    int64(
        int64,
        ADDRESSES,
        VECTOR,
        INTEGERS,
        VECTOR,
        VECTOR,
        VECTOR,
        MATRIX,
        VECTOR,
        float64,
        float64,
        MATRIX,
        MATRIX,
        CUBE,
        MATRIX,
        types.boolean,
    )
)
def _defects(
    kind, functions, q, layout, terms, start, fractions, nodes, end, duration, tolerance,
    edge, gaps, linear, speeds, linearise,
):  # fmt: skip
    """Gaps at the nodes for `nodes` `[N + 1, 2n]` (row 0 unused), `end` `[n]` and `duration`.

    Fills `nodes[N]` and `edge` from the terminal manifold; `gaps[k - 1]` `[2n]`, where segment k
    begins minus node k - 1 (for k = 1: in x only, minus the start); and, if asked to linearise,
    `linear[k - 1]` `[2n, 2n]`, the segment's sensitivity to its end, and `speeds[k - 1]` `[2n]`,
    to the duration. Returns 0, or 1 if something cannot be integrated.
    """
    n = layout[0]
    count = fractions.shape[0] - 1
    on_manifold = terminal_at(functions[4, 0], functions[4, 1])
    if not on_manifold(kind, functions, q, layout, terms, end, nodes[count], edge):
        return 1
    integrate = propagate_at(functions[3, 0], functions[3, 1])
    flow = kernel_at(functions[0, 0], functions[0, 1])
    y = np.zeros(2 * n + 1)
    none, no_record, no_tangents = np.empty(0), np.empty((0, 0)), np.empty((2 * n, 0))
    for k in range(count, 0, -1):
        share = fractions[k] - fractions[k - 1]
        y[: 2 * n] = nodes[k]
        y[2 * n] = 0.0
        if linearise:
            tangents = linear[k - 1]
            tangents[:] = 0.0
            for i in range(2 * n):
                tangents[i, i] = 1.0
        else:
            tangents = no_tangents
        ended = integrate(
            functions, q, layout, y, tangents, -share * duration, tolerance, none, no_record
        )
        if ended != FINISHED:
            return 1
        if linearise:
            flow(y, q, speeds[k - 1])
            for i in range(2 * n):
                speeds[k - 1, i] *= -share
        for i in range(2 * n):
            gaps[k - 1, i] = y[i] - nodes[k - 1, i]
        if k == 1:
            nodes[0, n:] = y[n : 2 * n]
            for i in range(n):
                gaps[0, i] = y[i] - start[i]
                gaps[0, n + i] = 0.0
    return 0


@compiled(types.boolean(INTEGERS, types.boolean, MATRIX, CUBE, MATRIX, CUBE, CUBE))
def _factor(layout, free_time, edge, linear, speeds, basis, triangle):
    """Carry the tangents of the manifold backward: `basis[k]` `[2n + 1, n]` at node k, with the
    change of duration as last row, orthonormal; `triangle[k]` turns coordinates at node k into
    those at node k - 1. Returns whether the basis kept its rank.
    """
    n = layout[0]
    count = linear.shape[0]
    last = basis[count]
    last[:] = 0.0
    for j in range(edge.shape[1]):
        for i in range(2 * n):
            last[i, j] = edge[i, j]
    if free_time:
        last[2 * n, n - 1] = 1.0
    for k in range(count, 0, -1):
        here, there, right = basis[k - 1], basis[k], triangle[k]
        right[:] = 0.0
        for c in range(n):
            for i in range(2 * n):
                total = speeds[k - 1, i] * there[2 * n, c]
                for j in range(2 * n):
                    total += linear[k - 1, i, j] * there[j, c]
                here[i, c] = total
            here[2 * n, c] = there[2 * n, c]
            # Gram and Schmidt, twice
            for _ in range(2):
                for b in range(c):
                    share = 0.0
                    for i in range(2 * n + 1):
                        share += here[i, b] * here[i, c]
                    right[b, c] += share
                    for i in range(2 * n + 1):
                        here[i, c] -= share * here[i, b]
            length = 0.0
            for i in range(2 * n + 1):
                length += here[i, c] ** 2
            length = math.sqrt(length)
            if not (1e-200 < length < 1e200):
                return False
            right[c, c] = length
            for i in range(2 * n + 1):
                here[i, c] /= length
    return True


@compiled(types.boolean(MATRIX, VECTOR))
def _solve(matrix, right):
    """Gauss with row pivoting, in place; whether the matrix is regular."""
    n = right.shape[0]
    for c in range(n):
        pivot = c
        for i in range(c + 1, n):
            if abs(matrix[i, c]) > abs(matrix[pivot, c]):
                pivot = i
        if not abs(matrix[pivot, c]) > 1e-14:
            return False
        if pivot != c:
            for j in range(n):
                matrix[c, j], matrix[pivot, j] = matrix[pivot, j], matrix[c, j]
            right[c], right[pivot] = right[pivot], right[c]
        for i in range(c + 1, n):
            factor = matrix[i, c] / matrix[c, c]
            for j in range(c, n):
                matrix[i, j] -= factor * matrix[c, j]
            right[i] -= factor * right[c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]
    return True


@compiled(types.boolean(INTEGERS, MATRIX, CUBE, MATRIX, CUBE, CUBE, VECTOR, MATRIX))
def _newton_step(layout, gaps, linear, speeds, basis, triangle, ends, step):
    """The Newton step for `gaps`: `step[k]` `[2n + 1]`, the change of z_k and of T, and `ends`
    `[n]`, that of the manifold's coordinates (and T). Returns whether the system is regular.
    """
    n = layout[0]
    count = linear.shape[0]
    shift = np.empty((count, n))
    step[count] = 0.0
    for k in range(count, 0, -1):  # a particular solution, kept orthogonal to the basis
        here, there, frame = step[k - 1], step[k], basis[k - 1]
        for i in range(2 * n):
            total = gaps[k - 1, i] + speeds[k - 1, i] * there[2 * n]
            for j in range(2 * n):
                total += linear[k - 1, i, j] * there[j]
            here[i] = total
        here[2 * n] = there[2 * n]
        for c in range(n):
            share = 0.0
            for i in range(2 * n + 1):
                share += frame[i, c] * here[i]
            shift[k - 1, c] = share
        for c in range(n):
            for i in range(2 * n + 1):
                here[i] -= shift[k - 1, c] * frame[i, c]
    matrix = basis[0, :n].copy()
    for i in range(n):
        ends[i] = -step[0, i]
    if not _solve(matrix, ends):
        return False
    for k in range(count + 1):
        if k > 0:
            for i in range(n):
                ends[i] -= shift[k - 1, i]
            for i in range(n - 1, -1, -1):
                for j in range(i + 1, n):
                    ends[i] -= triangle[k, i, j] * ends[j]
                ends[i] /= triangle[k, i, i]
        for c in range(n):
            for i in range(2 * n + 1):
                step[k, i] += basis[k, i, c] * ends[c]
    return True


@compiled(float64(MATRIX, float64, MATRIX, VECTOR))
def _distance(a, weight, b, scale):
    """Root mean square of a - weight b, both `[N + 1, 2n + 1]`, each column over its scale."""
    total = 0.0
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            total += ((a[k, i] - weight * b[k, i]) / scale[i]) ** 2
    return math.sqrt(total / a.size)


@compiled(types.void(MATRIX, VECTOR, MATRIX, MATRIX, VECTOR, float64, MATRIX, VECTOR))
def _move(nodes, end, step, edge, ends, damping, moved, moved_end):
    """The iterate after a damped step."""
    for k in range(nodes.shape[0]):
        for i in range(nodes.shape[1]):
            moved[k, i] = nodes[k, i] + damping * step[k, i]
    for i in range(end.shape[0]):
        moved_end[i] = end[i]
        for c in range(edge.shape[1]):
            moved_end[i] += damping * edge[i, c] * ends[c]


@compiled(
    types.Tuple((int64, int64, float64, float64))(
        int64,
        types.boolean,
        ADDRESSES,
        VECTOR,
        INTEGERS,
        VECTOR,
        VECTOR,
        VECTOR,
        VECTOR,
        MATRIX,
        VECTOR,
        float64,
        CUBE,
    )
)
def shoot(
    kind, free_time, functions, q, layout, terms, settings, start, fractions,
    nodes, end, duration, basis,
):  # fmt: skip
    """Newton iterations on an extremal from `start` `[n]`.

    Args:
        kind, functions, q, layout, terms: see `terminal_point`.
        free_time: whether the duration is unknown.
        settings: tolerance of a Newton step (root mean square, relative to 1 + size), tolerance of
            an integration step, most iterations, least damping.
        fractions: `[N + 1]`, the nodes' times over the duration, from 0 to 1.
        nodes: `[N + 1, 2n]`, a guess of z at the nodes (rows 0 and N are not read), replaced by the
            solution.
        end: `[n]`, a guess of the state at the end, replaced.
        duration: a guess, in seconds.
        basis: `[N + 1, 2n + 1, n]`, filled with orthonormal tangents of the field of extremals.

    Returns:
        CONVERGED, ITERATIONS, DAMPED_OUT, SINGULAR or BROKEN; iterations; duration; size of the
        last correction.
    """
    n = layout[0]
    count = fractions.shape[0] - 1
    free = n - 1 if free_time else n  # coordinates of the manifold
    edge, trial_edge = np.empty((2 * n, free)), np.empty((2 * n, free))
    gaps, linear = np.empty((count, 2 * n)), np.empty((count, 2 * n, 2 * n))
    speeds, triangle = np.empty((count, 2 * n)), np.empty((count + 1, n, n))
    step, simplified = np.empty((count + 1, 2 * n + 1)), np.empty((count + 1, 2 * n + 1))
    ends, trial_ends = np.empty(n), np.empty(n)
    trial, trial_end, trial_gaps = nodes.copy(), end.copy(), gaps.copy()
    scale = np.ones(2 * n + 1)
    for i in range(2 * n):
        for k in range(1, count):
            scale[i] += abs(nodes[k, i]) / count
    scale[2 * n] += duration
    on_manifold = terminal_at(functions[4, 0], functions[4, 1])
    damping, previous, previous_simplified = 1.0, 0.0, 0.0
    size, settled = np.inf, False
    for iteration in range(int(settings[2])):
        fine = settings[1] if size < 1e-2 else max(settings[1], 1e-6)
        if _defects(
            kind, functions, q, layout, terms, start, fractions, nodes, end, duration, fine,
            edge, gaps, linear, speeds, True,
        ):  # fmt: skip
            return BROKEN, iteration, duration, size
        if not _factor(layout, free_time, edge, linear, speeds, basis, triangle):
            return SINGULAR, iteration, duration, size
        if not _newton_step(layout, gaps, linear, speeds, basis, triangle, ends, step):
            return SINGULAR, iteration, duration, size
        size = _distance(step, 0.0, step, scale)
        if not size < np.inf:
            return BROKEN, iteration, duration, size
        if settled or size <= settings[0]:
            _move(nodes, end, step, edge, ends, 1.0, trial, trial_end)
            nodes[1:] = trial[1:]
            end[:] = trial_end
            duration += ends[n - 1] if free_time else 0.0
            if not on_manifold(kind, functions, q, layout, terms, end, nodes[count], edge):
                return BROKEN, iteration, duration, size
            return CONVERGED, iteration + 1, duration, size
        if iteration > 0:
            # The last simplified correction, had it been exact, would equal this step.
            error = _distance(simplified, 1.0, step, scale)
            if error > 0.0:
                damping = min(1.0, damping * previous * previous_simplified / (error * size))
            damping = 1.0 if size <= NOISE * settings[0] else max(damping, 10.0 * settings[3])
        tried = False
        while True:
            if damping < settings[3]:
                return DAMPED_OUT, iteration, duration, size
            change = damping * ends[n - 1] if free_time else 0.0
            turn = 0.0
            for c in range(layout[2] - 1 if free_time else 0):
                turn = max(turn, damping * abs(ends[c]))
            if not -0.7 * duration < change < 2.0 * duration or turn > 1.0:
                damping *= 0.5  # too far to trust, whatever comes of it
                tried = True
                continue
            _move(nodes, end, step, edge, ends, damping, trial, trial_end)
            failed = _defects(
                kind, functions, q, layout, terms, start, fractions, trial, trial_end,
                duration + change, fine, trial_edge, trial_gaps, linear, speeds, False,
            )  # fmt: skip
            if failed or not _newton_step(
                layout, trial_gaps, linear, speeds, basis, triangle, trial_ends, simplified
            ):
                damping *= 0.25
                tried = True
                continue
            correction = _distance(simplified, 0.0, simplified, scale)
            error = _distance(simplified, 1.0 - damping, step, scale)
            advised = 0.5 * size * damping**2 / error if error > 0.0 else np.inf
            if not correction < (1.0 - damping / 4.0) * size:
                if size <= NOISE * settings[0]:
                    settled = True  # no better than the integration: let the checks judge
                    break
                damping = min(advised, 0.5 * damping)
                tried = True
                continue
            if not tried and damping < 1.0 and advised >= 4.0 * damping:
                damping = min(1.0, advised)
                tried = True
                continue
            break
        nodes[:] = trial
        end[:] = trial_end
        duration += change
        previous, previous_simplified = size, correction
    return ITERATIONS, int(settings[2]), duration, size


@compiled(float64(ADDRESSES, VECTOR, INTEGERS, VECTOR, MATRIX, float64, int64, float64, MATRIX))
def trace(functions, q, layout, fractions, nodes, duration, samples, tolerance, points):
    """Integrate an extremal again, forward from each node, which the solve did not do.

    Fills `points` `[N s + 1, 2n + 1]` with (z, cost so far) at `s` equal steps of each of the N
    segments. The cost is exact to second order in the gaps that are left at the nodes.

    Returns the largest distance from a node so reached to the solution's, relative to 1 + size;
    infinite if the integration failed.
    """
    n = layout[0]
    count = fractions.shape[0] - 1
    integrate = propagate_at(functions[3, 0], functions[3, 1])
    none, no_record, no_tangents = np.empty(0), np.empty((0, 0)), np.empty((2 * n, 0))
    y = np.zeros(2 * n + 1)
    worst = 0.0
    for k in range(count):
        y[: 2 * n] = nodes[k]
        step = (fractions[k + 1] - fractions[k]) * duration / samples
        for s in range(samples):
            points[k * samples + s] = y
            ended = integrate(
                functions, q, layout, y, no_tangents, step, tolerance, none, no_record
            )
            if ended != FINISHED:
                return np.inf
        for i in range(2 * n):
            worst = max(worst, abs(y[i] - nodes[k + 1, i]) / (1.0 + abs(y[i])))
        for i in range(n):  # where the next segment begins elsewhere, the difference is worth p
            y[2 * n] += nodes[k + 1, n + i] * (y[i] - nodes[k + 1, i])
    points[count * samples, : 2 * n] = nodes[count]
    points[count * samples, 2 * n] = y[2 * n]
    return worst
