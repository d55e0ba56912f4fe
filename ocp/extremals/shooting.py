"""Multiple shooting for extremals, compiled: a damped Newton method on the Hamiltonian flow.

The duration T is cut into N segments; the unknowns are z_k = [x, p] at the N - 1 inner nodes, the
free coordinates of the end, and T if it is free. Each segment is integrated *backward*, from its
end: the end then lies exactly on the terminal manifold, outside the goal ball, where the running
cost is smooth (in the ball the goal cost is cut off at 0), and nothing is asked of the costate at
the start.

The linear system of a step is solved in newton_step.py, whose basis [X; P] of tangents at the nodes
is that of the field of extremals: P X^-1 is the Hessian of V, and where X becomes singular lies a
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
from ocp.extremals.hamiltonian_flow import CUBE, FINISHED, INTEGERS, PROPAGATE, flow_addresses
from ocp.extremals.newton_step import FACTOR, NEWTON_STEP, factor, newton_step
from ocp.extremals.transversality import TERMINAL, terminal_point
from ocp.kernels import Kernels, kernels
from ocp.query import Query

NOISE = 100.0  # a step that cannot be bettered may exceed the tolerance by this factor

CONVERGED, ITERATIONS, DAMPED_OUT, SINGULAR, BROKEN = 0, 1, 2, 3, 4  # how `shoot` ended

kernel_at = function_at(KERNEL)
propagate_at = function_at(PROPAGATE)
terminal_at = function_at(TERMINAL)
factor_at = function_at(FACTOR)
newton_step_at = function_at(NEWTON_STEP)


def shooting_addresses(query: Query) -> NDArray[np.intp]:
    """The functions that `shoot` calls for this query."""
    return _shooting_addresses(kernels(query))


@cache
def _shooting_addresses(k: Kernels) -> NDArray[np.intp]:
    return np.concatenate([flow_addresses(k), addresses([terminal_point, factor, newton_step])])


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
    pace = np.zeros(1)
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
            functions, q, layout, y, tangents, -share * duration, tolerance, pace, none, no_record
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
    trial_linear, trial_speeds = np.empty_like(linear), np.empty_like(speeds)
    step, simplified = np.empty((count + 1, 2 * n + 1)), np.empty((count + 1, 2 * n + 1))
    ends, trial_ends = np.empty(n), np.empty(n)
    trial, trial_end, trial_gaps = nodes.copy(), end.copy(), gaps.copy()
    scale = np.ones(2 * n + 1)
    for i in range(2 * n):
        for k in range(1, count):
            scale[i] += abs(nodes[k, i]) / count
    scale[2 * n] += duration
    on_manifold = terminal_at(functions[4, 0], functions[4, 1])
    factorised = factor_at(functions[5, 0], functions[5, 1])
    stepped = newton_step_at(functions[6, 0], functions[6, 1])
    damping, previous, previous_simplified = 1.0, 0.0, 0.0
    rough = max(settings[1], 1e-6)
    size, settled, linearised, fine = np.inf, False, False, rough
    for iteration in range(int(settings[2])):
        if not linearised and _defects(
            kind, functions, q, layout, terms, start, fractions, nodes, end, duration, fine,
            edge, gaps, linear, speeds, True,
        ):  # fmt: skip
            return BROKEN, iteration, duration, size
        if not factorised(layout, free_time, edge, linear, speeds, basis, triangle):
            return SINGULAR, iteration, duration, size
        if not stepped(layout, gaps, linear, speeds, basis, triangle, ends, step):
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
        finer = settings[1] if size < 1e-2 else rough  # in the next iteration
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
            # A first trial is mostly the next iterate, so it is linearised there at once.
            linearised = not tried and finer == fine
            failed = _defects(
                kind, functions, q, layout, terms, start, fractions, trial, trial_end,
                duration + change, fine, trial_edge, trial_gaps, trial_linear, trial_speeds,
                linearised,
            )  # fmt: skip
            if failed or not stepped(
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
        fine = finer
        if linearised:
            linear, trial_linear = trial_linear, linear
            speeds, trial_speeds = trial_speeds, speeds
            gaps, trial_gaps = trial_gaps, gaps
            edge, trial_edge = trial_edge, edge
        previous, previous_simplified = size, correction
    return ITERATIONS, int(settings[2]), duration, size
