"""What may be wrong with a robot and its sensors: the one place where closed loops are perturbed.

The motion is still the System's own, `x' = f + G u`; a disturbance changes what the policy sees,
the input that arrives, and, between two control periods, the state. In a period

    measured = x + measurement noise
    asked = policy(measured), of so many periods ago
    given = asked, clipped to what the drives can do
    applied = given, less what each wheel loses by slipping, times the gains of the drives

and at its end x is pushed by process noise. The cost that is counted is that of the applied input:
without process noise the motion is one of the robot's own, so it costs V at least.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ocp.query import Query
from ocp.value import Policy

Array = NDArray[np.float64]

BLOCK = 64  # control periods for which random numbers are drawn at once
SLIP_SECONDS = 0.5  # in which a wheel's slip is forgotten


@dataclass(frozen=True)
class Disturbance:
    """How much of each; the default is none.

    Attributes:
        gain: each input of a trial is too strong or too weak by a constant share of it, uniform in
            [-gain, gain].
        slip: each wheel loses a share of its speed, uniform in [0, slip] and forgotten within
            `SLIP_SECONDS`.
        wheels: `m` rows of `w`: the inputs that unit speeds of the wheels make; square. By default
            each input is a wheel.
        process: `n` standard deviations of the noise that moves the state, units / sqrt(second).
        measurement: `n` standard deviations of what is measured, units.
        delay: control periods from a measurement to its input; until then the input is 0.
        limit: no input exceeds this in size.
    """

    gain: float = 0.0
    slip: float = 0.0
    wheels: tuple[tuple[float, ...], ...] | None = None
    process: tuple[float, ...] = ()
    measurement: tuple[float, ...] = ()
    delay: int = 0
    limit: float = np.inf

    def __post_init__(self) -> None:
        for name in ("gain", "slip"):
            share = getattr(self, name)
            if not 0 <= share < 1:
                raise ValueError(f"{name}: must be a share between 0 and 1, got {share}")
        for name in ("process", "measurement"):
            noise = getattr(self, name)
            if not all(np.isfinite(s) and s >= 0 for s in noise):
                raise ValueError(f"{name}: standard deviations must not be negative, got {noise}")
        if self.delay < 0:
            raise ValueError(f"delay: must not be negative, got {self.delay}")
        if not self.limit > 0:
            raise ValueError(f"limit: must be positive, got {self.limit}")


class DisturbedLoops:
    """The disturbance of a batch of closed loops, begun anew for each batch.

    A loop's random numbers depend on the seed and its number in the batch only, not on its company
    nor on the policy.
    """

    def __init__(
        self, disturbance: Disturbance, query: Query, count: int, period: float, seed: int
    ) -> None:
        system = query.system
        n, m = system.n, system.m
        self.disturbance, self.period, self.n = disturbance, period, n
        self.process = _deviations("process", disturbance.process, n) * np.sqrt(period)
        self.measurement = _deviations("measurement", disturbance.measurement, n)
        wheels = disturbance.wheels
        self.wheels = np.eye(m) if wheels is None else np.array(wheels, dtype=float)
        if self.wheels.shape != (m, m) or not abs(np.linalg.det(self.wheels)) > 0:
            raise ValueError(f"wheels: need an invertible {m} x {m} matrix, got {wheels}")
        self.to_wheels = np.linalg.inv(self.wheels)
        self.generators = [np.random.default_rng([seed, i]) for i in range(count)]
        self.gains = 1.0 + disturbance.gain * np.array(
            [g.uniform(-1.0, 1.0, m) for g in self.generators]
        ).reshape(count, m)
        self.slipping = np.array([g.standard_normal(m) for g in self.generators]).reshape(count, m)
        self.pipeline = np.zeros((disturbance.delay, count, m))
        self.draws = np.zeros((count, BLOCK, 2 * n + m))

    def inputs(self, k: int, policy: Policy, active: NDArray[np.intp], states: Array) -> Array:
        """The applied inputs `[a, m]` of period `k`, of the loops `active` `[a]` at `states`."""
        if k % BLOCK == 0:
            for i in active:
                self.draws[i] = self.generators[i].standard_normal(self.draws.shape[1:])
        noise = self.draws[active, k % BLOCK]
        given = np.array(policy(states + self.measurement * noise[:, : self.n]), dtype=float)
        if self.disturbance.delay:
            slot = k % self.disturbance.delay
            asked = given
            given = self.pipeline[slot, active]
            self.pipeline[slot, active] = asked
        limit = self.disturbance.limit
        applied = self.gains[active] * np.clip(given, -limit, limit)
        if self.disturbance.slip:
            applied = self._slipped(active, applied, noise[:, 2 * self.n :])
        return applied

    def _slipped(self, active: NDArray[np.intp], inputs: Array, noise: Array) -> Array:
        from scipy.special import ndtr

        kept = np.exp(-self.period / SLIP_SECONDS)
        self.slipping[active] = kept * self.slipping[active] + np.sqrt(1 - kept**2) * noise
        lost = self.disturbance.slip * ndtr(self.slipping[active])
        # Sums row by row: a matrix product rounds by the size of the batch.
        speeds = (self.to_wheels * inputs[:, None, :]).sum(axis=-1)
        return inputs - (self.wheels * (lost * speeds)[:, None, :]).sum(axis=-1)

    def push(self, k: int, active: NDArray[np.intp], states: Array) -> Array:
        """`states` `[a, n]` at the end of period `k`, moved by process noise."""
        return states + self.process * self.draws[active, k % BLOCK, self.n : 2 * self.n]


def _deviations(name: str, given: tuple[float, ...], n: int) -> Array:
    if len(given) not in (0, n):
        raise ValueError(f"{name}: needs {n} standard deviations or none, got {len(given)}")
    return np.array(given) if given else np.zeros(n)
