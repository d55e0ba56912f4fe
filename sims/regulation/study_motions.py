"""Recorded motions of the shipped systems, and how well the gains are learned from them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.certificate import Certificate, relative_gain_error
from learning.q_learning.identification import identify
from learning.q_learning.learner import QLearner
from sims.regulation.regulate import SUBSTEPS, learner_settings
from sims.regulation.simulation import LinearPlant, probed_motions
from sims.regulation.system_file import SystemFile, shipped_systems

Array = NDArray[np.float64]

SEEDS = range(20)
GRID = 101
"""Times at which gains are compared, over the horizon."""


def load(name: str, **changes: Any) -> SystemFile:
    """A shipped system, with fields changed."""
    return replace(SystemFile.load(shipped_systems()[name]), **changes)


def plant_of(system: SystemFile) -> LinearPlant:
    return LinearPlant(system.problem.A, system.problem.B)


def recorded(system: SystemFile, seeds: Sequence[int]) -> tuple[Array, Array]:
    """Probed motions of a system for many seeds: see `probed_motions`."""
    return probed_motions(
        plant_of(system),
        system.start,
        system.data_seconds,
        system.sample_period,
        SUBSTEPS,
        system.probing,
        system.behaviour_gain,
        system.noise,
        seeds,
    )


def learn(system: SystemFile, states: Array, inputs: Array) -> tuple[QLearner, Certificate]:
    """A learner that was shown one recorded motion."""
    learner = QLearner(system.cost, learner_settings(system))
    learner.absorb(states, inputs)
    return learner, learner.certify()


def gain_errors(system: SystemFile, seeds: Sequence[int]) -> tuple[Array, Array]:
    """Measured and claimed gain error of each seed; infinite where nothing was learned."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    measured, claimed = [], []
    for states, inputs in zip(*recorded(system, seeds), strict=True):
        learner, certificate = learn(system, states, inputs)
        claimed.append(certificate.gain_error)
        known = learner.regulator
        error = np.inf if known is None else relative_gain_error(known.gain(times), exact)
        measured.append(error)
    return np.array(measured), np.array(claimed)


def identification_errors(system: SystemFile, seeds: Sequence[int]) -> Array:
    """Gain error of identify-then-Riccati from the same data and windows."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    settings = learner_settings(system)
    errors = []
    for states, inputs in zip(*recorded(system, seeds), strict=True):
        known = identify(states, inputs, system.sample_period, settings.window)
        errors.append(relative_gain_error(known.riccati(system.cost).gain(times), exact))
    return np.array(errors)
