"""Linear regulation in simulation: in a Drake Diagram, and compiled over many runs at once.

The simulator alone knows the plant. `drake_motion` closes the loop of any sampled controller;
`probed_motions` makes the same motion as a probing learner, for a batch of seeds, exactly (held
inputs make x' = A x + B u + c a matrix exponential); `regulated_costs` runs learned gains. They are
tested against each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numba import float64, int64, types
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.compiled.jit import MATRIX, VECTOR, compiled

Array = NDArray[np.float64]

BLOWN_UP = 1e6
LONGEST_STEP = 1e-3
"""Seconds, Runge-Kutta steps of `regulated_costs`; costs are then good to 1e-9 here."""


class Controller(Protocol):
    """Whatever is handed a measured state once a sample and answers with the input to hold."""

    def control(self, state: ArrayLike) -> Array:
        """The input `[m]` to hold until the next sample, at the measured state `[n]`."""
        ...


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """The truth, for simulators: x' = A x + B u + drift."""

    A: Array
    B: Array
    drift: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.drift.size == 0:
            object.__setattr__(self, "drift", np.zeros(len(self.A)))

    def held_step(self, period: float) -> tuple[Array, Array, Array]:
        """(F, G, g) with x(t + period) = F x + G u + g while u is held."""
        from scipy.linalg import expm

        n, m = self.B.shape
        block = np.zeros((n + m + 1, n + m + 1))
        block[:n] = np.column_stack([self.A, self.B, self.drift])
        power = np.asarray(expm(block * period), dtype=np.float64)
        return (
            np.ascontiguousarray(power[:n, :n]),
            np.ascontiguousarray(power[:n, n : n + m]),
            power[:n, -1].copy(),
        )


@dataclass(frozen=True)
class Motion:
    """A sampled closed loop of `k` samples.

    Attributes:
        times: `[k]`, seconds.
        states: `[k, n]`, true.
        measured: `[k, n]`, as the controller saw them.
        inputs: `[k, m]`, each held until the next sample.
    """

    times: Array
    states: Array
    measured: Array
    inputs: Array


def streams(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Independent generators for a run's probing and for its measurement noise."""
    probing, noise = np.random.SeedSequence(seed).spawn(2)
    return np.random.default_rng(probing), np.random.default_rng(noise)


def drake_motion(
    plant: LinearPlant,
    controller: Controller,
    start: ArrayLike,
    seconds: float,
    period: float,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    accuracy: float = 1e-11,
) -> Motion:
    """Close the loop in Drake's error-controlled Simulator for `seconds`, both ends sampled.

    Gaussian `noise` (a standard deviation) from `rng` is added to every measured state.
    """
    from sims.regulation.diagram import simulate

    initial = np.array(start, dtype=float)
    source = rng if rng is not None else np.random.default_rng(0)
    return simulate(plant, controller, initial, seconds, period, noise, source, accuracy)


def sampled_motion(
    plant: LinearPlant, controller: Controller, start: ArrayLike, seconds: float, period: float
) -> Motion:
    """The same loop, noise-free, by matrix exponentials: for controllers that Drake would slow."""
    F, G, g = plant.held_step(period)
    x = np.array(start, dtype=float)
    states, inputs = [], []
    for _ in range(round(seconds / period) + 1):
        u = np.asarray(controller.control(x))
        states.append(x)
        inputs.append(u)
        x = F @ x + G @ u + g
    times = np.arange(len(states), dtype=np.float64) * float(period)
    return Motion(times, np.array(states), np.array(states), np.array(inputs))


@dataclass(frozen=True)
class Course:
    """A run along waypoints.

    Attributes:
        times: `[k]`, seconds.
        states: `[k, n]`, absolute (not errors).
        reached: legs that ended in the admissible window.
        blew_up: the state left every bound.
    """

    times: Array
    states: Array
    reached: int
    blew_up: bool


class LegController(Controller, Protocol):
    """A controller of error coordinates that is told when the waypoint changes."""

    def new_leg(self) -> None:
        """The state is measured from another waypoint from now on."""
        ...


def drive_legs(
    plant: LinearPlant,
    controller: LegController,
    waypoints: ArrayLike,
    period: float,
    horizon: float,
    admissible: float = 0.15,
    watch: Callable[[float], None] | None = None,
) -> Course:
    """Drive from the first to the last of `waypoints` `[w, n]`, each leg in error coordinates.

    The plant acts on the error, as in the paper's (1): a spring is anchored anew at every waypoint.
    A leg ends when the error falls to `admissible` of its initial size, or at the horizon.
    """
    points = np.asarray(waypoints, dtype=float)
    F, G, g = plant.held_step(period)
    times, states = [0.0], [points[0]]
    reached, position = 0, points[0]
    for target in points[1:]:
        controller.new_leg()
        x = position - target
        initial = float(np.linalg.norm(x))
        for _ in range(round(horizon / period)):
            x = F @ x + G @ np.asarray(controller.control(x)) + g
            times.append(times[-1] + period)
            states.append(x + target)
            if not np.abs(x).max() < BLOWN_UP:
                return Course(np.array(times), np.array(states), reached, True)
            if watch is not None:
                watch(times[-1])
            if np.linalg.norm(x) <= admissible * initial:
                reached += 1
                break
        position = x + target
    return Course(np.array(times), np.array(states), reached, False)


def probed_motions(
    plant: LinearPlant,
    start: ArrayLike,
    seconds: float,
    period: float,
    substeps: int,
    probing: float,
    behaviour_gain: Array,
    noise: float,
    seeds: Sequence[int],
) -> tuple[Array, Array]:
    """What probing learners measure: states `[seed, k s + 1, n]` and held inputs `[seed, k, m]`.

    The draws are those of a `QLearner` and a `drake_motion` with the generators of `streams(seed)`.
    """
    n, m = plant.B.shape
    holds = round(seconds / period) // substeps
    count = holds * substeps + 1
    probes, noises = np.empty((len(seeds), holds, m)), np.zeros((len(seeds), count, n))
    for row, seed in enumerate(seeds):
        first, second = streams(seed)
        probes[row] = probing * first.standard_normal((holds, m))
        if noise > 0:
            noises[row] = noise * second.standard_normal((count, n))
    measured, inputs = np.empty((len(seeds), count, n)), np.empty((len(seeds), holds, m))
    _probe(
        *plant.held_step(period),
        np.array(start, dtype=float),
        np.ascontiguousarray(behaviour_gain, dtype=float),
        probes,
        noises,
        measured,
        inputs,
    )
    return measured, inputs


@compiled(
    types.void(
        MATRIX,
        MATRIX,
        VECTOR,
        VECTOR,
        MATRIX,
        float64[:, :, ::1],
        float64[:, :, ::1],
        float64[:, :, ::1],
        float64[:, :, ::1],
    )
)
def _probe(F, G, g, start, gain, probes, noises, measured, inputs):
    n, m = G.shape
    holds = probes.shape[1]
    substeps = (noises.shape[1] - 1) // holds
    x, nxt = np.empty(n), np.empty(n)
    for run in range(probes.shape[0]):
        x[:] = start
        measured[run, 0] = x + noises[run, 0]
        for k in range(holds):
            for a in range(m):
                total = probes[run, k, a]
                for i in range(n):
                    total -= gain[a, i] * measured[run, k * substeps, i]
                inputs[run, k, a] = total
            for s in range(substeps):
                for i in range(n):
                    total = g[i]
                    for j in range(n):
                        total += F[i, j] * x[j]
                    for a in range(m):
                        total += G[i, a] * inputs[run, k, a]
                    nxt[i] = total
                x[:] = nxt
                sample = k * substeps + s + 1
                measured[run, sample] = x + noises[run, sample]


def regulated_costs(
    plant: LinearPlant,
    cost: QuadraticCost,
    gain: Callable[[Array], Array],
    starts: ArrayLike,
    offset: Callable[[Array], Array] | None = None,
    hold: float | None = None,
) -> tuple[Array, Array, Array]:
    """Run u = -K(t) x - k(t) from `starts` `[s, n]` to the horizon.

    `gain` gives K `[k, m, n]` and `offset` k `[k, m]` at times `[k]`; with `hold` the gain is
    renewed only every so many seconds (the state is still fed back continuously).

    Returns:
        costs `[s]` (without one half, terminal cost included; infinite where the motion blew up),
        times `[k]` and states `[s, k, n]`.

    Raises:
        ValueError: if `hold` does not divide the horizon.
    """
    initial = np.ascontiguousarray(np.atleast_2d(np.asarray(starts, dtype=float)))
    block = hold if hold is not None else cost.horizon
    per_block = int(np.ceil(block / LONGEST_STEP))
    blocks = int(np.ceil(cost.horizon / block - 1e-9))
    steps = per_block * blocks
    step = cost.horizon / steps if hold is None else block / per_block
    if hold is not None and abs(steps * step - cost.horizon) > 1e-9 * cost.horizon:
        raise ValueError(f"hold: must divide the horizon {cost.horizon:g} s, got {hold:g} s")
    counts = np.arange(2 * steps + 1, dtype=np.float64)
    renewed = 0.5 * step * counts if hold is None else hold * (counts // (2 * per_block))
    gains = np.ascontiguousarray(gain(renewed))
    offsets = np.zeros(gains.shape[:2]) if offset is None else np.ascontiguousarray(offset(renewed))
    states = np.empty((len(initial), steps + 1, plant.B.shape[0]))
    costs = np.empty(len(initial))
    _regulate(
        plant.A.copy(),
        plant.B.copy(),
        plant.drift.copy(),
        cost.M.copy(),
        cost.R.copy(),
        cost.terminal.copy(),
        gains,
        offsets,
        initial,
        step,
        int(hold is not None),
        states,
        costs,
    )
    return costs, step * counts[: steps + 1], states


@compiled(
    types.void(
        MATRIX,
        MATRIX,
        VECTOR,
        MATRIX,
        MATRIX,
        MATRIX,
        float64[:, :, ::1],
        MATRIX,
        MATRIX,
        float64,
        int64,
        float64[:, :, ::1],
        VECTOR,
    )
)
def _regulate(A, B, drift, M, R, terminal, gains, offsets, starts, step, held, states, costs):
    """Runge-Kutta 4; `gains` is tabulated at half steps, a held one is that of the step's start."""
    n, m = B.shape
    rates = np.empty((4, n + 1))
    x, u = np.empty(n), np.empty(m)
    for run in range(starts.shape[0]):
        states[run, 0] = starts[run]
        total = 0.0
        for k in range(states.shape[1] - 1):
            for stage in range(4):
                at = 2 * k + (0 if held else (stage + 1) // 2)
                fraction = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
                for i in range(n):
                    x[i] = states[run, k, i]
                    if stage > 0:
                        x[i] += fraction * rates[stage - 1, i]
                for a in range(m):
                    u[a] = -offsets[at, a]
                    for i in range(n):
                        u[a] -= gains[at, a, i] * x[i]
                running = 0.0
                for i in range(n):
                    slope = drift[i]
                    for j in range(n):
                        slope += A[i, j] * x[j]
                        running += x[i] * M[i, j] * x[j]
                    for a in range(m):
                        slope += B[i, a] * u[a]
                    rates[stage, i] = slope
                for a in range(m):
                    for b in range(m):
                        running += u[a] * R[a, b] * u[b]
                rates[stage, n] = running
            for i in range(n + 1):
                slope = rates[0, i] + 2.0 * (rates[1, i] + rates[2, i]) + rates[3, i]
                if i < n:
                    states[run, k + 1, i] = states[run, k, i] + step / 6.0 * slope
                else:
                    total += step / 6.0 * slope
        last = states[run, states.shape[1] - 1]
        for i in range(n):
            for j in range(n):
                total += last[i] * terminal[i, j] * last[j]
        costs[run] = total if np.isfinite(total) else np.inf
