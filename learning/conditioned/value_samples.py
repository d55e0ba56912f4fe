"""Samples of optimal values to learn from: cheap, since a grid solves a query in milliseconds.

Each query is solved twice by fast marching: over its whole domain, and finely around its goal.
States are drawn uniformly, along closed loops (where policies will be), near the goal, and heading
about square to the ray to the goal. There the value without obstacles has a kink, forward being as
good as backward; among obstacles V's own lies elsewhere, and the network, a multiple of the value
without, must cancel it: what is left traps a robot.

Beside the goal V is taken from backward characteristics, which are exact; a grid's cells there have
nodes within the goal and without. Farther off it is interpolated: V minus the exact value without
obstacles, which is the smoother near the goal. Where its gradient does not satisfy the
Hamilton-Jacobi equation but V's own does, as beside that kink, V is interpolated. Where neither
does V is not smooth (two classes of motions cost about the same); there only the value is learned.
"""

import hashlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.conditioned.query_encoder import REACH
from ocp.compiled.batch import rates, state_costs
from ocp.eikonal import solve_eikonal
from ocp.extremals.characteristics import backward_characteristics
from ocp.extremals.warm_start import rollouts
from ocp.family_file import load_family
from ocp.grid import Grid, GridValue
from ocp.grids.goal_table import GoalTable, goal_table
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.query_file import query_to_dict

Floats = NDArray[np.float64]

MARGIN = 0.5  # metres beyond the domain: optimal motions may leave it
AROUND = 1.0  # metres: the fine grid's border around the goal
FINE_NODES = 20_000
NEAREST, NEAR, FAR = 0.003, 0.2, 0.6
"""Metres from the goal: up to NEAR samples are of characteristics, up to FAR of a fine grid."""
NEAR_COST = 3.0  # of the longest characteristics: from NEAR it is about 1 if obstacles add nothing
GRAZING = 0.5  # share of characteristics that end nearly tangentially, where headings change most
LOOPS = 12
SCATTER = (0.1, 0.1, 0.2)  # of states off their closed loops
SQUARE = 0.1  # radians off square to the ray to the goal
RESIDUAL = 0.06  # relative, of the Hamilton-Jacobi equation where V is smooth


@dataclass(frozen=True)
class SampleSizes:
    """How much data is made.

    Attributes:
        queries: with at least one obstacle each (without any the value is known).
        states: a query.
        nodes: of the grid over the whole domain.
    """

    queries: int
    states: int
    nodes: int


@dataclass(frozen=True)
class ValueSamples:
    """States of one query with what is known of V there.

    Attributes:
        states: `[k, 3]`.
        values: `[k]`, V.
        slopes: `[k, m]`, grad V' G, the derivatives along the inputs' directions.
        smooth: `[k]`, whether `slopes` can be trusted.
    """

    states: Floats
    values: Floats
    slopes: Floats
    smooth: NDArray[np.bool_]


def input_directions(query: Query, states: Floats) -> Floats:
    """The columns of G(x): `[k, n, m]` at states `[k, n]` of a robot without drift."""
    units = np.eye(query.system.m)
    columns = [rates(query, states, np.tile(u, (len(states), 1))) for u in units]
    return np.stack(columns, axis=-1)


def sample_values(query: Query, sizes: SampleSizes, rng: np.random.Generator) -> ValueSamples:
    """Samples of one query."""
    coarse = solve_eikonal(query, Grid.for_query(query, sizes.nodes, margin=MARGIN))
    fine = solve_eikonal(query, _around_goal(query)).value.on_grid
    beside, near_count = 3 * sizes.states // 20, sizes.states // 20
    loop_count, square = 3 * sizes.states // 10, sizes.states // 5
    anywhere = sizes.states - beside - near_count - loop_count
    starts = np.array([sample_start(query, rng) for _ in range(max(anywhere, LOOPS))])
    rays = query.reference[:2] - starts[:square, :2]
    side = np.pi / 2 * rng.choice([-1.0, 1.0], len(rays)) + SQUARE * rng.normal(size=len(rays))
    starts[:square, 2] = np.arctan2(rays[:, 1], rays[:, 0]) + side
    loops = [r for r in rollouts(query, coarse.policy(), starts[-LOOPS:]) if r is not None]
    path = np.concatenate([starts[:1], *(r.states for r in loops)])
    followed = path[rng.integers(len(path), size=loop_count)]
    followed = followed + rng.normal(size=followed.shape) * SCATTER
    angles, headings = rng.uniform(-np.pi, np.pi, (2, near_count))
    gaps = rng.uniform(NEAR, FAR, near_count)
    radius = (query.goal.radius + gaps)[:, None]
    place = query.reference[:2] + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    near = np.column_stack([place, headings])
    table = goal_table(query, REACH)
    parts = [
        known_values(
            query, table, coarse.value.on_grid, np.concatenate([starts[:anywhere], followed])
        ),
        known_values(query, table, fine, near),
        beside_goal(query, beside, rng),
    ]
    return ValueSamples(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(ValueSamples))
    )


def _around_goal(query: Query) -> Grid:
    """A fine grid over a square around the goal and half a turn of headings."""
    whole = Grid.for_query(query, FINE_NODES)
    center, reach = query.reference[:2], query.goal.radius + AROUND
    headings = max(9, whole.shape[2])
    side = round((FINE_NODES / headings) ** 0.5)
    return Grid(
        (*map(float, center - reach), whole.lower[2]),
        (*map(float, center + reach), whole.upper[2]),
        (side, side, headings),
        whole.periodic,
    )


def known_values(query: Query, table: GoalTable, value: GridValue, states: Floats) -> ValueSamples:
    """What a grid knows at the states that lie well in its box and not beside the goal."""
    states = states[query.goal_distance(states) > NEAR]
    states = states[np.asarray(value.grid.contains(states))]
    rise = GridValue(value.grid, value.values - table.on_product(*value.grid.axes))
    values = rise.value(states) + table.value(states)
    directions = input_directions(query, states)
    slopes = np.einsum("kn,knm->km", rise.gradient(states) + table.gradient(states), directions)
    smooth = _satisfied(query, states, slopes)
    own = np.einsum("kn,knm->km", value.gradient(states), directions)
    better = ~smooth & _satisfied(query, states, own)
    values = np.where(better, value.value(states), values)
    slopes = np.where(better[:, None], own, slopes)
    smooth |= better
    shift = value.grid.spacing * [1, 1, 0]  # as far as the gradient reaches
    smooth &= np.asarray(value.grid.contains(states + shift))
    smooth &= np.asarray(value.grid.contains(states - shift))
    return ValueSamples(states, values, slopes, smooth)


def beside_goal(query: Query, count: int, rng: np.random.Generator) -> ValueSamples:
    """Up to `count` samples between NEAREST and NEAR from the goal, spread evenly by logarithm.

    Each is a point of a characteristic, which is optimal up to where the robot is square to the ray
    to the goal: there the way round the other side is as good.
    """
    angles, headings = rng.uniform(-np.pi, np.pi, (2, count))
    off = np.exp(rng.uniform(np.log(0.01), np.log(0.5), count)) * rng.choice([-1.0, 1.0], count)
    grazing = angles + np.pi / 2 * rng.choice([-1.0, 1.0], count) + off
    headings = np.where(rng.random(count) < GRAZING, grazing, headings)
    rim = query.goal.radius * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = np.column_stack([query.reference[:2] + rim, headings])
    fan = backward_characteristics(query, ends, NEAR_COST, tolerance=1e-8, max_points=200)
    distance = query.goal_distance(fan.states)
    bearing = np.arctan2(*(fan.states[..., :2] - query.reference[:2]).transpose(2, 0, 1)[::-1])
    facing = np.cos(fan.states[..., 2] - bearing)
    turned = np.cumsum(~(facing * facing[:, :1] > 0), axis=1) > 0
    wanted = np.exp(rng.uniform(np.log(NEAREST), np.log(NEAR), count))
    off = np.abs(np.log(np.maximum(distance, 1e-9) / wanted[:, None]))
    off[turned | ~(distance > NEAREST / 2) | ~(distance < NEAR)] = np.inf
    rows, points = np.arange(count), np.argmin(off, axis=1)
    kept = np.isfinite(off[rows, points])
    rows, points = rows[kept], points[kept]
    states, costates = fan.states[rows, points], fan.costates[rows, points]
    slopes = np.einsum("kn,knm->km", costates, input_directions(query, states))
    values = fan.costs[rows, points]
    return ValueSamples(states, values, slopes, np.ones(len(rows), dtype=bool))


def _satisfied(query: Query, states: Floats, slopes: Floats) -> NDArray[np.bool_]:
    """Whether grad V' G `[k, m]` satisfies the Hamilton-Jacobi equation at states `[k, n]`."""
    effort = 0.5 * np.linalg.norm(slopes / np.sqrt(query.input_weights), axis=1)
    needed = np.sqrt(state_costs(query, states))
    return np.abs(effort - needed) < RESIDUAL * needed


@dataclass(frozen=True)
class SampleTask:
    """The k-th query of a family, and its samples: they depend on these numbers only."""

    family: str
    sizes: SampleSizes
    seed: int
    number: int


def sample_query(task: SampleTask) -> tuple[dict[str, Any], ValueSamples]:
    """The query, as the tables of a query file, and its samples."""
    rng = np.random.default_rng([task.seed, task.number])
    family = load_family(task.family)
    query = family.sample(rng)
    while not query.obstacles:
        query = family.sample(rng)
    return query_to_dict(query), sample_values(query, task.sizes, rng)


def digest(samples: list[tuple[Query, ValueSamples]]) -> str:
    """A hash of everything sampled."""
    total = hashlib.sha256()
    for query, known in samples:
        total.update(query.dumps().encode())
        for f in fields(known):
            total.update(np.ascontiguousarray(getattr(known, f.name)).tobytes())
    return total.hexdigest()
