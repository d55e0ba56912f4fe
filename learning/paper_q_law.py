"""The actor-critic law of Kontoudis, Xu and Vamvoudakis (RRT-Q^X, 2022), kept as a baseline.

`LiteralLaw` is (12)-(16), (19)-(25) as printed; `RepairedLaw` mends the slips that stop it from
running. Neither was seen to converge to the optimal gain on any plant: regulate with `q_learning`.
`docs/q-learning-slips.md` lists each slip, what the printed form does and the repair.

Symbols of the paper, here and in the kernels:

    x-bar   `x` `[n]`, the state measured from the waypoint      U    [x; u] `[n + m]`
    u-hat   `u` `[m]`, the input                                 W_c  `critic` `[c]`, c = N(N+1)/2
    W_a     `actor` `[n, m]`                                     N    n + m
    nu, mu  a scalar function of time times the identity         alpha_c, alpha_a  the two gains
    Delta t `resolution`                                         T    `cost.horizon`
    sigma, sigma_f, e_c1, e_c2, e_a, P(T), M, R                  as in the paper

Entries of W_c come in the order that (24) indexes: the products x_i x_j (i <= j), u_k x_i (k by k),
u_k u_l (k <= l). Costs carry the paper's one half.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from time import thread_time
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.gain_bound import GainBound, gain_bound
from learning.paper_q_kernels import literal_step, repaired_step
from learning.quadratic_cost import QuadraticCost

Array = NDArray[np.float64]

ROUNDING = 1e-14
DIVERGED = 1e9
"""A weight beyond this counts as diverged; the optimal ones are of order 100 on plants here."""


@dataclass(frozen=True)
class PaperSettings:
    """The paper's section 6, and the choices that it leaves open.

    Attributes:
        sample_period: seconds between measured states; the resolution must be a multiple of it.
        resolution: Delta t, seconds.
        critic_gain: alpha_c.
        actor_gain: alpha_a.
        center, width: nu(t) = mu(t) = exp(-((t - center)/width)^2 / 2), in horizons. The paper says
            "radial basis function of appropriate dimensions": one time function per weight.
        initial: weights begin uniform in [0, initial]; those of Q_uu begin at R.
        probing: standard deviation of a probing input. None is printed, though Lemma 4.2 needs it.
        memory: states kept to impose the terminal condition on (repaired law only).
    """

    sample_period: float = 0.05
    resolution: float = 0.05
    critic_gain: float = 90.0
    actor_gain: float = 1.2
    center: float = 1.0
    width: float = 1.0
    initial: float = 1.0
    probing: float = 0.0
    memory: int = 20

    def __post_init__(self) -> None:
        for name in ("sample_period", "resolution", "critic_gain", "actor_gain", "width"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: must be positive and finite, got {value}")
        steps = self.resolution / self.sample_period
        if abs(steps - round(steps)) > 1e-9 * steps or round(steps) < 1:
            raise ValueError(
                f"resolution: must be a multiple of sample_period {self.sample_period:g} s, "
                f"got {self.resolution:g} s"
            )
        if not (np.isfinite(self.probing) and self.probing >= 0):
            raise ValueError(f"probing: must be non-negative and finite, got {self.probing}")


class PaperLaw(ABC):
    """Either form of the law: `control` once a sample, `new_leg` at a waypoint switch.

    Attributes:
        cost: what to minimise.
        settings: gains and open choices.
        critic: W_c `[c]`.
        actor: W_a `[n, m]`.
        clock: seconds since the leg began.
        diverged: a weight left [-DIVERGED, DIVERGED]; the law is then frozen and gives u = 0.
        update_times: seconds of CPU time of each sample's update.
    """

    name: ClassVar[str]

    def __init__(
        self, cost: QuadraticCost, settings: PaperSettings, rng: np.random.Generator
    ) -> None:
        self.cost, self.settings, self.rng = cost, settings, rng
        n, m = cost.n, cost.m
        self._xx, self._xu = n * (n + 1) // 2, n * m
        count = self._xx + self._xu + m * (m + 1) // 2
        self.critic = rng.uniform(0.0, settings.initial, count)
        self.actor = rng.uniform(0.0, settings.initial, (n, m))
        self._initialise_uu()
        self.clock = 0.0
        self.diverged = False
        self.update_times: list[float] = []
        self._excitation = np.zeros((count, count))
        self._held = np.zeros(m)
        # The cost's own arrays are read-only, which compiled signatures tell apart.
        self._matrices = cost.M.copy(), cost.R.copy(), cost.terminal.copy()
        self._lag = round(settings.resolution / settings.sample_period)
        # Past U and sigma's own past: the last `lag` + 1 samples, newest last.
        self._past = np.zeros((self._lag + 1, n + m))
        self._known = 0

    def time_function(self, t: ArrayLike) -> Array:
        """nu(t) = mu(t), of the time in the leg."""
        horizon = self.cost.horizon
        offset = np.asarray(t, dtype=float) / horizon - self.settings.center
        return np.exp(-0.5 * (offset / self.settings.width) ** 2)

    def gain(self, times: ArrayLike = 0.0) -> Array:
        """K `[..., m, n]` of the actor: u = -K x = W_a' mu x (eq. 16)."""
        return -self.time_function(times)[..., None, None] * self.actor.T

    def Q_xu(self, t: float) -> Array:
        """The critic's estimate of PB `[n, m]` at time t."""
        block = self.critic[self._xx : self._xx + self._xu]
        return self._scale_xu * float(self.time_function(t)) * block.reshape(self.cost.m, -1).T

    def gain_bound(self) -> GainBound:
        """(25) at the present estimate."""
        value = float(self.time_function(self.clock))
        return gain_bound(self.cost, self.Q_xu(self.clock), value, self.settings.actor_gain)

    def excitation(self) -> float:
        """beta of Lemma 4.2: least eigenvalue of the integral of Delta Delta' since the start.

        Zero where it cannot be told from the rounding of the largest.
        """
        values = np.linalg.eigvalsh(self._excitation)
        return float(values[0]) if values[0] > ROUNDING * values[-1] else 0.0

    def excited_rank(self) -> int:
        """Eigenvalues of that integral above the largest one's rounding; len(critic) are needed."""
        values = np.linalg.eigvalsh(self._excitation)
        return int((values > ROUNDING * values[-1]).sum()) if values[-1] > 0 else 0

    def new_leg(self) -> None:
        """The state jumps to the next waypoint's error coordinates: differences across are void."""
        self.clock = 0.0
        self._known = 0

    def control(self, state: ArrayLike) -> Array:
        """The input `[m]` to hold until the next sample, given the state `[n]` measured now.

        Raises:
            ValueError: if the state has a wrong shape or is not finite.
        """
        x = np.asarray(state, dtype=float)
        if x.shape != (self.cost.n,) or not np.isfinite(x).all():
            raise ValueError(f"state: must be {self.cost.n} finite numbers, got {x.tolist()}")
        if self.diverged:
            return np.zeros(self.cost.m)
        begun = thread_time()
        self._step(x)
        self.update_times.append(thread_time() - begun)
        self.clock += self.settings.sample_period
        weights = max(np.abs(self.critic).max(), np.abs(self.actor).max())
        if not weights < DIVERGED:
            self.diverged = True
            return np.zeros(self.cost.m)
        return self._held

    def _actor_input(self, x: Array) -> Array:
        u = float(self.time_function(self.clock)) * self.actor.T @ x
        if self.settings.probing > 0:
            u += self.settings.probing * self.rng.standard_normal(self.cost.m)
        return u

    def _remember(self, x: Array) -> None:
        self._past[:-1] = self._past[1:]
        self._past[-1] = [*x, *self._held]
        self._known = min(self._known + 1, self._lag + 1)

    _scale_xu: ClassVar[float]

    @abstractmethod
    def _initialise_uu(self) -> None:
        """Give the weights of Q_uu, which (14) inverts, the values of R."""

    @abstractmethod
    def _step(self, x: Array) -> None:
        """One sample: update the weights and the held input."""


class LiteralLaw(PaperLaw):
    """The law as printed. Where the print leaves a choice, this is the reading:

    - `U (x) U`: its N(N+1)/2 distinct products, as `vech` needs (the print has N^2 of them);
      nu' W_c = vech(Q)/2 plainly, so off-diagonal entries count half of what U'QU asks for.
    - (19): nu(t - T) on the delayed term of e_c1, nu(t) on both terms of sigma, as printed.
    - e_c2: at every t, with the present state, though the condition (18) belongs to T.
    - (22): both terms with the printed sign; the second climbs.
    - (23): neither mu nor (24)'s normalisation.
    - The integral in (19) by the trapezoid rule, both laws by Euler steps of Delta t.
    - Q_uu is read from the critic and inverted.
    """

    name = "paper-literal"
    _scale_xu = 2.0

    def _initialise_uu(self) -> None:
        rows, columns = np.triu_indices(self.cost.m)
        start = self._xx + self._xu
        nu = float(np.exp(-0.5 * (self.settings.center / self.settings.width) ** 2))
        self.critic[start:] = 0.5 * self.cost.R[rows, columns] / nu

    def __init__(
        self, cost: QuadraticCost, settings: PaperSettings, rng: np.random.Generator
    ) -> None:
        super().__init__(cost, settings, rng)
        self._ticks = 0

    def new_leg(self) -> None:
        super().new_leg()
        self._ticks = 0

    def _step(self, x: Array) -> None:
        tick = self._ticks % self._lag == 0
        self._ticks += 1
        if not tick:
            return
        self._held = self._actor_input(x)
        self._past[0] = self._past[-1]
        self._past[-1] = [*x, *self._held]
        self._known += 1
        if self._known < 2:
            return
        t, settings = self.clock, self.settings
        times = np.array([self.time_function(t), self.time_function(t - self.cost.horizon)])
        try:
            inverse = np.linalg.inv(self._Q_uu(t))
        except np.linalg.LinAlgError:
            self.critic[:] = np.inf
            return
        literal_step(
            np.ascontiguousarray(self._past[[0, -1]]),
            times,
            *self._matrices,
            inverse,
            np.array([settings.resolution, settings.critic_gain, settings.actor_gain]),
            self.critic,
            self.actor,
            self._excitation,
        )

    def _Q_uu(self, t: float) -> Array:
        m = self.cost.m
        rows, columns = np.triu_indices(m)
        entries = 2.0 * self.time_function(t) * self.critic[self._xx + self._xu :]
        block = np.empty((m, m))
        block[rows, columns] = entries
        block[columns, rows] = entries
        return block


class RepairedLaw(PaperLaw):
    """The law with its slips mended: finite on the paper's rover, but not convergent.

    - Q = sum of c_ij U_i U_j over i <= j with c_ii = Q_ii/2, c_ij = Q_ij.
    - s = nu z, sigma = s(t) - s(t - Delta t): each term with its own time.
    - Terminal condition at T alone, on remembered states, at the *optimal* input there:
      x'P_T x/2 = W_c' nu(T) z(x, -R^-1 Q_ux(T) x); the second term of (22) descends.
    - dW_a/dt = -alpha_a mu x e_a' / (1 + |mu x|^2).
    - Q_uu = R, which is known.
    - Euler steps of the sample period (5 ms is meant), integral by the trapezoid rule on samples.
    """

    name = "paper-repaired"
    _scale_xu = 1.0

    def _initialise_uu(self) -> None:
        rows, columns = np.triu_indices(self.cost.m)
        entries = self.cost.R[rows, columns] * np.where(rows == columns, 0.5, 1.0)
        self.critic[self._xx + self._xu :] = entries

    def __init__(
        self, cost: QuadraticCost, settings: PaperSettings, rng: np.random.Generator
    ) -> None:
        super().__init__(cost, settings, rng)
        self._inverse = np.linalg.inv(cost.R)
        self._stored = np.zeros((settings.memory, cost.n))
        self._counts = np.zeros(2, dtype=np.int64)

    def _step(self, x: Array) -> None:
        self._held = self._actor_input(x)
        self._remember(x)
        if self._known < self._lag + 1:
            return
        t, settings = self.clock, self.settings
        if self._counts[1] % self._lag == 0:
            self._stored[self._counts[0] % settings.memory] = x
            self._counts[0] += 1
        self._counts[1] += 1
        times = self.time_function(np.array([t, t - settings.resolution, self.cost.horizon]))
        repaired_step(
            self._past,
            self._stored[: min(int(self._counts[0]), settings.memory)],
            times,
            *self._matrices,
            self._inverse,
            np.array([settings.sample_period, settings.critic_gain, settings.actor_gain]),
            self.critic,
            self.actor,
            self._excitation,
        )
