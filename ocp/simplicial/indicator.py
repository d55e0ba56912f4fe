"""Where to refine: how much each simplex adds to the error of the values that matter.

Two factors, as in the dual-weighted residual method (Becker and Rannacher 2001). The error that V's
linear interpolation makes in a simplex is measured along its edges: the slope of V along the edge
changes from one end to the other, and the value between is off by an eighth of the change times the
length. And it counts as often as motions read it: mass placed where values matter is moved along
the best motions of all vertices down to the goal, and what comes by a simplex is its weight. Near a
kink between two ways round an obstacle the first is large, but motions leave the kink and none
passes, so that it is refined no more than it deserves.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.simplicial import march as kernels
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.solution import MeshSolution

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

I2 = types.Array(types.int64, 2, "C")
PASSES = 8
STARTS_SHARE = 0.5
"""Of the mass, at the states that matter if there are any; the rest is spread over the box, so that
the whole feedback policy keeps improving."""


def error_indicator(solution: MeshSolution, starts: Floats | None = None) -> Floats:
    """`[M]`, each leaf's share of the expected error; 0 where V is not known.

    Args:
        solution: with its values.
        starts: `[k, n]`, states that matter; the whole box if there are none.
    """
    mesh, values = solution.mesh, solution.values
    mass = _mass(solution, starts)
    between = _curvature(mesh, values)
    # What the table takes off the scheme's error, it does not take off the interpolated value.
    passed_on = between
    if solution.table is not None:
        passed_on = _curvature(mesh, values - solution.table.value(mesh.vertices))
    return passed_on * _traffic(solution, mass)[mesh.cells].sum(axis=1) + between * mass[
        mesh.cells
    ].sum(axis=1)


def _curvature(mesh: Mesh, values: Floats) -> Floats:
    """`[M]`, the largest error of linear interpolation along the edges of each leaf."""
    out = np.empty(mesh.size)
    _curvatures(mesh.cells, mesh.edge_vectors, values, _gradients(mesh, values), out)
    return out


def _gradients(mesh: Mesh, values: Floats) -> Floats:
    """`[N, n]`, the mean of the gradients on the leaves around each vertex, by volume."""
    corners = values[mesh.cells]
    known = np.all(np.isfinite(corners), axis=1)
    corners = np.where(known[:, None], corners, 0.0)
    slopes = np.linalg.solve(mesh.edge_vectors, (corners[:, 1:] - corners[:, :1])[..., None])[
        ..., 0
    ]
    weight = mesh.volumes * known
    total, sums = np.zeros(len(values)), np.zeros((len(values), mesh.dimension))
    for k in range(mesh.dimension + 1):
        total += np.bincount(mesh.cells[:, k], weight, len(values))
        for i in range(mesh.dimension):
            sums[:, i] += np.bincount(mesh.cells[:, k], weight * slopes[:, i], len(values))
    return sums / np.where(total > 0, total, 1.0)[:, None]


@compiled(types.void(I2, types.Array(float64, 3, "C"), VECTOR, MATRIX, VECTOR))
def _curvatures(cells, edges, values, gradients, out):
    n = gradients.shape[1]
    for row in range(cells.shape[0]):
        largest = 0.0
        for i in range(n + 1):
            if not values[cells[row, i]] < np.inf:
                largest = 0.0
                break
            for j in range(i):
                change = 0.0
                for k in range(n):
                    step = edges[row, i - 1, k]
                    if j > 0:
                        step -= edges[row, j - 1, k]
                    change += step * (gradients[cells[row, i], k] - gradients[cells[row, j], k])
                largest = max(largest, abs(change) / 8.0)
        out[row] = largest


def _mass(solution: MeshSolution, starts: Floats | None) -> Floats:
    """`[N]`, a unit mass where values matter: at the starts, and over the box by volume."""
    mesh = solution.mesh
    mass = np.zeros(len(solution.values))
    for k in range(mesh.dimension + 1):
        mass += np.bincount(mesh.cells[:, k], mesh.volumes, len(mass))
    mass /= mass.sum()
    if starts is not None and len(starts):
        vertices, weights = mesh.locate(starts)
        inside = vertices[:, 0] >= 0
        mass *= 1.0 - STARTS_SHARE
        share = STARTS_SHARE / len(starts) * weights[inside]
        np.add.at(mass, vertices[inside].ravel(), share.ravel())
    return mass


def _traffic(solution: MeshSolution, mass: Floats) -> Floats:
    """`[N]`, how much of the mass comes by each vertex on its way to the goal."""
    total = np.zeros(len(mass))
    order = np.argsort(-solution.values, kind="stable")
    kernels.spread(solution.values, *solution.scheme(), order, mass.copy(), PASSES, total)
    return total


def marked_leaves(indicator: Floats, share: float) -> Ints:
    """The leaves of the largest indicators, together `share` of the sum (Doerfler 1996)."""
    order = np.argsort(-indicator, kind="stable")
    held = np.cumsum(indicator[order])
    return order[: int(np.searchsorted(held, share * held[-1])) + 1]
