"""A certified bracket of the optimal cost: no motion costs less than `lower`.

A Lipschitz function w with w <= 0 in the goal and L + grad w . f >= 0 for all inputs, almost
everywhere, is nowhere above V (integrate along any motion). Where time is free the condition is

    |R^(-1/2) G' grad w| <= 2 sqrt(W).

Such a w is made from the eikonal value v: solved on a grid, averaged with cubic B-splines (an
average of functions that satisfy the condition nearly does, kinks of V included) onto a finer grid,
multilinear there. In every cell the ratio of the two sides is bounded (`subsolution_kernels`), with
W bounded from below by interval arithmetic. Where the ratio exceeds 1 the value is solved anew for
a running cost that is smaller there; some rounds suffice. What violation is left is removed by
w = phi(v), phi' = 1 / the largest ratio on the level set.

Near the goal, where V is not smooth, a bound U that knows the goal only is better (`goal_bound`).
The maximum of subsolutions is one: max(U, phi(v)) where v is above a first level, and U where it is
not; phi begins with the least U on that level set, so that the two meet.

A motion may leave the grid's box, where w says nothing. It then costs at least the way to the edge
at the least W outside the goal's surroundings, plus R there: the bound is never above that.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import state_costs
from ocp.grid import Grid, GridValue
from ocp.grids import subsolution_kernels as kernels
from ocp.grids.fast_marching import marched
from ocp.grids.goal_bound import GoalBound, RadialGoalBound, goal_ball, goal_bound, goal_costs
from ocp.interval import bounds
from ocp.query import Query
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]

NODES = 240_000
FACTOR = 3  # finer grid in which w is multilinear
MARGIN = 1.5  # metres around the robot's domain
FREE_ROUNDS, LAST_ROUNDS = 4, 5  # the cost's factor may grow again in the first ones only
REACH = 1  # nodes beside a violation whose factor falls too, in the last rounds: alone, it persists
CAUTION = 1.3  # exponent of a round's correction in the last ones
LEVEL = 0.02  # of cost: width of phi's pieces
CUTS = (0.15, 0.3, 0.5, 0.8, 1.2)  # of cost: first levels that are tried
USUAL_CUT = 0.8  # during the rounds
SLACK = 1e-9  # relative: covers rounding in the bounds
RIM_SLACK = 0.02  # of cost: R at the rim of the surroundings is at most so much above the bound's
SURROUNDINGS = 0.8  # metres around the goal whose W does not count in the way to the edge


@dataclass(frozen=True)
class Bracket:
    """lower <= V <= upper.

    Attributes:
        lower: certified.
        upper: cost of a motion that reaches the goal.
    """

    lower: float
    upper: float

    @property
    def gap(self) -> float:
        """(upper - lower) / lower; infinite if lower is 0."""
        return (self.upper - self.lower) / self.lower if self.lower > 0 else np.inf


@dataclass(frozen=True, eq=False)
class LowerBound:
    """A function nowhere above V.

    Attributes:
        query: of which V.
        potential: the multilinear function before `levels`.
        levels: `[k]`, phi at multiples of `LEVEL`; only what is above `cut` counts.
        worst: largest ratio that phi had to make up for.
        cut: the first level.
        near: U.
    """

    query: Query
    potential: GridValue
    levels: Array
    worst: float
    cut: float
    near: GoalBound

    def value(self, states: ArrayLike) -> Array:
        """The bound `[...]` at states `[..., n]`; in the goal 0.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        states = np.asarray(states, dtype=float)
        inside = self.potential.value(states)
        known = np.where(np.isfinite(inside), inside, 0.0)
        marks = LEVEL * np.arange(len(self.levels))
        w = np.where(known > self.cut, np.interp(known, marks, self.levels), 0.0)
        near = np.maximum(self._radial(self.query.goal_distance(states)), 0.0)
        if np.isfinite(inside).any():  # U is known in the box only
            near = np.where(np.isfinite(inside), np.maximum(near, self.near.value(states)), near)
        bound = np.maximum(near, np.minimum(w, self._leaving(self.query.position(states))))
        return np.where(self.query.goal_distance(states) <= 0, 0.0, bound * (1 - SLACK))

    def bracket(self, start: ArrayLike, upper: float) -> Bracket:
        """The bracket of V at a state `[n]`; `upper` is the cost of a motion from there."""
        return Bracket(float(self.value(start)), float(upper))

    def _radial(self, distance: Array) -> Array:
        return _radial(self.query).at(np.maximum(distance, 0.0))

    def _leaving(self, positions: Array) -> Array:
        """Least cost of a motion that leaves the box: to its edge, and on to the goal.

        It keeps out of the goal's surroundings, and pays at least their rim's W on the way to the
        edge; or it goes through them, in and out again.
        """
        edges, onward, spare = self._edges
        query = self.query
        flat = positions.reshape(-1, 2)
        gaps = np.linalg.norm(flat[:, None] - edges, axis=-1) - spare
        rim = goal_ball(query).radius + SURROUNDINGS
        rate = 2.0 / _largest_speed(query) * float(np.sqrt(goal_costs(query, np.array([rim])))[0])
        direct = rate * np.maximum(gaps, 0.0)
        within = float(self._radial(np.array([SURROUNDINGS]))[0]) + RIM_SLACK
        here = self._radial(
            np.linalg.norm(flat - goal_ball(query).center, axis=1) - goal_ball(query).radius
        )
        through = np.maximum(here - within, 0.0)[:, None] + np.maximum(onward - within, 0.0)
        least = (np.minimum(direct, through) + onward).min(axis=1)
        return least.reshape(positions.shape[:-1])

    @cached_property
    def _edges(self) -> tuple[Array, Array, float]:
        """Points `[e, 2]` of the box's edge, R from anywhere near each, and how near that is."""
        grid, count = self.potential.grid, 200
        x, y = (np.linspace(grid.lower[i], grid.upper[i], count) for i in range(2))
        sides = [np.column_stack([x, np.full(count, end)]) for end in (y[0], y[-1])]
        sides += [np.column_stack([np.full(count, end), y]) for end in (x[0], x[-1])]
        edges = np.concatenate(sides)
        spare = max(x[1] - x[0], y[1] - y[0]) / 2
        away = (
            np.linalg.norm(edges - goal_ball(self.query).center, axis=1)
            - goal_ball(self.query).radius
        )
        return edges, self._radial(away - spare), spare


def lower_bound(query: Query, nodes: int = NODES, factor: int = FACTOR) -> LowerBound:
    """A certified lower bound of V.

    Args:
        query: time-free, a robot of three states in the plane whose input matrix depends on the
            last one only, a cost without `state` and `own` terms. Hard obstacles count as soft.
        nodes: of the grid that is solved; more bring the bound nearer to V.
        factor: how many times finer the grid is on which the condition is checked.

    Raises:
        SolveError: NOT_APPLICABLE if the query is of another kind.
        ValueError: if `nodes` or `factor` does not fit.
    """
    _check(query)
    if factor < 1:
        raise ValueError(f"factor: must be at least 1, got {factor}")
    soft = replace(query, obstacles=tuple(replace(o, hard=False) for o in query.obstacles))
    grid = Grid.for_query(soft, nodes, MARGIN)
    work = _Correction(soft, grid, factor)
    scale = np.ones(grid.shape)
    best: LowerBound | None = None
    for k in range(FREE_ROUNDS + LAST_ROUNDS):
        work.solve(scale)
        if k >= FREE_ROUNDS + LAST_ROUNDS - 2:
            found = work.certified()
            if best is None or found.levels[-1] > best.levels[-1]:
                best = found
        scale = work.corrected(scale, growing=k < FREE_ROUNDS)
    assert best is not None
    return best


class _Correction:
    """The value for a corrected cost, on the finer grid, and how far it is from a subsolution."""

    def __init__(self, query: Query, grid: Grid, factor: int) -> None:
        self.query, self.grid, self.factor = query, grid, factor
        last = grid.periodic[2]
        shape = tuple(
            count * factor if periodic else (count - 1) * factor + 1
            for count, periodic in zip(grid.shape, grid.periodic, strict=True)
        )
        self.fine = Grid(grid.lower, grid.upper, shape, grid.periodic)
        self.splines = [
            _spline_matrix(count, factor, periodic)
            for count, periodic in zip(grid.shape, grid.periodic, strict=True)
        ]
        x, y = self.fine.axes[:2]
        boxes = [(x[:-1, None], x[1:, None]), (y[None, :-1], y[None, 1:])]
        zero = np.zeros((1, 1))
        state = query.system.state
        cost = ca.Function("W", [state], [ca.densify(query.state_cost_expression(state))])
        low = bounds(cost, [*boxes, (zero, zero)])[0][0]
        cells = (len(x) - 1, len(y) - 1)
        self.cost = np.broadcast_to(np.maximum(low, 0.0), cells) * (1 - SLACK)
        slope = ca.densify(ca.gradient(query.state_cost_expression(state), state)[:2])
        # Where a function's slope lies in [a, b], a chord is at most h (b - a) / 4 above it.
        ranges = bounds(ca.Function("slope", [state], [slope]), [*boxes, (zero, zero)])
        sag = sum(
            h * (high - low) / 4 for h, (low, high) in zip(self.fine.spacing, ranges, strict=False)
        )
        sag = np.where(np.isfinite(sag), sag, np.inf)
        self.sag = np.ascontiguousarray(np.broadcast_to(sag, cells)) * (1 + SLACK)
        nodes = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1)
        self.corner = np.ascontiguousarray(state_costs(query, nodes)[..., 0]) * (1 - SLACK)
        headings = np.append(self.fine.axes[2], self.fine.upper[2]) if last else self.fine.axes[2]
        self.inputs, self.bend = _input_matrices(query, headings)
        corners = np.array([grid.lower[:2], grid.upper[:2]]) - goal_ball(query).center
        reach = float(np.hypot(*abs(corners).max(axis=0)))
        self.near = goal_bound(query, _largest_speed(query), reach)
        self.floor = self.near.floors(x, y, np.ascontiguousarray(headings))

    def solve(self, scale: Array) -> None:
        values = marched(self.query, self.grid, scale=scale).values
        if not np.isfinite(values).all():
            raise SolveError(Status.NOT_CONVERGED, "a node of the soft query was not reached")
        a, b, c = self.splines
        smooth = np.einsum("ix,xyz->iyz", a, values, optimize=True)
        smooth = np.einsum("jy,iyz->ijz", b, smooth, optimize=True)
        smooth = np.einsum("kz,ijz->ijk", c, smooth, optimize=True)
        self.values = np.ascontiguousarray(smooth)
        closed = self.values
        if self.fine.periodic[2]:
            closed = np.concatenate([closed, closed[:, :, :1]], axis=2)
        self.closed = np.ascontiguousarray(closed)
        shape = tuple(count - 1 for count in closed.shape)
        self.ratio, self.low, self.high = (np.empty(shape) for _ in range(3))
        kernels.cell_ratios(
            self.closed, self.fine.spacing, self.inputs, self.bend, self.corner,
            self.sag, self.cost, self.ratio, self.low, self.high,
        )  # fmt: skip

    def _active(self, first: float, least: float) -> Array:
        """1 where phi(v), `least` at v = `first`, may be above U, which takes over elsewhere."""
        above = least + (self.high - first) > self.floor
        return (above & (self.high > first)).astype(float)

    def _least(self, first: float) -> float:
        """Where phi begins: at most U on the level set of v, and at most v.

        The least over whole cells is some 0.2 too low. That is no loss: around the goal, where a
        grid resolves v worst, phi(v) is then below U and need not be a subsolution.
        """
        met = (self.low <= first) & (self.high >= first)
        return float(self.floor[met].min(initial=first))

    def corrected(self, scale: Array, growing: bool) -> Array:
        """A factor of the cost for the next round: less where the ratio exceeds 1."""
        found = np.full(scale.shape, 0.5 if growing else 1.0)
        active = self._active(USUAL_CUT, self._least(USUAL_CUT))
        kernels.node_ratios(self.ratio, active, self.factor, 0 if growing else REACH, found)
        change = np.clip(found, 0.95, 1.3) ** (-1.0 if growing else -CAUTION)
        return np.clip(scale * change, 0.5, 1.0)

    def certified(self) -> LowerBound:
        """phi for the best of the first levels."""
        best: LowerBound | None = None
        count = int(float(self.high.max()) / LEVEL) + 2
        for cut in CUTS:
            begin = min(int(np.ceil(cut / LEVEL)), count - 1)
            first = LEVEL * begin
            least = self._least(first)
            ratios = np.ones(count)
            active = self._active(first, least)
            kernels.level_ratios(self.ratio, self.low, self.high, active, LEVEL, ratios)
            slopes = 1.0 / (ratios * (1 + SLACK))
            rises = LEVEL * slopes[begin:]
            levels = np.concatenate([np.zeros(begin), least + np.cumsum([0.0, *rises])])
            if best is None or levels[-1] > best.levels[-1]:
                worst = float(ratios[begin:].max())
                value = GridValue(self.fine, self.values)
                best = LowerBound(self.query, value, levels, worst, first, self.near)
        assert best is not None
        return best


@lru_cache(maxsize=16)
def _radial(query: Query) -> RadialGoalBound:
    return RadialGoalBound(query, _largest_speed(query))


def _check(query: Query) -> None:
    goal_ball(query)
    system = query.system
    plain = query.cost.state is None and not query.cost.own
    if not query.is_time_free or system.n != 3 or tuple(system.position) != (0, 1) or not plain:
        raise SolveError(
            Status.NOT_APPLICABLE,
            "certified lower bounds are for time-free queries of robots with three states, two of "
            "them the position, without quadratic or own cost",
        )
    matrix = ca.vec(ca.densify(system.input_matrix))
    if ca.jacobian(matrix, system.state[:2]).nnz():
        raise SolveError(
            Status.NOT_APPLICABLE, "the input matrix must depend on the last coordinate only"
        )


def _input_matrices(query: Query, headings: Array) -> tuple[Array, Array]:
    """Columns of G R^(-1/2) `[k, m, 3]` at last coordinates `[k]`, and bounds `[m, 3]` of how far
    they are from linear between two of them."""
    system = query.system
    scaled = ca.densify(system.input_matrix) @ ca.diag(1 / ca.DM(np.sqrt(query.input_weights)))
    function = ca.Function("G", [system.state], [ca.densify(scaled)])
    rows = [np.array(function([0.0, 0.0, b])).T for b in headings]
    heading = system.state[2]
    flat = ca.vec(ca.densify(scaled))
    second = ca.densify(ca.jacobian(ca.jacobian(flat, heading), heading))
    curvature = ca.Function("curvature", [system.state], [second])
    zero, ends = np.zeros(1), (headings[:1], headings[-1:])
    found = bounds(curvature, [(zero, zero), (zero, zero), ends])
    largest = np.array([max(abs(float(a.min())), abs(float(b.max()))) for a, b in found])
    step = float(np.diff(headings).max())
    bend = step**2 / 8 * largest.reshape(system.m, 3)  # vec stacks the columns of G
    return np.ascontiguousarray(rows), np.ascontiguousarray(bend)


@lru_cache(maxsize=16)
def _largest_speed(query: Query) -> float:
    """c: no input of unit effort moves the position faster."""
    system = query.system
    c = system.coordinates[2]
    headings = np.linspace(c.lower, c.upper, 2001)
    inputs, bend = _input_matrices(query, headings)
    norms = np.linalg.norm(inputs[:, :, :2], ord=2, axis=(1, 2))
    return float(norms.max() + np.linalg.norm(bend[:, :2])) * (1 + SLACK)


def _spline_matrix(count: int, factor: int, periodic: bool) -> Array:
    """Uniform cubic B-spline weights `[fine, count]`; an end is mirrored."""
    places = np.arange(count * factor if periodic else (count - 1) * factor + 1) / factor
    cell = np.floor(places).astype(int)
    t = places - cell
    weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    matrix = np.zeros((len(places), count))
    for k, weight in enumerate(weights):
        node = cell + k - 1
        node = node % count if periodic else _mirrored(node, count)
        np.add.at(matrix, (np.arange(len(places)), node), weight / 6)
    return matrix


def _mirrored(node: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    node = np.abs(node)
    return np.where(node > count - 1, 2 * (count - 1) - node, node)
