"""The loops of fast marching: the heap, the update of a node, the march; see `fast_marching`."""

import math

import numba
import numpy as np
from numba import types

from ocp.compiled.jit import compiled, float64

I1, I2, I3 = (types.Array(types.int32, k, "C") for k in (1, 2, 3))
F1, F2 = (types.Array(types.float64, k, "C") for k in (1, 2))
BITS = types.Array(types.uint32, 1, "C")

# Small functions are inlined: handing over arrays would take as long as their work.
inlined = numba.njit(inline="always", error_model="numpy")

FAR, ACCEPTED = -1, -2  # places of nodes that are not in the heap
LIMIT = 8.0  # 4 costs a little accuracy; without a limit, ties moved values by up to 5 %
DOUBLED = 12  # the first bit of doubled offsets; at most 6 offsets, 2 sides


@inlined
def _rise(keys, nodes, place, i, key, node):
    """Put `node` at `i` of the heap (four children a node), or nearer to its top."""
    while i > 0:
        parent = (i - 1) >> 2
        if keys[parent] <= key:
            break
        keys[i] = keys[parent]
        nodes[i] = nodes[parent]
        place[nodes[i]] = i
        i = parent
    keys[i] = key
    nodes[i] = node
    place[node] = i


@inlined
def _sink(keys, nodes, place, size, key, node):
    """Put `node` at the top of a heap of `size`, whose top is free, or as far down as it must."""
    i = 0
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
        nodes[i] = nodes[best]
        place[nodes[i]] = i
        i = best
    keys[i] = key
    nodes[i] = node
    place[node] = i


@inlined
def _share(v, a, b):
    """How much of the second difference to take at v, with a < v next to it and b < a beyond.

    The difference is (v - a) + share / 2 ((v - a) - (a - b)). All of it where V is smooth; less if
    b comes near to a, so that the result does not jump where b falls out of use (b >= a), and ties
    between nodes do not matter.
    """
    return min(1.0, LIMIT * (a - b) / (v - a))


@compiled(float64(types.int64, F1, F1, float64))
def _solved(m, below, weight, right):
    """The t with sum_i weight_i max(0, t - below_i)^2 = right, over the first m > 0 entries.

    `below` and `weight` are sorted in place. Shifted by the least of `below`, so that only
    differences are squared.
    """
    for i in range(1, m):
        v, w, j = below[i], weight[i], i - 1
        while j >= 0 and below[j] > v:
            below[j + 1], weight[j + 1] = below[j], weight[j]
            j -= 1
        below[j + 1], weight[j + 1] = v, w
    a, b, c = weight[0], 0.0, -right
    t = math.sqrt(right / a)
    for i in range(1, m):
        u = below[i] - below[0]
        if u >= t:
            break
        a += weight[i]
        b += weight[i] * u
        c += weight[i] * u * u
        t = (b + math.sqrt(max(b * b - a * c, 0.0))) / a
    return below[0] + t


@compiled(types.void(F1, I1, I1, F2, I3, I3, types.boolean, F1, F1))
def schemes(values, entry, count, weights, near, far, second_order, first, final):
    """The scheme's left side at given values: of first order, and that of acceptance."""
    for x in range(values.shape[0]):
        k = entry[x]
        v = values[x]
        if k < 0 or not v < np.inf:
            continue
        total, total_final = 0.0, 0.0
        for f in range(count[k]):
            a, b, s = values[x + near[k, f, 0]], values[x + near[k, f, 1]], 0
            if b < a:
                a, s = b, 1
            if not a < v:
                continue
            total += weights[k, f] * (v - a) ** 2
            w = weights[k, f]
            if second_order:
                b = values[x + far[k, f, s]]
                if b < a and b > 0.0:
                    share = _share(v, a, b)
                    a += share * (a - b) / (2.0 + share)
                    w *= (1.0 + 0.5 * share) ** 2
            total_final += w * max(0.0, v - a) ** 2
        first[x], final[x] = total, total_final


@compiled(types.int64(F1, F1, F1, I1, I1, F2, I3, I3, I1, I2, F1, BITS, F2, types.boolean, I1))
def march(
    values, first, final, entry, count, weights, near, far, reverse_start, reverse,
    reverse_weight, shut, starts, second_order, accepted,
):  # fmt: skip
    """Fill `values` `[N]`, infinite but where given; returns how many nodes were accepted.

    Args:
        first, final: right sides of the scheme of first order and of that of acceptance. A negative
            `final` says that the node keeps the value with which it leaves the heap.
        entry to reverse_weight: of `SellingStencil`; nodes with entry < 0 are never accepted.
        shut: `[N]` bits 2 f + s of offsets that are not to be used, from DOUBLED on doubled ones;
            empty if all are.
        starts: `[j, 2]`, nodes and upper bounds of their values.
        second_order: whether to compute a node anew when it is accepted.
        accepted: filled with the nodes in the order of acceptance.

    A neighbour x of y that is accepted last has the largest value among y's, so y's quadratic is
    kept (`sums`: the newest value v, then sum w, sum w (V_i - v), sum w (V_i - v)^2) and only gets
    one more term. Where values came out of order, or y has an accepted node opposite to x, it is
    made anew.
    """
    n = values.shape[0]
    place = np.full(n, FAR, dtype=np.int32)
    keys, nodes = np.empty(n), np.empty(n, dtype=np.int32)
    sums = np.empty((n, 4))
    below, weight = np.empty(6), np.empty(6)
    obstructed = shut.shape[0] > 0
    given = 0
    for x in range(n):
        if entry[x] < 0:
            place[x] = ACCEPTED
        elif values[x] < np.inf:
            place[x] = ACCEPTED
            accepted[given] = x  # lent, until the march itself needs the room
            given += 1
    size = 0
    for row in range(starts.shape[0]):
        x = int(starts[row, 0])
        if place[x] == FAR:
            sums[x, 0], sums[x, 1] = np.inf, 0.0
            _rise(keys, nodes, place, size, starts[row, 1], x)
            size += 1

    done = -given
    while done < 0 or size > 0:
        if done < 0:
            x = accepted[given + done]
            v, k = values[x], entry[x]
        else:
            x, v = nodes[0], keys[0]
            size -= 1
            if size > 0:
                _sink(keys, nodes, place, size, keys[size], nodes[size])
            place[x] = ACCEPTED
            k = entry[x]
            if second_order and final[x] >= 0.0:
                closed = shut[x] if obstructed else np.uint32(0)
                m = 0
                for f in range(count[k]):
                    a, b, s = values[x + near[k, f, 0]], values[x + near[k, f, 1]], 0
                    if closed:
                        a = np.inf if closed >> np.uint32(2 * f) & np.uint32(1) else a
                        b = np.inf if closed >> np.uint32(2 * f + 1) & np.uint32(1) else b
                    if b < a:
                        a, s = b, 1
                    if not a < v:
                        continue
                    below[m], weight[m] = a, weights[k, f]
                    b = values[x + far[k, f, s]]
                    bit = np.uint32(DOUBLED + 2 * f + s)
                    if b < a and b > 0.0 and not closed >> bit & np.uint32(1):
                        share = _share(v, a, b)
                        below[m] = a + share * (a - b) / (2.0 + share)
                        weight[m] *= (1.0 + 0.5 * share) ** 2
                    m += 1
                if m > 0:
                    v = _solved(m, below, weight, final[x])
            values[x] = v
            accepted[done] = x
        done += 1

        for r in range(reverse_start[k], reverse_start[k + 1]):
            y = x + reverse[r, 0]
            p = place[y]
            if p == ACCEPTED:
                continue
            closed = shut[y] if obstructed else np.uint32(0)
            if closed >> np.uint32(reverse[r, 3]) & np.uint32(1):
                continue
            if p == FAR:
                w = reverse_weight[r]
                sums[y, 0], sums[y, 1], sums[y, 2], sums[y, 3] = v, w, 0.0, 0.0
                _rise(keys, nodes, place, size, v + math.sqrt(first[y] / w), y)
                size += 1
                continue
            key = keys[p]
            if key <= v:
                continue
            opposite = values[y + reverse[r, 1]]
            if closed >> np.uint32(reverse[r, 3] ^ 1) & np.uint32(1):
                opposite = np.inf
            if opposite <= v:
                continue
            shift = v - sums[y, 0]
            if shift >= 0.0 and opposite == np.inf:
                a, b, c = sums[y, 1], sums[y, 2], sums[y, 3]
                c += shift * (a * shift - 2.0 * b)
                b -= shift * a
                a += reverse_weight[r]
                sums[y, 0], sums[y, 1], sums[y, 2], sums[y, 3] = v, a, b, c
                t = v + (b + math.sqrt(max(b * b - a * (c - first[y]), 0.0))) / a
            else:
                ky, m, last = reverse[r, 2], 0, v
                for f in range(count[ky]):
                    a, b = values[y + near[ky, f, 0]], values[y + near[ky, f, 1]]
                    if closed:
                        a = np.inf if closed >> np.uint32(2 * f) & np.uint32(1) else a
                        b = np.inf if closed >> np.uint32(2 * f + 1) & np.uint32(1) else b
                    a = min(a, b)
                    if a < np.inf:
                        below[m], weight[m] = a, weights[ky, f]
                        last = max(last, a)
                        m += 1
                a, b, c = 0.0, 0.0, 0.0
                for i in range(m):
                    u = below[i] - last
                    a += weight[i]
                    b += weight[i] * u
                    c += weight[i] * u * u
                sums[y, 0], sums[y, 1], sums[y, 2], sums[y, 3] = last, a, b, c
                t = _solved(m, below, weight, first[y])
            if t < key:
                _rise(keys, nodes, place, p, t, y)
    return done


@compiled(
    types.void(
        I1,
        types.Array(types.int64, 1, "C"),
        types.Array(types.int64, 3, "C"),
        types.Array(types.int64, 2, "C"),
        types.int64,
        BITS,
    )
)
def collect(entry, place, which, blocked, width, out):
    """Bits of `march`'s `shut` from bit masks of moves.

    Args:
        entry: `[N]`.
        place: `[N]`, where in `blocked` a node's position is.
        which: `[k, 2, 2 F]`, the moves of offsets and of doubled offsets.
        blocked: `[c, positions]`, bit masks of `width` moves each.
    """
    for x in range(entry.shape[0]):
        k = entry[x]
        if k < 0:
            continue
        bits = 0
        for doubled in range(2):
            for j in range(which.shape[2]):
                move = which[k, doubled, j]
                if blocked[move // width, place[x]] >> (move % width) & 1:
                    bits |= 1 << (DOUBLED * doubled + j)
        out[x] = bits
