"""Growing the graph: near neighbours within the shrinking radius, and its compressed rows.

Nodes are numbered in the order of their insertion. Every edge joins a newer node to an older one
and is made when the newer is inserted; edges are listed by their newer end.
"""

import numpy as np
from numba import boolean, float64, int64, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled

INDEX = types.Array(types.int64, 1, "C")
EDGES = types.Array(types.int64, 2, "C")
NODES = types.Array(types.int32, 1, "C")
FLAGS = types.Array(boolean, 1, "C")


@compiled(float64(float64, float64, int64, int64))
def shrinking_radius(reach, gamma, count, dimension):
    """min(reach, gamma (log n / n)^(1/d)), as in Karaman and Frazzoli (2011)."""
    if count < 2:
        return reach
    return min(reach, gamma * (np.log(count) / count) ** (1.0 / dimension))


@compiled(types.Tuple((EDGES, VECTOR))(MATRIX, int64, VECTOR, VECTOR, float64, float64))
def connect(points, first, lower, upper, reach, gamma):
    """Join the nodes `first`, ... to their older near neighbours.

    A sample farther than `reach` from every node is pulled along the line to the nearest one until
    it is within reach; a sample with no neighbour within the radius is joined to the nearest node.

    Args:
        points: `[n, d]`, insertion order; rows from `first` on may be pulled.
        first: number of nodes already joined; at least 1.
        lower, upper: `[d]`, the box that holds all points.

    Returns:
        the edges `[m, 2]` (older, newer) and their lengths `[m]`.
    """
    n, d = points.shape
    axes = min(d, 3)
    cell = shrinking_radius(reach, gamma, n, d)
    counts = np.ones(3, dtype=np.int64)
    for k in range(axes):
        counts[k] = min(max(int((upper[k] - lower[k]) / cell), 1), 256)
    heads = np.full(counts[0] * counts[1] * counts[2], -1, dtype=np.int64)
    following = np.full(n, -1, dtype=np.int64)
    edges = np.empty((64 * max(n - first, 1), 2), dtype=np.int64)
    lengths = np.empty(edges.shape[0])
    m = 0
    low, high, at = (
        np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
    )
    for i in range(n):
        if i >= first:
            radius = shrinking_radius(reach, gamma, i + 1, d)
            for attempt in range(2):
                begun = m
                for k in range(axes):
                    scale = counts[k] / (upper[k] - lower[k])
                    low[k] = min(
                        max(int((points[i, k] - radius - lower[k]) * scale), 0), counts[k] - 1
                    )
                    high[k] = min(
                        max(int((points[i, k] + radius - lower[k]) * scale), 0), counts[k] - 1
                    )
                for p in range(low[0], high[0] + 1):
                    for q in range(low[1], high[1] + 1):
                        for s in range(low[2], high[2] + 1):
                            j = heads[(p * counts[1] + q) * counts[2] + s]
                            while j >= 0:
                                square = 0.0
                                for k in range(d):
                                    gap = points[i, k] - points[j, k]
                                    square += gap * gap
                                if square <= radius * radius:
                                    if m == edges.shape[0]:
                                        more = np.empty((2 * m, 2), dtype=np.int64)
                                        more[:m] = edges
                                        edges = more
                                        longer = np.empty(2 * m)
                                        longer[:m] = lengths
                                        lengths = longer
                                    edges[m, 0], edges[m, 1] = j, i
                                    lengths[m] = np.sqrt(square)
                                    m += 1
                                j = following[j]
                if m > begun or attempt == 1:
                    break
                nearest, best = 0, np.inf
                for j in range(i):
                    square = 0.0
                    for k in range(d):
                        gap = points[i, k] - points[j, k]
                        square += gap * gap
                    if square < best:
                        best, nearest = square, j
                distance = np.sqrt(best)
                if distance > reach:
                    for k in range(d):
                        step = (points[i, k] - points[nearest, k]) * (reach / distance)
                        points[i, k] = points[nearest, k] + step
                # Look again from the new place, at least as far as the nearest node.
                radius = max(radius, min(distance, reach) * (1.0 + 1e-12))
        for k in range(axes):
            scale = counts[k] / (upper[k] - lower[k])
            at[k] = min(max(int((points[i, k] - lower[k]) * scale), 0), counts[k] - 1)
        place = (at[0] * counts[1] + at[1]) * counts[2] + at[2]
        following[i] = heads[place]
        heads[place] = i
    return edges[:m].copy(), lengths[:m].copy()


ROWS = types.Tuple((INDEX, INDEX, INDEX, NODES, VECTOR, INDEX))


@compiled(ROWS(int64, EDGES, VECTOR, FLAGS, NODES, float64))
def compress(n, edges, lengths, blocked, parent, cull_radius):
    """Compressed rows: each node's half-edges side by side, blocked ones of infinite weight.

    A node's half-edges come in three runs: [start, both) may be used either way; [both, into) only
    by the neighbour, towards this node; [into, next start) only by this node. The last two runs
    are empty unless `cull_radius` is finite: then an edge longer than it is of use to its newer end
    only (the older end has forgotten its running neighbour), except while it is in the tree.

    Returns:
        start `[n + 1]`, both `[n]`, into `[n]`, target `[2 m]`, weight `[2 m]`, and slot `[2 m]`:
        the half-edges of edge e are slot[2 e] (of its older end) and slot[2 e + 1].
    """
    m = edges.shape[0]
    start = np.zeros(n + 1, dtype=np.int64)
    both = np.zeros(n, dtype=np.int64)
    into = np.zeros(n, dtype=np.int64)
    one_way = np.zeros(m, dtype=np.bool_)
    for e in range(m):
        u, v = edges[e, 0], edges[e, 1]
        one_way[e] = lengths[e] > cull_radius and parent[u] != v and parent[v] != u
        start[u + 1] += 1
        start[v + 1] += 1
        if one_way[e]:
            into[u] += 1
        else:
            both[u] += 1
            both[v] += 1
    for i in range(n):
        start[i + 1] += start[i]
        both[i] += start[i]
        into[i] += both[i]
    fill_both, fill_into, fill_last = start[:n].copy(), both.copy(), into.copy()
    target = np.empty(2 * m, dtype=np.int32)
    weight = np.empty(2 * m)
    slot = np.empty(2 * m, dtype=np.int64)
    for e in range(m):
        u, v = edges[e, 0], edges[e, 1]
        if one_way[e]:
            a, b = fill_into[u], fill_last[v]
            fill_into[u] += 1
            fill_last[v] += 1
        else:
            a, b = fill_both[u], fill_both[v]
            fill_both[u] += 1
            fill_both[v] += 1
        target[a], target[b] = v, u
        weight[a] = weight[b] = np.inf if blocked[e] else lengths[e]
        slot[2 * e], slot[2 * e + 1] = a, b
    return start, both, into, target, weight, slot


@compiled(types.Tuple((INDEX, VECTOR))(MATRIX, VECTOR, float64))
def nodes_within(points, center, radius):
    """The nodes within `radius` of `center` `[d]`, and their distances."""
    out = np.empty(points.shape[0], dtype=np.int64)
    away = np.empty(points.shape[0])
    count = 0
    for i in range(points.shape[0]):
        square = 0.0
        for k in range(points.shape[1]):
            gap = points[i, k] - center[k]
            square += gap * gap
        if square <= radius * radius:
            out[count] = i
            away[count] = np.sqrt(square)
            count += 1
    return out[:count].copy(), away[:count].copy()


@compiled(types.void(VECTOR, VECTOR, INDEX, VECTOR, VECTOR))
def lower_to(all_lower, all_upper, index, lower, upper):
    """Lower the edges' clearances to one solid's."""
    for i in range(index.shape[0]):
        e = index[i]
        all_lower[e] = min(all_lower[e], lower[i])
        all_upper[e] = min(all_upper[e], upper[i])


@compiled(types.void(VECTOR, VECTOR, FLAGS, INDEX, VECTOR, VECTOR))
def lower_marked(all_lower, all_upper, marked, index, lower, upper):
    """`lower_to` for the marked edges only."""
    for i in range(index.shape[0]):
        e = index[i]
        if marked[e]:
            all_lower[e] = min(all_lower[e], lower[i])
            all_upper[e] = min(all_upper[e], upper[i])


@compiled(INDEX(VECTOR, VECTOR, float64))
def undecided(lower, upper, threshold):
    """Indices whose interval does not say on which side of the threshold it lies."""
    out = np.empty(lower.shape[0], dtype=np.int64)
    count = 0
    for e in range(lower.shape[0]):
        if lower[e] <= threshold < upper[e]:
            out[count] = e
            count += 1
    return out[:count].copy()


@compiled(types.Tuple((INDEX, INDEX))(VECTOR, float64, FLAGS))
def reclassify(lower, threshold, blocked):
    """Update the flags `blocked`: lower <= threshold. Returns the edges now blocked and freed."""
    gone, freed = (
        np.empty(lower.shape[0], dtype=np.int64),
        np.empty(lower.shape[0], dtype=np.int64),
    )
    a = b = 0
    for e in range(lower.shape[0]):
        now = lower[e] <= threshold
        if now != blocked[e]:
            if now:
                gone[a] = e
                a += 1
            else:
                freed[b] = e
                b += 1
            blocked[e] = now
    return gone[:a].copy(), freed[:b].copy()


@compiled(types.Tuple((EDGES, MATRIX))(MATRIX, VECTOR, MATRIX, float64, int64))
def nearest_first(points, cost_to_go, queries, radius, count):
    """The `count` nodes through which each query point gets to the goal most cheaply.

    Returns:
        nodes `[k, count]`, cheapest first, -1 for none, and the costs `[k, count]` through them.
    """
    k, d = queries.shape
    nodes = np.full((k, count), -1, dtype=np.int64)
    costs = np.full((k, count), np.inf)
    for q in range(k):
        for i in range(points.shape[0]):
            square = 0.0
            for j in range(d):
                gap = points[i, j] - queries[q, j]
                square += gap * gap
            if square > radius * radius:
                continue
            cost = cost_to_go[i] + np.sqrt(square)
            if not cost < costs[q, count - 1]:
                continue
            at = count - 1
            while at > 0 and costs[q, at - 1] > cost:
                costs[q, at], nodes[q, at] = costs[q, at - 1], nodes[q, at - 1]
                at -= 1
            costs[q, at], nodes[q, at] = cost, i
    return nodes, costs


@compiled(types.Tuple((INDEX, INDEX))(INDEX, FLAGS))
def net_changes(toggled, blocked):
    """Of edges listed once for each time they changed, those that did so on balance.

    Args:
        toggled: sorted.
        blocked: `[m]`, as it is now.

    Returns:
        the edges blocked and those freed.
    """
    gone = np.empty(toggled.shape[0], dtype=np.int64)
    freed = np.empty(toggled.shape[0], dtype=np.int64)
    a = b = i = 0
    while i < toggled.shape[0]:
        j = i
        while j < toggled.shape[0] and toggled[j] == toggled[i]:
            j += 1
        if (j - i) % 2 == 1:
            if blocked[toggled[i]]:
                gone[a] = toggled[i]
                a += 1
            else:
                freed[b] = toggled[i]
                b += 1
        i = j
    return gone[:a].copy(), freed[:b].copy()
