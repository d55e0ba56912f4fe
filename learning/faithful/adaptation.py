"""Algorithm 2 of Xu and Zhu: anytime adaptation of the meta value function to a new query.

Each iteration adds one exact trajectory to the pool, draws K_n samples from it and from the goal,
and takes M gradient steps from where the last iteration ended.
"""

import logging
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from learning.faithful.adam import Moments, adam_step
from learning.faithful.config import AdaptationSettings, Config, Optimizer
from learning.faithful.data import sample_map
from learning.faithful.losses import Samples, lagrangian_gradient
from learning.faithful.meta_data import Supervision, along_trajectory, in_goal
from learning.faithful.value_network import Parameters
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.trajectory import SolveError, Status, Trajectory

log = logging.getLogger(__name__)

START_STREAM, SHOT_STREAM = 3, 4
ATTEMPTS = 20  # starts without a verified trajectory before giving up


@dataclass(frozen=True)
class Adaptation:
    """Where Algorithm 2 stands after n iterations; never changed, only replaced.

    Attributes:
        query: the new query.
        parameters: theta_n.
        pool: the samples of each trajectory so far.
        failed: starts for which no verified trajectory was found.
        moments: of Adam; `None` for gradient steps.
    """

    query: Query
    parameters: Parameters
    pool: tuple[Supervision, ...] = ()
    failed: int = 0
    moments: Moments | None = field(default=None, repr=False)

    @property
    def iteration(self) -> int:
        """n, also the number of trajectories."""
        return len(self.pool)


def next_trajectory(adaptation: Adaptation, seed: int) -> tuple[Trajectory, int]:
    """The exact trajectory from the next random start, lines 5 and 6, and how many starts failed.

    The first guess comes from a coarse value of the new query, not of a training query near it.

    Raises:
        SolveError: if there was none for `ATTEMPTS` starts.
    """
    query = adaptation.query
    rng = np.random.default_rng([seed, START_STREAM, adaptation.iteration])
    for failed in range(ATTEMPTS):
        try:
            return exact_trajectory(query, sample_start(query, rng)), failed
        except SolveError as error:
            log.info("adaptation: a start is left out: %s", error)
    raise SolveError(Status.NOT_CONVERGED, f"no trajectory from {ATTEMPTS} random starts")


def adapt_once(
    adaptation: Adaptation, config: Config, seed: int, motion: Trajectory | None = None
) -> Adaptation:
    """One iteration of Algorithm 2, lines 4 to 22.

    Args:
        adaptation: where it stands.
        config: how it steps.
        seed: of starts and shots.
        motion: the trajectory to add, if it is known already.

    Raises:
        SolveError: if no trajectory is found.
    """
    settings, query, failed = config.adaptation, adaptation.query, 0
    if motion is None:
        motion, failed = next_trajectory(adaptation, seed)
    pool = (*adaptation.pool, along_trajectory(query, motion, settings.interval))
    n = len(pool)
    rng = np.random.default_rng([seed, SHOT_STREAM, n])
    shots = drawn_shots(query, pool, settings, rng)
    samples = sample_map(config, query).samples(query, shots)
    moments = adaptation.moments
    parameters = adaptation.parameters
    for _ in range(settings.steps):
        parameters, moments = _stepped(parameters, samples, config, moments)
    if not all(bool(torch.isfinite(p).all()) for p in parameters):
        raise FloatingPointError(
            f"adaptation diverged at n = {n}: lower adaptation.rate ({settings.rate:g})"
        )
    return replace(
        adaptation,
        parameters=parameters,
        pool=pool,
        failed=adaptation.failed + failed,
        moments=moments,
    )


def drawn_shots(
    query: Query,
    pool: tuple[Supervision, ...],
    settings: AdaptationSettings,
    rng: np.random.Generator,
) -> Supervision:
    """The K_n-shot data set, lines 8 to 14: from all trajectories, and from the goal."""
    along = Supervision.joined(pool)
    ratio = settings.goal_ratio
    goal = in_goal(query, round(len(along) * ratio / (1 - ratio)), rng)
    everything = Supervision.joined([along, goal])
    return everything.drawn(settings.shots_per_trajectory * len(pool), rng)


def _stepped(
    parameters: Parameters, samples: Samples, config: Config, moments: Moments | None
) -> tuple[Parameters, Moments | None]:
    """One step, line 17."""
    rate = config.adaptation.rate
    with torch.no_grad():
        gradient = lagrangian_gradient(parameters, samples, config.lagrangian).gradient
        if config.adaptation.optimizer is Optimizer.GRADIENT:
            moved = tuple(p - rate * g for p, g in zip(parameters, gradient, strict=True))
            return moved, None
        return adam_step(parameters, gradient, rate, moments)
