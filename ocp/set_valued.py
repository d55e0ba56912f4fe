"""The set-valued method of Xu and Zhu (RSS 2022, section III-A1), eq. (7), on a state grid.

v(x) = min_u { eps L(x, u) + v(x') : x' in (x + eps f(x, u) + alpha B) and on the grid }

Read literally, every node within alpha of x + eps f is an image, so that alpha is free motion; at
practical alpha the value is then far too low. The readings are named in `Image`, and every figure
states which one it uses. A second choice is which nodes stand still at no cost, see `Frozen`.

On the grid this is a shortest-path problem with positive lengths eps (W(x) + u' R u). Moves are
translation invariant and an offset's effort u' R u does not depend on the query, so one table of
moves serves all nodes; label setting (Dijkstra) from the goal solves it in one pass.
"""

from dataclasses import dataclass, field
from enum import Enum
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import rates, state_costs
from ocp.grid import Grid, GridValue
from ocp.grids.hard_obstacles import hard_data
from ocp.grids.lookahead import LookaheadPolicy
from ocp.grids.shortest_path import MoveGraph
from ocp.query import Query
from ocp.trajectory import SolveError, Status

COARSE = (58, 58, 35)
"""About the paper's 118,000 states: spacings .175 m and .18 rad."""
FINE = (116, 116, 71)
"""About the paper's 955,000 states: spacings .087 m and .088 rad."""


class Image(Enum):
    """Which nodes count as x + eps f(x, u)."""

    BALL = "every node within alpha, eq. (7) to the letter"
    LATERAL = "nodes within alpha measured across the directions in which the robot can move"
    NEAREST = "the nearest node"


class Frozen(Enum):
    """Which nodes the discretised system leaves where they are, at no further cost."""

    GOAL = "the nodes of the goal ball"
    BAND = "the nodes within M eps + h of the goal, as printed"


class Method(Enum):
    """How the fixed point of eq. (7) is found; all three find the same one."""

    LABEL_SETTING = "Dijkstra's algorithm from the goal"
    GAUSS_SEIDEL = "value iteration in place, sweeping in alternating orders"
    JACOBI = "value iteration as printed"


@dataclass(frozen=True)
class SetValuedSettings:
    """Parameters of the discretisation.

    Attributes:
        step: eps, seconds; must exceed 2 h.
        radius: alpha; `None` means half the diagonal of a cell for BALL, half a spacing for
            LATERAL. Not used by NEAREST.
        image: the reading of alpha.
        frozen: the reading of the terminal set.
        limit: inputs are sampled from [-limit, limit]^m (the compact set of eq. (7)).
        samples: inputs on each axis.
    """

    step: float = 0.4
    radius: float | None = None
    image: Image = Image.NEAREST
    frozen: Frozen = Frozen.GOAL
    limit: float = 1.0
    samples: int = 11

    def __post_init__(self) -> None:
        for name in ("step", "limit"):
            number = getattr(self, name)
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name}: must be a positive finite number, got {number}")
        if self.radius is not None and not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(f"radius: must be a positive finite number, got {self.radius}")
        if self.samples < 2:
            raise ValueError(f"samples: needs at least 2 an axis, got {self.samples}")


@dataclass(frozen=True, eq=False)
class SetValuedSolution:
    """The data set of eq. (8): optimal values and controls on the grid.

    Attributes:
        query, settings: what was solved.
        value: V at the nodes; infinite where the goal cannot be reached.
        inputs: `[*grid.shape, m]`, the minimising control at each node; 0 on frozen nodes and where
            V is infinite.
        sweeps: of value iteration; 1 for label setting.
    """

    query: Query
    settings: SetValuedSettings
    value: GridValue
    inputs: NDArray[np.float64] = field(repr=False)
    sweeps: int

    def policy(self) -> LookaheadPolicy:
        """Feedback by interpolated one-step lookahead on the values."""
        return LookaheadPolicy(self.query, self.value)

    def nearest_node_policy(self) -> "NearestNodePolicy":
        """The paper's feedback: the control stored at the nearest node."""
        return NearestNodePolicy(self.query, self.value.grid, self.inputs)


@dataclass(frozen=True, eq=False)
class NearestNodePolicy:
    """u(x) = the control stored at the node nearest to x. From some states it cycles for ever."""

    query: Query
    grid: Grid
    inputs: NDArray[np.float64]

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        """Inputs `[..., m]` at states `[..., n]`."""
        grid = self.grid
        offset = (np.asarray(states, dtype=float) - np.array(grid.lower)) / grid.spacing
        index = np.rint(offset).astype(np.int64)
        for axis, (count, periodic) in enumerate(zip(grid.shape, grid.periodic, strict=True)):
            column = index[..., axis]
            index[..., axis] = column % count if periodic else np.clip(column, 0, count - 1)
        return self.inputs[tuple(np.moveaxis(index, -1, 0))]


def solve_set_valued(
    query: Query,
    grid: Grid | None = None,
    settings: SetValuedSettings | None = None,
    method: Method = Method.LABEL_SETTING,
) -> SetValuedSolution:
    """The fixed point of eq. (7) on a grid (by default the paper's coarse one).

    Raises:
        SolveError: NOT_APPLICABLE for a robot with drift or bounded inputs, or whose dynamics
            depend on its position.
        ValueError: if eps <= 2 h, or the settings give a node no image.
    """
    settings = settings or SetValuedSettings()
    system = query.system
    if not query.is_time_free:
        raise SolveError(Status.NOT_APPLICABLE, "the set-valued method needs no drift, no bounds")
    if grid is None:
        grid = Grid.of(system, COARSE if system.n == 3 else (58,) * system.n)
    if grid.dimension != system.n:
        raise ValueError(f"grid.shape: {system.name} has {system.n} states, got {grid.shape}")
    spacing = float(grid.spacing.max())
    if not settings.step > 2 * spacing:
        raise ValueError(
            f"step: eps must exceed 2 h = {2 * spacing:g} (the paper's condition), "
            f"got {settings.step:g}"
        )
    moves = _Moves.tabulate(query, grid, settings)
    nodes = grid.nodes().reshape(-1, system.n)
    costs = state_costs(query, nodes)
    frozen = query.goal_distance(nodes) <= (
        0.0 if settings.frozen is Frozen.GOAL else moves.speed * settings.step + spacing
    )
    blocked = query.clearance(nodes, hard_only=True) < 0
    graph = MoveGraph(
        np.array(grid.shape),
        np.array(grid.periodic),
        moves.turns,
        moves.first,
        moves.offsets,
        settings.step * moves.efforts,
        settings.step * costs,
        blocked,
        nodes,
        grid.spacing,
        hard_data(query),
    )
    if method is Method.LABEL_SETTING:
        values, best, sweeps = graph.label_setting(frozen)
    else:
        values, best, sweeps = graph.value_iteration(frozen, method is Method.GAUSS_SEIDEL)
    inputs = np.where(best[:, None] >= 0, moves.inputs[best], 0.0)
    return SetValuedSolution(
        query,
        settings,
        GridValue(grid, values.reshape(grid.shape)),
        inputs.reshape(*grid.shape, system.m),
        sweeps,
    )


@dataclass(frozen=True, eq=False)
class _Moves:
    """The moves from a node, for each of `g` combinations of the coordinates G depends on.

    Attributes:
        turns: `[n]`: 1 for coordinates that G depends on, else 0.
        first: `[g + 1]`: moves first[i] to first[i + 1] belong to combination i.
        offsets: `[k, n]` cells.
        efforts: `[k]` least u' R u of the sampled inputs with this image.
        inputs: `[k, m]` that input.
        speed: M, the largest norm of f over the sampled inputs.
    """

    turns: NDArray[np.int64]
    first: NDArray[np.int64]
    offsets: NDArray[np.int64]
    efforts: NDArray[np.float64]
    inputs: NDArray[np.float64]
    speed: float

    @classmethod
    def tabulate(cls, query: Query, grid: Grid, settings: SetValuedSettings) -> "_Moves":
        system = query.system
        dependent = _dependent(query)
        if any(dependent[i] for i in system.position):
            raise SolveError(
                Status.NOT_APPLICABLE, f"the dynamics of {system.name} depend on its position"
            )
        axes = [grid.axes[i] if dependent[i] else np.zeros(1) for i in range(system.n)]
        bases = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, system.n)
        samples = np.linspace(-settings.limit, settings.limit, settings.samples)
        inputs = np.array(list(product(samples, repeat=system.m)))
        effort = (query.input_weights * inputs**2).sum(axis=1)
        first, offsets, efforts, controls = [0], [], [], []
        speed = 0.0
        for base in bases:
            flow = rates(query, np.broadcast_to(base, (len(inputs), system.n)), inputs)
            speed = max(speed, float(np.linalg.norm(flow, axis=1).max()))
            if settings.image is Image.LATERAL:
                found = _lateral(query, grid, settings, base)
            else:
                found = _around(grid, settings, flow, effort, inputs)
            offsets.append(found[0])
            efforts.append(found[1])
            controls.append(found[2])
            first.append(first[-1] + len(found[0]))
            if not len(found[0]):
                raise ValueError("radius: alpha is so small that a node has no image")
        return cls(
            dependent.astype(np.int64),
            np.array(first),
            np.concatenate(offsets),
            np.concatenate(efforts),
            np.concatenate(controls),
            speed,
        )


Found = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def _around(
    grid: Grid, settings: SetValuedSettings, flow: NDArray, effort: NDArray, inputs: NDArray
) -> Found:
    """Images of the sampled inputs: the nearest node, or all within alpha."""
    target = settings.step * flow / grid.spacing  # in cells
    center = np.rint(target).astype(np.int64)
    if settings.image is Image.NEAREST:
        reach, radius = np.zeros(grid.dimension, dtype=np.int64), np.inf
    else:
        radius = settings.radius or float(np.linalg.norm(grid.spacing)) / 2
        reach = np.ceil(radius / grid.spacing).astype(np.int64)
    rows, costs, controls = [], [], []
    for shift in product(*(range(-r, r + 1) for r in reach)):
        node = center + np.array(shift)
        near = np.linalg.norm((node - target) * grid.spacing, axis=1) <= radius * (1 + 1e-12)
        rows.append(node[near])
        costs.append(effort[near])
        controls.append(inputs[near])
    return _cheapest(np.concatenate(rows), np.concatenate(costs), np.concatenate(controls))


def _lateral(query: Query, grid: Grid, settings: SetValuedSettings, base: NDArray) -> Found:
    """Nodes that miss the set of reachable displacements by at most alpha across it.

    The input that comes nearest, u = G^+ e / eps, must lie in the sampled box; it is not sampled.
    """
    m = query.system.m
    columns = rates(query, np.broadcast_to(base, (m, len(base))), np.eye(m)).T
    radius = settings.radius or float(grid.spacing.max()) / 2
    reach = np.abs(columns).sum(axis=1) * settings.limit * settings.step + radius
    ranges = [range(-int(r), int(r) + 1) for r in reach / grid.spacing]
    offsets = np.array(list(product(*ranges)), dtype=np.int64)
    displacement = offsets * grid.spacing
    inputs = displacement @ np.linalg.pinv(columns).T / settings.step
    miss = np.linalg.norm(displacement - settings.step * inputs @ columns.T, axis=1)
    allowed = (np.abs(inputs) <= settings.limit * (1 + 1e-12)).all(axis=1)
    keep = allowed & (miss <= radius * (1 + 1e-12))
    effort = (query.input_weights * inputs**2).sum(axis=1)
    return _cheapest(offsets[keep], effort[keep], inputs[keep])


def _cheapest(offsets: NDArray[np.int64], efforts: NDArray, inputs: NDArray) -> Found:
    """One move an offset, the cheapest; standing still is no move."""
    moving = offsets.any(axis=1)
    offsets, efforts, inputs = offsets[moving], efforts[moving], inputs[moving]
    order = np.lexsort((efforts, *offsets.T))
    offsets, efforts, inputs = offsets[order], efforts[order], inputs[order]
    new = np.ones(len(offsets), dtype=bool)
    new[1:] = (offsets[1:] != offsets[:-1]).any(axis=1)
    return offsets[new], efforts[new], inputs[new]


def _dependent(query: Query) -> NDArray[np.bool_]:
    """`[n]`: the coordinates that G depends on."""
    system = query.system
    jacobian = ca.jacobian(ca.vec(system.input_matrix), system.state)
    pattern = np.array(ca.DM(jacobian.sparsity(), 1)).reshape(-1, system.n)
    return np.asarray(pattern.any(axis=0))
