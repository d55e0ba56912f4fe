"""The march: values in the order of acceptance, and their repair.

The scheme at a vertex x is the fixed point of

    V(x) = min over the motions that leave x of  l + V(y),

with V linear on each piece of the link between feet (`stencils`). With efforts e_i and costs
l_i = s_i |e_i| at a piece's feet, and s their mean, the minimum of s |e| + V over the piece is that
of an eikonal equation on a simplex: the slope p with e_i . p = V(x) - V_i and |p| = s, if it points
into the piece; else it lies on the piece's boundary.

Acceptance in value order (label setting, Dijkstra's; Sethian's fast marching) gives the fixed point
in one pass if every value depends on smaller ones only. That holds for isotropic motion on a mesh
without obtuse angles. It fails for a robot that cannot move every way: a foot lies inside an edge,
and one of the edge's ends may have a value above x's own. Hence the repair (label correcting): when
a value changes, whatever reads it is computed again, accepted or not, and goes back to the queue if
it changed. The queue is ordered by the lesser of the old value and the new one, as in LPA* (Koenig,
Likhachev and Furcy 2004), so that a rise is passed on before anything is built on the value that
has gone. The same loop takes up a value on a mesh that has changed.

Passing on every change at once would run each small loop of vertices that read one another to its
end before the next; so changes below a threshold wait, and the threshold falls in stages.

A vertex may be left with a difference of `tolerance` times the least cost of leaving it, so that
the result is within `tolerance` of the fixed point, relatively: if |V - T V| <= t l_min at all
vertices then V <= T V for costs (1 + t) l, hence V <= (1 + t) V*, and likewise from below.
"""

import math

import numba
import numpy as np
from numba import int64, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64

I1 = types.Array(int64, 1, "C")
I2 = types.Array(int64, 2, "C")
FLAGS = types.Array(types.uint8, 1, "C")

FIRST_STAGE, REPAIR_STAGE, NEXT_STAGE = 0.01, 1e-4, 0.1
FACTOR_STEPS, FACTOR_TOLERANCE = 20, 1e-6
OUT = -1  # place of a vertex that is not in the queue

inlined = numba.njit(inline="always", error_model="numpy")


@inlined
def _rise(keys, heap, place, i, key, v):
    """Put `v` at `i` of the queue (four children a node), or nearer to its top."""
    while i > 0:
        parent = (i - 1) >> 2
        if keys[parent] <= key:
            break
        keys[i] = keys[parent]
        heap[i] = heap[parent]
        place[heap[i]] = i
        i = parent
    keys[i] = key
    heap[i] = v
    place[v] = i


@inlined
def _sink(keys, heap, place, size, i, key, v):
    """Put `v` at `i` of a queue of `size`, or as far down as it must."""
    while True:
        child = 4 * i + 1
        if child >= size:
            break
        least, best = keys[child], child
        for j in range(child + 1, min(child + 4, size)):
            if keys[j] < least:
                least, best = keys[j], j
        if least >= key:
            break
        keys[i] = least
        heap[i] = heap[best]
        place[heap[i]] = i
        i = best
    keys[i] = key
    heap[i] = v
    place[v] = i


@inlined
def _foot_value(values, nodes, weight, f):
    i, j, w = nodes[f, 0], nodes[f, 1], weight[f]
    if i < 0:
        return 0.0
    if w == 0.0:
        return values[i]
    if w == 1.0:
        return values[j]
    return (1.0 - w) * values[i] + w * values[j]


@inlined
def _inside(effort, cost, pieces, p, at, factor, shares):
    """The minimum inside a piece, with the feet's shares of it in `shares`; else infinite.

    `at` `[3]` are the values at its feet.
    """
    m = effort.shape[1]
    f, g, h = pieces[p, 0], pieces[p, 1], pieces[p, 2]
    ff, fg, gg = 0.0, 0.0, 0.0
    for k in range(m):
        ff += effort[f, k] * effort[f, k]
        fg += effort[f, k] * effort[g, k]
        gg += effort[g, k] * effort[g, k]
    if h < 0:
        # e = e_f + t (e_g - e_f): minimise s |e| + V_f + t (V_g - V_f).
        slowness = 0.5 * factor * (cost[f] / math.sqrt(ff) + cost[g] / math.sqrt(gg))
        length = math.sqrt(max(ff + gg - 2.0 * fg, 0.0))
        if not length > 0.0:
            return np.inf
        along = (fg - ff) / length  # where e_f is on the line through both feet
        height = math.sqrt(max(ff - along * along, 0.0))
        r = (at[1] - at[0]) / (slowness * length)
        if not abs(r) < 1.0:
            return np.inf
        root = math.sqrt(1.0 - r * r)
        t = (-height * r / root - along) / length
        if not 0.0 < t < 1.0:
            return np.inf
        shares[0], shares[1], shares[2] = 1.0 - t, t, 0.0
        return at[0] - r * slowness * along + slowness * height * root
    fh, gh, hh = 0.0, 0.0, 0.0
    for k in range(m):
        fh += effort[f, k] * effort[h, k]
        gh += effort[g, k] * effort[h, k]
        hh += effort[h, k] * effort[h, k]
    slowness = cost[f] / math.sqrt(ff) + cost[g] / math.sqrt(gg) + cost[h] / math.sqrt(hh)
    slowness *= factor / 3.0
    # The inverse of the Gram matrix, times its determinant
    a, b, c = gg * hh - gh * gh, fh * gh - fg * hh, fg * gh - fh * gg
    d, e, k = ff * hh - fh * fh, fg * fh - ff * gh, ff * gg - fg * fg
    det = ff * a + fg * b + fh * c
    if not det > 0.0:
        return np.inf
    low = min(at[0], at[1], at[2])
    u, v, w = at[0] - low, at[1] - low, at[2] - low
    ones = a + d + k + 2.0 * (b + c + e)
    mixed = (a + b + c) * u + (b + d + e) * v + (c + e + k) * w
    square = a * u * u + d * v * v + k * w * w + 2.0 * (b * u * v + c * u * w + e * v * w)
    root = mixed * mixed - ones * (square - slowness * slowness * det)
    if not root >= 0.0:
        return np.inf
    total = (mixed + math.sqrt(root)) / ones
    x, y, z = total - u, total - v, total - w
    first, second, third = a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + k * z
    if not (first > 0.0 and second > 0.0 and third > 0.0):
        return np.inf
    both = first + second + third
    shares[0], shares[1], shares[2] = first / both, second / both, third / both
    return low + total


@inlined
def _update(v, values, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares):
    """T V at a vertex."""
    first, best = span[v, 0], np.inf
    for f in range(first, span[v, 1]):
        foot[f - first] = _foot_value(values, nodes, weight, f)
        best = min(best, foot[f - first] + factor[v] * cost[f])
    for p in range(span[v, 2], span[v, 3]):
        at[0], at[1] = foot[pieces[p, 0] - first], foot[pieces[p, 1] - first]
        lowest = min(at[0], at[1])
        if pieces[p, 2] >= 0:
            at[2] = foot[pieces[p, 2] - first]
            lowest = min(lowest, at[2])
        if lowest < best:  # else no point of the piece is
            best = min(best, _inside(effort, cost, pieces, p, at, factor[v], shares))
    return best


@compiled(int64(I2))
def _most_feet(span):
    most = 0
    for v in range(span.shape[0]):
        most = max(most, span[v, 1] - span[v, 0])
    return most


@compiled(types.void(VECTOR, VECTOR, I2, I2, VECTOR, MATRIX, VECTOR, I2, I1, VECTOR))
def updates(values, factor, span, nodes, weight, effort, cost, pieces, which, out):
    """T V `[k]` at the vertices `which` `[k]`."""
    foot, at, shares = np.empty(_most_feet(span)), np.empty(3), np.empty(3)
    for row in range(which.shape[0]):
        out[row] = _update(
            which[row], values, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares
        )


@compiled(
    types.void(VECTOR, I2, I2, VECTOR, MATRIX, VECTOR, I2, I1, float64, float64, VECTOR)
)  # fmt: skip
def factors(exact, span, nodes, weight, effort, cost, pieces, which, lowest, highest, factor):
    """Into `factor`, at the vertices `which`, the factor of costs in [lowest, highest] with which
    `exact` `[N]` solves the vertex's equation; the nearer bound if none does."""
    foot, at, shares = np.empty(_most_feet(span)), np.empty(3), np.empty(3)
    for v in which:
        # T rises with the factor. Regula falsi (Illinois), from 1 and the bound beyond the root.
        low, high, below, above = lowest, highest, 0.0, 0.0
        for _ in range(FACTOR_STEPS):
            if below < 0.0 and above > 0.0:
                factor[v] = low + (high - low) * below / (below - above)
            else:
                factor[v] = lowest if above > 0.0 else highest if below < 0.0 else 1.0
            excess = _update(
                v, exact, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares
            )
            excess -= exact[v]
            if abs(excess) <= FACTOR_TOLERANCE * exact[v]:
                break
            if excess < 0.0:
                if factor[v] >= highest:
                    break
                above *= 0.5 if below < 0.0 else 1.0
                low, below = factor[v], excess
            else:
                if factor[v] <= lowest:
                    break
                below *= 0.5 if above > 0.0 else 1.0
                high, above = factor[v], excess


@compiled(VECTOR(I2, VECTOR, VECTOR))
def least_costs(span, cost, factor):
    """`[N]`, the least cost of leaving each vertex; infinite where nothing leaves it."""
    out = np.full(span.shape[0], np.inf)
    for v in range(span.shape[0]):
        for f in range(span[v, 0], span[v, 1]):
            out[v] = min(out[v], factor[v] * cost[f])
    return out


@compiled(
    types.UniTuple(int64, 3)(
        VECTOR, FLAGS, VECTOR, I2, I2, VECTOR, MATRIX, VECTOR, I2, I1, I1, I1, float64,
        types.boolean, int64, I1, float64,
    )
)  # fmt: skip
def march(
    values, fixed, factor, span, nodes, weight, effort, cost, pieces, reader_start, readers, stale,
    tolerance, repair, budget, accepted, first_stage,
):  # fmt: skip
    """Bring `values` `[N]` to the fixed point; returns updates, acceptances and rises.

    Args:
        values: to start from; any finite values will do, infinite ones where nothing is known.
        fixed: `[N]`, values that stay.
        factor: `[N]`, of costs.
        span to pieces: of `Stencils`.
        reader_start, readers: of `Stencils.readers`.
        stale: vertices where the equation may not hold.
        tolerance: see above.
        repair: whether values that were accepted may change.
        budget: of updates; when it is spent, the number of updates is returned as -1.
        accepted: `[N]`, how often each was accepted; added to.
        first_stage: the first threshold, relative as the tolerance: FIRST_STAGE from infinite
            values, REPAIR_STAGE from values that are mostly right.
    """
    count = span.shape[0]
    foot, at, shares = np.empty(_most_feet(span)), np.empty(3), np.empty(3)
    least = least_costs(span, cost, factor)
    wanted = values.copy()
    place = np.full(count, OUT, dtype=np.int64)
    keys, heap = np.empty(count), np.empty(count, dtype=np.int64)
    waiting = np.zeros(count, dtype=np.uint8)
    size, done, acceptances, rises = 0, 0, 0, 0
    for v in stale:
        if not fixed[v]:
            wanted[v] = _update(
                v, values, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares
            )
            done += 1
            waiting[v] = 1
    stage = max(first_stage, tolerance)
    while True:
        for v in range(count):
            if waiting[v]:
                gap = abs(wanted[v] - values[v])
                waiting[v] = gap > tolerance * least[v]
                if gap > stage * least[v]:
                    _rise(keys, heap, place, size, min(wanted[v], values[v]), v)
                    size += 1
        while size > 0:
            v = heap[0]
            place[v] = OUT
            size -= 1
            if size > 0:
                _sink(keys, heap, place, size, 0, keys[size], heap[size])
            if not abs(wanted[v] - values[v]) > stage * least[v]:
                continue
            acceptances += 1
            accepted[v] += 1
            rises += wanted[v] > values[v]
            values[v] = wanted[v]
            for r in range(reader_start[v], reader_start[v + 1]):
                w = readers[r]
                if fixed[w] or (accepted[w] > 0 and not repair):
                    continue
                new = _update(
                    w, values, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares
                )
                done += 1
                wanted[w] = new
                waiting[w] = 1
                if not abs(new - values[w]) > stage * least[w]:
                    continue  # if it is in the queue, it will be passed over there
                key, p = min(new, values[w]), place[w]
                if p == OUT:
                    _rise(keys, heap, place, size, key, w)
                    size += 1
                elif key < keys[p]:
                    _rise(keys, heap, place, p, key, w)
                elif key > keys[p]:
                    _sink(keys, heap, place, size, p, key, w)
            if done > budget:
                return -1, acceptances, rises
        if stage <= tolerance:
            return done, acceptances, rises
        stage = max(tolerance, NEXT_STAGE * stage)


@compiled(
    types.UniTuple(int64, 2)(
        VECTOR, FLAGS, VECTOR, I2, I2, VECTOR, MATRIX, VECTOR, I2, float64, int64
    )
)
def sweep(values, fixed, factor, span, nodes, weight, effort, cost, pieces, tolerance, limit):
    """Plain value iteration, V <- T V all at once, until no value changes by more than `tolerance`
    times the least cost of leaving its vertex: sweeps (-1 if `limit` was met) and updates."""
    count = span.shape[0]
    foot, at, shares = np.empty(_most_feet(span)), np.empty(3), np.empty(3)
    least = least_costs(span, cost, factor)
    new, done = values.copy(), 0
    for sweeps in range(limit):
        quiet = True
        for v in range(count):
            if fixed[v]:
                continue
            new[v] = _update(
                v, values, factor, span, nodes, weight, effort, cost, pieces, foot, at, shares
            )
            done += 1
            quiet = quiet and not abs(new[v] - values[v]) > tolerance * least[v]
        values[:] = new
        if quiet:
            return sweeps + 1, done
    return -1, done


@compiled(
    types.void(VECTOR, FLAGS, VECTOR, I2, I2, VECTOR, MATRIX, VECTOR, I2, I1, VECTOR, int64, VECTOR)
)
def spread(
    values, fixed, factor, span, nodes, weight, effort, cost, pieces, order, mass, passes, total
):
    """How much of `mass` `[N]`, moved along best motions, comes by each vertex: into `total` `[N]`.

    Args:
        order: vertices by falling value; where a motion ends at a greater value, the rest moves on
            in the next of `passes`.
    """
    foot, at, shares = np.empty(_most_feet(span)), np.empty(3), np.empty(3)
    best_shares, row = np.empty(3), np.empty(3, dtype=np.int64)
    for _ in range(passes):
        for v in order:
            load = mass[v]
            if load == 0.0:
                continue
            mass[v] = 0.0
            total[v] += load
            if fixed[v] or not values[v] < np.inf:
                continue
            first, best = span[v, 0], np.inf
            row[:] = -1
            best_shares[:] = 0.0
            for f in range(first, span[v, 1]):
                foot[f - first] = _foot_value(values, nodes, weight, f)
                if foot[f - first] + factor[v] * cost[f] < best:
                    best = foot[f - first] + factor[v] * cost[f]
                    row[0], row[1], row[2] = f, -1, -1
                    best_shares[0], best_shares[1], best_shares[2] = 1.0, 0.0, 0.0
            for p in range(span[v, 2], span[v, 3]):
                for k in range(3):
                    if pieces[p, k] >= 0:
                        at[k] = foot[pieces[p, k] - first]
                t = _inside(effort, cost, pieces, p, at, factor[v], shares)
                if t < best:
                    best = t
                    row[:] = pieces[p]
                    best_shares[:] = shares
            for k in range(3):
                f = row[k]
                if f >= 0 and nodes[f, 0] >= 0:
                    part = load * best_shares[k]
                    mass[nodes[f, 0]] += part * (1.0 - weight[f])
                    mass[nodes[f, 1]] += part * weight[f]
