"""The shortest way among padded convex solids of the plane, by the visibility graph.

Written apart from the planner, with formulas of its own, to judge it.
"""

from collections.abc import Iterable

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ocp.compiled.jit import MATRIX, compiled
from planners.solids import Solid

INDEX = types.Array(types.int64, 1, "C")


def shortest_way(
    solids: Iterable[Solid],
    start: ArrayLike,
    goal: ArrayLike,
    padding: float = 0.0,
    facets_per_turn: int = 64,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
) -> tuple[float, NDArray[np.float64]]:
    """Length and corners `[k, 2]` of the shortest way; infinite and empty if there is none.

    Every padded solid is replaced by an inscribed polygon, so that the length is a lower bound,
    short by a relative (pi / facets_per_turn)^2 / 6 of the part that follows arcs.

    Args:
        facets_per_turn: sides of the polygon that stands for a full circle.
        bounds: lower and upper corner of a box that the way may not leave.
    """
    outlines = [_outline(solid, padding, facets_per_turn) for solid in solids]
    corners = np.concatenate([np.array([start, goal], dtype=float), *outlines])
    halves = [_half_planes(outline) for outline in outlines]
    keep = np.ones(len(corners), dtype=bool)
    if bounds is not None:
        keep &= ((corners >= np.array(bounds[0])) & (corners <= np.array(bounds[1]))).all(axis=1)
    for normals, offsets in halves:
        keep &= ~(corners @ normals.T + offsets < -1e-9).all(axis=1)
    if not keep[:2].all():
        return np.inf, np.zeros((0, 2))
    corners = corners[keep]
    sizes = np.cumsum([0, *(len(normals) for normals, _ in halves)])
    planes = np.zeros((int(sizes[-1]), 3))
    for first, (normals, offsets) in zip(sizes[:-1], halves, strict=True):
        planes[first : first + len(normals)] = np.column_stack([normals, offsets])
    boxes = np.array([[*o.min(axis=0), *o.max(axis=0)] for o in outlines]).reshape(-1, 4)
    i, j = _visible(np.ascontiguousarray(corners), planes, sizes, boxes)
    lengths = np.linalg.norm(corners[i] - corners[j], axis=1)
    graph = csr_array((lengths, (i, j)), shape=(len(corners),) * 2)
    cost, before = dijkstra(graph, directed=False, indices=0, return_predecessors=True)
    if not np.isfinite(cost[1]):
        return np.inf, np.zeros((0, 2))
    way = [1]
    while way[-1] != 0:
        way.append(int(before[way[-1]]))
    return float(cost[1]), corners[way[::-1]]


def _outline(solid: Solid, padding: float, facets_per_turn: int) -> NDArray[np.float64]:
    """Vertices `[k, 2]`, counter-clockwise, of a polygon inscribed in the padded solid."""
    radius = solid.radius + padding
    vertices = solid.vertices
    if radius == 0:
        return vertices
    if len(vertices) == 1:
        turns = np.arange(facets_per_turn) * (2 * np.pi / facets_per_turn)
        return vertices + radius * np.column_stack([np.cos(turns), np.sin(turns)])
    along = np.roll(vertices, -1, axis=0) - vertices
    leaving = np.arctan2(-along[:, 0], along[:, 1])
    pieces = []
    for vertex, first, last in zip(vertices, np.roll(leaving, 1), leaving, strict=True):
        turn = (last - first) % (2 * np.pi)
        count = max(int(np.ceil(turn / (2 * np.pi) * facets_per_turn)), 1) + 1
        angles = first + np.linspace(0, turn, count)
        pieces.append(vertex + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    return np.concatenate(pieces)


def _half_planes(outline: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    along = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, -(normals * outline).sum(axis=1)


@compiled(types.Tuple((INDEX, INDEX))(MATRIX, MATRIX, INDEX, MATRIX))
def _visible(corners, planes, sizes, boxes):
    """Pairs of corners whose segment passes inside no polygon by more than 1e-9 m.

    Args:
        corners: `[n, 2]`.
        planes: `[f, 3]`, rows (a, b) with a . x + b <= 0 inside, polygon after polygon.
        sizes: `[p + 1]`, where each polygon's rows begin.
        boxes: `[p, 4]`, lower and upper corner of each polygon's box.
    """
    n = corners.shape[0]
    room = 64 * n
    first, second = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64)
    count = 0
    for i in range(n):
        for j in range(i + 1, n):
            ax, ay, bx, by = corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1]
            free = True
            for p in range(boxes.shape[0]):
                if max(ax, bx) < boxes[p, 0] or min(ax, bx) > boxes[p, 2]:
                    continue
                if max(ay, by) < boxes[p, 1] or min(ay, by) > boxes[p, 3]:
                    continue
                enters, leaves = 0.0, 1.0
                for f in range(sizes[p], sizes[p + 1]):
                    at_a = planes[f, 0] * ax + planes[f, 1] * ay + planes[f, 2] + 1e-9
                    at_b = planes[f, 0] * bx + planes[f, 1] * by + planes[f, 2] + 1e-9
                    if at_a >= 0.0 and at_b >= 0.0:
                        enters = 2.0
                        break
                    if at_a > 0.0:
                        enters = max(enters, at_a / (at_a - at_b))
                    elif at_b > 0.0:
                        leaves = min(leaves, at_a / (at_a - at_b))
                if enters < leaves:
                    free = False
                    break
            if free:
                if count == room:
                    more = np.empty(2 * room, dtype=np.int64)
                    more[:room] = first
                    first = more
                    more = np.empty(2 * room, dtype=np.int64)
                    more[:room] = second
                    second = more
                    room *= 2
                first[count], second[count] = i, j
                count += 1
    return first[:count].copy(), second[:count].copy()
