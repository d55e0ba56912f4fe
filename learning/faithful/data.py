"""The training data of Algorithm 1, lines 1 to 4: queries of the family, each with its data set."""

import logging

import numpy as np

from learning.faithful.config import Config, DataSettings, Source
from learning.faithful.meta_data import (
    FeatureMap,
    QueryTable,
    SampleMap,
    Supervision,
    along_trajectory,
)
from ocp.eikonal import solve_eikonal
from ocp.grid import Grid
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.set_valued import SetValuedSettings, solve_set_valued
from ocp.trajectory import SolveError
from ocp.value import greedy

log = logging.getLogger(__name__)

DATA_STREAM = 1
"""Training queries come from the seed sequence (seed, 1), so that no other draw meets them."""
INTERVAL = 0.1  # seconds between samples of exact motions


def training_queries(config: Config) -> list[Query]:
    """The sampled queries T, line 1."""
    rng = np.random.default_rng([config.seed, DATA_STREAM])
    return [config.data.distribution.sample(rng) for _ in range(config.data.queries)]


def training_table(config: Config) -> QueryTable:
    """Queries with their data, lines 1 to 4."""
    queries = training_queries(config)
    log.info("computing optimal values of %d queries (%s)", len(queries), config.data.source.value)
    data = [supervision(query, config.data, (config.seed, i)) for i, query in enumerate(queries)]
    return QueryTable(queries, data, sample_map(config, queries[0]))


def sample_map(config: Config, query: Query) -> SampleMap:
    """How the configuration turns data into tensors."""
    features = FeatureMap(query.system, config.network.relative)
    return SampleMap(features, config.network.structure, config.loss.difference_step)


def supervision(query: Query, settings: DataSettings, seed: tuple[int, int]) -> Supervision:
    """One query's data set D^tr. States without an admissible motion are left out."""
    if settings.source is Source.TRAJECTORIES:
        return _exact_motions(query, settings.trajectories, seed)
    grid = Grid.of(query.system, settings.grid)
    nodes = grid.nodes().reshape(-1, query.system.n)
    if settings.source is Source.EIKONAL:
        value = solve_eikonal(query).value
        values, inputs = value.value(nodes), greedy(query, value)(nodes)
    else:
        chosen = SetValuedSettings(step=settings.step, image=settings.image)
        solved = solve_set_valued(query, grid, chosen)
        values, inputs = solved.value.flat, solved.inputs.reshape(len(nodes), -1)
    known = np.isfinite(values)
    if not (values[known] > 0).any():
        raise ValueError(
            f"data.grid: {list(settings.grid)} is too coarse for the goal of radius "
            f"{query.goal.radius:g} m: no state outside it has a value"
        )
    return Supervision(nodes[known], values[known], inputs[known])


def _exact_motions(query: Query, count: int, seed: tuple[int, int]) -> Supervision:
    """Exact motions from random starts; those that fail are left out, and said."""
    rng = np.random.default_rng([*seed, DATA_STREAM])
    policy = solve_eikonal(query).policy()
    parts, failed = [], 0
    for _ in range(count):
        try:
            motion = exact_trajectory(query, sample_start(query, rng), policy)
        except SolveError:
            failed += 1
            continue
        parts.append(along_trajectory(query, motion, INTERVAL))
    if failed:
        log.info("%d of %d exact trajectories failed and are left out", failed, count)
    return Supervision.joined(parts)
