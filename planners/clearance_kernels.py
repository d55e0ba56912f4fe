"""Clearance of straight edges from one convex solid, exactly.

Along an edge x(t) = a + t (b - a) the signed distance f(t) to a convex solid is convex. What
settles an edge, in the order of cost:
  1. a box round the solid is out of reach, or the free ball of an end holds the edge;
  2. the half-plane of an end's gradient: f'(0) >= 0 makes the end a the nearest point of the edge,
     f'(1) <= 0 the end b;
  3. the nearest point lies inside the edge: then it faces an edge of the polytope, or the edge
     passes through.
"""

import numpy as np
from numba import float64, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled

INDEX = types.Array(types.int64, 1, "C")
EDGES = types.Array(types.int64, 2, "C")
SIDES = types.Array(float64, 3, "C")

# On the surface itself the engine's gradient may belong to any facet: closer than this, in metres,
# is contact, whose clearance counts as at most 0 and whose gradient is not used.
TOUCHING = 1e-9


@compiled(float64(VECTOR, VECTOR, VECTOR, VECTOR))
def segment_distance(a, b, c, d):
    """The distance between segments ab and cd."""
    n = a.shape[0]
    uu = vv = uv = uw = vw = 0.0
    for k in range(n):
        u, v, w = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu += u * u
        vv += v * v
        uv += u * v
        uw += u * w
        vw += v * w
    determinant = uu * vv - uv * uv
    t = 0.0
    if uu > 0.0:
        t = min(max(-uw / uu, 0.0), 1.0)
        if determinant > 1e-14 * uu * vv:
            t = min(max((uv * vw - vv * uw) / determinant, 0.0), 1.0)
    s = 0.0
    if vv > 0.0:
        s = min(max((uv * t + vw) / vv, 0.0), 1.0)
        if uu > 0.0:
            t = min(max((uv * s - uw) / uu, 0.0), 1.0)
            s = min(max((uv * t + vw) / vv, 0.0), 1.0)
    square = 0.0
    for k in range(n):
        gap = a[k] + t * (b[k] - a[k]) - c[k] - s * (d[k] - c[k])
        square += gap * gap
    return np.sqrt(square)


@compiled(INDEX(MATRIX, EDGES, VECTOR, VECTOR, MATRIX, VECTOR, VECTOR, float64))
def edges_within(points, edges, lengths, center, rotation, lower, upper, margin):
    """Indices of the edges that may come within `margin` of an oriented box.

    The test is the distance between the box and the edge's own box in the axes `rotation`, a lower
    bound on the true distance: nothing closer than `margin` is missed. An edge whose second end is
    farther than `margin` plus its length is passed over first; edges come in runs of equal second
    ends, so that this costs one look at the length.
    """
    d = points.shape[1]
    out = np.empty(edges.shape[0], dtype=np.int64)
    count = 0
    limit = margin * margin
    here, there = np.empty(d), np.empty(d)
    current, away = -1, 0.0
    for e in range(edges.shape[0]):
        b = edges[e, 1]
        if b != current:
            current = b
            square = 0.0
            for k in range(d):
                value = 0.0
                for j in range(d):
                    value += (points[b, j] - center[j]) * rotation[j, k]
                here[k] = value
                gap = max(value - upper[k], lower[k] - value)
                if gap > 0.0:
                    square += gap * gap
            away = np.sqrt(square)
        if away > margin + lengths[e]:
            continue
        a = edges[e, 0]
        square = 0.0
        for k in range(d):
            value = 0.0
            for j in range(d):
                value += (points[a, j] - center[j]) * rotation[j, k]
            there[k] = value
            low, high = min(value, here[k]), max(value, here[k])
            gap = max(low - upper[k], lower[k] - high)
            if gap > 0.0:
                square += gap * gap
        if square <= limit:
            out[count] = e
            count += 1
    return out[:count].copy()


@compiled(types.void(MATRIX, MATRIX, VECTOR, float64, VECTOR))
def ball_clearances(starts, ends, center, radius, out):
    """Exact clearance of segments `starts`, `ends` `[k, d]` from a ball."""
    for i in range(starts.shape[0]):
        out[i] = segment_distance(starts[i], ends[i], center, center) - radius


@compiled(types.void(MATRIX, EDGES, VECTOR, MATRIX, SIDES, MATRIX, VECTOR))
def polytope_clearances(points, edges, distances, gradients, sides, facets, out):
    """Exact clearance of edges from a polytope.

    Args:
        points, edges: `[n, d]`, `[m, 2]`.
        distances, gradients: `[n]`, `[n, d]`, signed distance of the points from the polytope;
            infinite for points too far to matter: clearances beyond theirs may be too large.
        sides: `[s, 2, d]`, its edges.
        facets: `[f, d + 1]`, rows (a, b) with a . x + b <= 0 inside.
        out: `[m]`, written; 0 for edges that pass through.
    """
    d = points.shape[1]
    for e in range(edges.shape[0]):
        i, j = edges[e, 0], edges[e, 1]
        a, b = points[i], points[j]
        least = min(distances[i], distances[j])
        if least <= TOUCHING:
            out[e] = min(least, 0.0)
            continue
        slope_a = slope_b = 0.0
        for k in range(d):
            slope_a += gradients[i, k] * (b[k] - a[k])
            slope_b += gradients[j, k] * (b[k] - a[k])
        if slope_a >= 0.0 and distances[i] < np.inf:
            out[e] = distances[i]
            continue
        if slope_b <= 0.0 and distances[j] < np.inf:
            out[e] = distances[j]
            continue
        enters, leaves = 0.0, 1.0
        for f in range(facets.shape[0]):
            above_a = above_b = facets[f, d]
            for k in range(d):
                above_a += facets[f, k] * a[k]
                above_b += facets[f, k] * b[k]
            if above_a > 0.0 and above_b > 0.0:
                enters = np.inf
                break
            if above_a > 0.0:
                enters = max(enters, above_a / (above_a - above_b))
            elif above_b > 0.0:
                leaves = min(leaves, above_a / (above_a - above_b))
        if enters <= leaves:
            out[e] = 0.0
            continue
        for s in range(sides.shape[0]):
            gap = segment_distance(a, b, sides[s, 0], sides[s, 1])
            least = min(least, gap)
        out[e] = least
