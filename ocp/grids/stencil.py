"""Where short motions from a grid node lead: the stencil of the semi-Lagrangian scheme.

A foot is the end of a motion from a node under one constant input on the unit sphere of the R-norm,
long enough to reach `reach` cells along some axis. If that is more than one, motions of one cell
along each input are added: they tie together nodes that longer motions step over. Feet, and the
weights that interpolate a value there, depend only on the coordinates that the input matrix depends
on (the heading, for the unicycle): they are computed once for each node of that sub-grid, for any
query with the same robot, grid and R.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations, product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.compiled.batch import rates
from ocp.grid import Grid
from ocp.grids.input_samples import unit_directions
from ocp.query import Query

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MAX_ENTRIES = 20_000_000
SUBSTEPS = 2  # Runge-Kutta steps in a motion of a few cells
ON_NODE = 1e-7  # cells: a foot this close to a grid line is on it


@dataclass(frozen=True, eq=False)
class Stencil:
    """Feet of all motions; `g` runs over the sub-grid, `j` over `J` directions.

    A value array is surrounded by `ghost` layers along axes that are not periodic, so that offsets
    are plain differences of flat indices; wrapping round periodic axes is in the offsets.

    Attributes:
        reach: length of the longest motions, in cells.
        ghost: `[n]` layers of ghost nodes on each side.
        shape: `[n]`, of the sub-grid; 1 along axes that do not matter.
        index: `[g, n]`, of its nodes.
        directions: `[J, m]`, unit inputs a, with u = R^(-1/2) a.
        length: `[g, J]`, of the motions in the R-norm.
        node_offset, node_weight: `[g, J, C]`, flat offsets of the nodes around a foot; the weights
            are infinite (the foot's value is, too) where an input does not move the robot.
        corners: `[g, J, C, n]`, the same in cells, not wrapped.
        foot, middle: `[g, J, n]`, in cells, where motions end and are half-way.
        readers, reader_count: `[g, K]`, `[g]`: flat offsets of the nodes with a foot beside a node.
        pairs: `[P, 2]`, neighbouring directions.
        pair_geometry: `[g, P, 5]`, see `_pair_geometry`.
        faces: `[F, m]`, larger sets of neighbouring directions, filled up with -1.
        face_geometry: `[g, F, m, m]`, inverse Gram matrices of their motions, filled up with 0.
    """

    reach: int
    ghost: Ints
    shape: Ints
    index: Ints
    directions: Floats
    length: Floats
    node_offset: Ints
    node_weight: Floats
    corners: Ints
    foot: Floats
    middle: Floats
    readers: Ints
    reader_count: Ints
    pairs: Ints
    pair_geometry: Floats
    faces: Ints
    face_geometry: Floats


def stencil(query: Query, grid: Grid, directions: int, reach: int) -> Stencil:
    """The stencil for a time-free query on a grid.

    Args:
        query: its robot and R count.
        grid: over the robot's states.
        directions: number of directions, if the robot has two inputs.
        reach: length of the motions, in cells.

    Raises:
        ValueError: if the input matrix depends on so many coordinates that the tables get too big.
    """
    weights = tuple(map(float, query.input_weights))
    key = Query(query.system, query.goal, cost=type(query.cost)(input=weights))
    return _stencil(_Key(key, weights), grid, directions, reach)


class _Key:
    """A query reduced to robot and input weights, so that a family shares its stencils."""

    def __init__(self, query: Query, weights: tuple[float, ...]) -> None:
        self.query, self.identity = query, (query.system, weights)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.identity == other.identity

    def __hash__(self) -> int:
        return hash(self.identity)


@lru_cache(maxsize=8)
def _stencil(key: _Key, grid: Grid, directions: int, reach: int) -> Stencil:
    query = key.query
    system = query.system
    n, periodic = system.n, np.array(grid.periodic)
    depends = coordinates_in(system.input_matrix, system.state) | periodic
    units = unit_directions(system.m, directions)
    reaches = np.full(len(units), float(reach))
    if reach > 1:
        units = np.concatenate([units, np.eye(system.m), -np.eye(system.m)])
        reaches = np.append(reaches, np.ones(2 * system.m))
    J = len(units)
    shape = np.where(depends, grid.shape, 1)
    if shape.prod() * J * 2**n > MAX_ENTRIES:
        raise ValueError(
            f"grid.shape: the input matrix of {system.name} depends on so many coordinates that "
            f"{grid.shape} needs too big a stencil; use fewer nodes or value iteration"
        )
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, n)
    center = (np.array(grid.lower) + grid.upper) / 2
    base = np.where(depends, np.array(grid.lower) + index * grid.spacing, center)
    starts = np.repeat(base, J, axis=0)
    inputs = np.tile(units / np.sqrt(query.input_weights), (len(base), 1))
    length, cells, middle = _motions(query, grid, starts, inputs, np.tile(reaches, len(base)))

    stuck = np.isinf(cells).sum(axis=1) > 0
    cells = np.where(stuck[:, None], 0.0, cells).reshape(-1, J, n)
    corners, node_weight = _around(cells)
    node_weight[stuck.reshape(-1, J)] = np.inf
    ghost = np.where(periodic, 0, reach)
    there = _wrapped(index, corners, grid.shape, periodic)
    node_offset = (there - index[:, None, None]) @ flat_strides(np.array(grid.shape) + 2 * ghost)
    target = np.where(depends, there, 0)
    outside = np.any((target < 0) | (target >= shape), axis=-1)
    inside = np.logical_not(outside)
    target = (target @ flat_strides(shape))[inside]
    readers, _, reader_count = _packed(target, -node_offset[inside], np.ones(inside.sum()))
    motions = units * length.reshape(-1, J, 1)
    pairs, *larger = simplices(system.m, directions) or [np.zeros((0, 2), dtype=np.int64)]
    faces, face_geometry = _faces(motions, larger, system.m)
    return Stencil(
        reach, ghost, shape, index, units, length.reshape(-1, J), node_offset, node_weight, corners,
        cells, middle.reshape(-1, J, n), readers, reader_count,
        pairs, _pair_geometry(motions, pairs), faces, face_geometry,
    )  # fmt: skip


@lru_cache(maxsize=8)
def cost_stencil(
    feet: Stencil, grid: Grid, depends: tuple[bool, ...], finer: int
) -> tuple[Ints, Floats, Floats]:
    """Simpson's rule along each motion, for a cost on a grid of its own.

    That grid has the axes in `depends` alone, `finer` of its cells to one of `grid`, and as many
    ghost layers in length.

    Returns:
        `[g, J, E]` flat offsets from a node of `grid`, `[g, J, E]` weights, and `[g, J]` the weight
        of the node itself.
    """
    periodic = np.array(grid.periodic)
    cells = finer * (np.array(grid.shape) - 1 + periodic)
    shape = np.where(depends, cells + 1 - periodic + 2 * finer * feet.ghost, 1)
    fine = np.where(depends, finer, 0)
    (foot, foot_weight), (middle, middle_weight) = (
        _around(feet.foot * fine),
        _around(feet.middle * fine),
    )
    corners = np.concatenate([foot, middle], axis=2)
    weight = np.concatenate([foot_weight / 6, middle_weight * 4 / 6], axis=2)
    here = feet.index * fine
    there = _wrapped(here, corners, shape, periodic)
    offset = (there - here[:, None, None]) @ (flat_strides(shape) * depends)
    count = weight.shape[0] * weight.shape[1]
    rows = np.repeat(np.arange(count), weight.shape[2])
    merged, weights, _ = _packed(rows, offset.ravel(), weight.ravel())
    own = np.where(merged == 0, weights, 0.0).sum(axis=1)
    weights = np.where(merged == 0, 0.0, weights)
    packed = (*weight.shape[:2], -1)
    return merged.reshape(packed), weights.reshape(packed), (own + 1 / 6).reshape(packed[:2])


def coordinates_in(expression: ca.SX, state: ca.SX) -> NDArray[np.bool_]:
    """`[n]`: which coordinates of `state` an expression depends on."""
    sparsity = ca.jacobian(expression, state).sparsity()
    pattern = np.array(ca.DM(sparsity, 1)).reshape(-1, state.numel())
    return np.asarray((pattern != 0).sum(axis=0) > 0)


def simplices(m: int, count: int) -> list[Ints]:
    """Which directions of `unit_directions(m, count)` are neighbours.

    Returns:
        for k = 2, ..., m the index sets `[K, k]` of the faces of a triangulated sphere.
    """
    if m == 1:
        return []
    if m == 2:
        first = np.arange(count)
        return [np.column_stack([first, (first + 1) % count])]
    lattice = [c for c in product((-1, 0, 1), repeat=m) if any(c)]
    number: dict[tuple[int, ...], int] = {c: i for i, c in enumerate(lattice)}
    faces: list[set[tuple[int, ...]]] = [set() for _ in range(m + 1)]
    for order in permutations(range(m)):
        for signs in product((-1, 1), repeat=m):
            # From a facet's centre over an edge's to a corner of the cube: a chain of neighbours.
            chain, corner = [], [0] * m
            for axis in order:
                corner[axis] = signs[axis]
                chain.append(number[tuple(corner)])
            for k in range(2, m + 1):
                faces[k].update(tuple(sorted(face)) for face in combinations(chain, k))
    return [np.array(sorted(faces[k])) for k in range(2, m + 1)]


def _motions(
    query: Query, grid: Grid, starts: Floats, inputs: Floats, reach: Floats
) -> tuple[Floats, Floats, Floats]:
    """Lengths `[r]` of the motions, and where they end and are half-way, `[r, n]` in cells."""
    pace = (abs(rates(query, starts, inputs)) / grid.spacing).max(axis=1)
    moves = pace > 1e-9 * pace.max()
    length = reach / np.where(moves, pace, 1.0)
    # Scaled so that a curved motion, too, ends on a face of the box of cells.
    for _ in range(20):
        cells = (_flow(query, starts, inputs, length) - starts) / grid.spacing
        excess = abs(cells).max(axis=1) / reach
        if abs(excess - 1)[moves].max() < 1e-10:
            break
        length = np.where(moves & (excess > 0.5), length / np.maximum(excess, 0.5), length)
    cells = (_flow(query, starts, inputs, length) - starts) / grid.spacing
    middle = (_flow(query, starts, inputs, length / 2) - starts) / grid.spacing
    still = ~moves[:, None]
    length = np.where(moves, length, 1.0)
    return length, np.where(still, np.inf, cells), np.where(still, 0.0, middle)


def _flow(query: Query, states: Floats, inputs: Floats, lengths: Floats) -> Floats:
    """Ends of motions under constant inputs, by the classical Runge-Kutta method."""
    h = lengths[:, None] / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = rates(query, states, inputs)
        k2 = rates(query, states + h / 2 * k1, inputs)
        k3 = rates(query, states + h / 2 * k2, inputs)
        k4 = rates(query, states + h * k3, inputs)
        states = states + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return states


def _around(cells: Floats) -> tuple[Ints, Floats]:
    """Nodes around points given in cells `[..., n]`: offsets `[..., C, n]` and weights `[..., C]`.

    Nodes of weight 0 are left out; where fewer than C remain, the first is repeated with weight 0.
    """
    shape, n = cells.shape[:-1], cells.shape[-1]
    cells = cells.reshape(-1, n)
    nearest = np.round(cells)
    cells = np.where(abs(cells - nearest) < ON_NODE, nearest, cells)
    low = np.floor(cells)
    fraction = (cells - low)[:, None, :]
    sides = np.array(list(product((0, 1), repeat=n)))
    weight = np.where(sides, fraction, 1.0 - fraction).prod(axis=2)
    order = np.argsort(weight <= 0.0, axis=1, kind="stable")[:, : (weight > 0.0).sum(axis=1).max()]
    weight = np.take_along_axis(weight, order, axis=1)
    corners = low[:, None, :].astype(np.int64) + sides[order]
    corners = np.where(weight[..., None] > 0.0, corners, corners[:, :1])
    return corners.reshape(*shape, -1, n), weight.reshape(*shape, -1)


def flat_strides(shape: Ints) -> Ints:
    """Steps in the flat (row-major) index of an array of this shape."""
    return np.append(np.cumprod(shape[:0:-1])[::-1], 1).astype(np.int64)


def _wrapped(
    index: Ints, corners: Ints, shape: Ints | tuple[int, ...], periodic: NDArray[np.bool_]
) -> Ints:
    """Indices `[g, J, C, n]` of corners, wrapped round the periodic axes."""
    there = index[:, None, None, :] + corners
    return np.where(periodic, there % shape, there)


def _packed(rows: Ints, keys: Ints, weights: Floats) -> tuple[Ints, Floats, Ints]:
    """Equal (row, key) merged and packed to the left: keys `[r, K]`, weights `[r, K]`, counts."""
    pairs, where = np.unique(np.column_stack([rows, keys]), axis=0, return_inverse=True)
    total = np.bincount(where.ravel(), weights)
    count = np.bincount(pairs[:, 0])
    slot = np.arange(len(pairs)) - np.repeat(np.cumsum(count) - count, count)
    packed = np.zeros((len(count), count.max()), dtype=np.int64)
    summed = np.zeros(packed.shape)
    packed[pairs[:, 0], slot] = pairs[:, 1]
    summed[pairs[:, 0], slot] = total
    return packed, summed, count.astype(np.int64)


def _pair_geometry(motions: Floats, pairs: Ints) -> Floats:
    """What the minimum over a pair of motions v, w `[g, P, m]` needs, `[g, P, 5]`.

    With e = w - v, minimise c |v + t e| + t D over t in [0, 1], D the difference of the values at
    the feet. The slope is negative at 0 if D < -c v.e / |v|, positive at 1 if D > -c w.e / |w|.
    In between the minimum is c |e| q sqrt(1 - r^2) - p D, with r = -D / (c |e|), p = v.e / |e|^2
    and q^2 = |v|^2 / |e|^2 - p^2.

    Returns:
        v.e / |v|, w.e / |w|, |e|, |e| q, p.
    """
    v, w = motions[:, pairs[:, 0]], motions[:, pairs[:, 1]]
    e = w - v
    size = np.linalg.norm(e, axis=2)
    p = (v * e).sum(axis=2) / size**2
    distance = np.sqrt(np.maximum((v**2).sum(axis=2) - (p * size) ** 2, 0.0))
    slopes = [(x * e).sum(axis=2) / np.linalg.norm(x, axis=2) for x in (v, w)]
    return np.ascontiguousarray(np.stack([*slopes, size, distance, p], axis=2))


def _faces(motions: Floats, larger: list[Ints], m: int) -> tuple[Ints, Floats]:
    """Sets of three and more directions, and the inverse Gram matrices of their motions."""
    count = sum(len(sets) for sets in larger)
    faces = np.full((count, m), -1, dtype=np.int64)
    geometry = np.zeros((len(motions), count, m, m))
    row = 0
    for sets in larger:
        k = sets.shape[1]
        rows = slice(row, row + len(sets))
        faces[rows, :k] = sets
        v = motions[:, sets]
        geometry[:, rows, :k, :k] = np.linalg.inv(v @ np.swapaxes(v, -1, -2))
        row += len(sets)
    return faces, geometry
