"""The actor-critic law of Kontoudis, Xu and Vamvoudakis (RRT-Q^X, 2022), kept as a baseline.

`PaperLaw` is (12)-(16), (19)-(25) with a set of `Slip`s left in: all of them make the law as
printed (`LITERAL`), none the repaired one (`REPAIRED`). Neither was seen to converge to the optimal
gain on any plant: regulate with `q_learning`. `docs/q-learning-slips.md` shows what each slip does.

Symbols of the paper, here and in the kernels:

    x-bar   `x` `[n]`, the state measured from the waypoint      U    [x; u] `[n + m]`
    u-hat   `u` `[m]`, the input                                 W_c  `critic` `[c]`, c = N(N+1)/2
    W_a     `actor` `[n, m]`                                     N    n + m
    nu, mu  a scalar function of time times the identity         alpha_c, alpha_a  the two gains
    Delta t `resolution`                                         T    `cost.horizon`
    sigma, sigma_f, e_c1, e_c2, e_a, P(T), M, R                  as in the paper

Entries of W_c come in the order that (24) indexes: the products x_i x_j (i <= j), u_k x_i (k by k),
u_k u_l (k <= l). Costs carry the paper's one half.

Choices that the print leaves open, the same in both forms: U (x) U stands for its N(N+1)/2 distinct
products, as `vech` needs (the print has N^2); nu and mu are one Gaussian of time; the integral in
(19) is taken by the trapezoid rule on the samples; the flows (22), (23) by Euler steps; the weights
of Q_uu, which (14) inverts and which the paper wants "non-zero", begin at R.
"""

from dataclasses import dataclass
from enum import Enum
from time import thread_time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.gain_bound import GainBound, gain_bound
from learning.q_learning.paper_law_kernels import (
    ASCENT,
    ESTIMATED_QUU,
    HALF_VECH,
    PLAIN_ACTOR,
    TERMINAL_EVERYWHERE,
    paper_step,
)
from learning.q_learning.quadratic_cost import QuadraticCost

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


class Slip(Enum):
    """A slip of the print that a law can keep; the text is the printed form, then the repair."""

    ASCENT = (
        "(22): the second term climbs, since de_c2/dW_c = -sigma_f",
        "its sign is turned",
    )
    DELAYED_TIME = (
        "(19): nu(t - T) on e_c1's delayed term, and nu(t) on sigma's",
        "nu(t - Delta t) on both",
    )
    TERMINAL_EVERYWHERE = (
        "e_c2 holds at T alone but is used at every t, with the present x and u",
        "imposed with nu(T) on remembered states x, at the optimal input there: "
        "x'P_T x/2 = W_c' nu(T) z(x, -R^-1 Q_ux(T) x)",
    )
    PLAIN_ACTOR = (
        "(23) lacks mu and (24)'s normalisation: Euler needs step alpha_a |x|^2 < 2",
        "dW_a/dt = -alpha_a mu x e_a' / (1 + |mu x|^2)",
    )
    HALF_VECH = (
        "nu' W_c = vech(Q)/2: off-diagonal entries count half of what U'QU asks for",
        "c_ii = Q_ii/2, c_ij = Q_ij",
    )
    ESTIMATED_QUU = (
        "Q_uu is estimated by the critic and inverted",
        "Q_uu = R, which is known",
    )
    COARSE_STEP = (
        "Euler steps of the resolution, Delta t = 50 ms",
        "Euler steps of the sample period, 5 ms",
    )

    @property
    def printed(self) -> str:
        return self.value[0]

    @property
    def repair(self) -> str:
        return self.value[1]


LITERAL = frozenset(Slip)
REPAIRED: frozenset[Slip] = frozenset()

_IN_KERNEL = {
    Slip.ASCENT: ASCENT,
    Slip.TERMINAL_EVERYWHERE: TERMINAL_EVERYWHERE,
    Slip.PLAIN_ACTOR: PLAIN_ACTOR,
    Slip.HALF_VECH: HALF_VECH,
    Slip.ESTIMATED_QUU: ESTIMATED_QUU,
}


class PaperLaw:
    """The law with the given slips: `control` once a sample, `new_leg` at a waypoint switch.

    Attributes:
        cost: what to minimise.
        settings: gains and open choices.
        slips: those left in.
        critic: W_c `[c]`.
        actor: W_a `[n, m]`.
        clock: seconds since the leg began.
        diverged: a weight left [-DIVERGED, DIVERGED]; the law is then frozen and gives u = 0.
        update_times: seconds of CPU time of each update.
    """

    def __init__(
        self,
        cost: QuadraticCost,
        settings: PaperSettings,
        rng: np.random.Generator,
        slips: frozenset[Slip] = LITERAL,
    ) -> None:
        self.cost, self.settings, self.rng, self.slips = cost, settings, rng, slips
        n, m = cost.n, cost.m
        self._xx, self._xu = n * (n + 1) // 2, n * m
        count = self._xx + self._xu + m * (m + 1) // 2
        self.critic = rng.uniform(0.0, settings.initial, count)
        self.actor = rng.uniform(0.0, settings.initial, (n, m))
        self.clock = 0.0
        self.diverged = False
        self.update_times: list[float] = []
        rows, columns = np.triu_indices(m)
        self._uu_scale = np.where(rows == columns, 2.0, 1.0)
        if Slip.HALF_VECH in slips:
            self._uu_scale = np.full(len(rows), 2.0)
        estimated = Slip.ESTIMATED_QUU in slips
        at_start = float(self.time_function(0.0)) if estimated else 1.0
        self.critic[self._xx + self._xu :] = cost.R[rows, columns] / (self._uu_scale * at_start)
        # The cost's own arrays are read-only, which compiled signatures tell apart.
        self._matrices = cost.M.copy(), cost.R.copy(), cost.terminal.copy()
        self._inverse = np.linalg.inv(cost.R)
        self._flags = np.zeros(len(_IN_KERNEL), dtype=np.bool_)
        self._flags[[_IN_KERNEL[s] for s in slips if s in _IN_KERNEL]] = True
        self._excitation = np.zeros((count, count))
        self._held = np.zeros(m)
        lag = round(settings.resolution / settings.sample_period)
        coarse = Slip.COARSE_STEP in slips
        self._stride = lag if coarse else 1
        self._step_length = settings.resolution if coarse else settings.sample_period
        # U at the steps of [t - Delta t, t], newest last.
        self._past = np.zeros((2 if coarse else lag + 1, n + m))
        self._store_every = 1 if coarse else lag
        self._stored = np.zeros((settings.memory, n))
        self._samples, self._known, self._steps, self._remembered = 0, 0, 0, 0

    @property
    def name(self) -> str:
        names = {LITERAL: "paper-literal", REPAIRED: "paper-repaired"}
        kept = ", ".join(slip.name for slip in Slip if slip in self.slips)
        return names.get(self.slips, f"paper-repaired with {kept}")

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
        scale = 2.0 if Slip.HALF_VECH in self.slips else 1.0
        return scale * float(self.time_function(t)) * block.reshape(self.cost.m, -1).T

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
        self._samples = 0
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
        if self._samples % self._stride == 0:
            self._step(x)
        self._samples += 1
        self.clock += self.settings.sample_period
        weights = max(np.abs(self.critic).max(), np.abs(self.actor).max())
        if not weights < DIVERGED:
            self.diverged = True
            return np.zeros(self.cost.m)
        return self._held

    def _step(self, x: Array) -> None:
        t, settings = self.clock, self.settings
        self._held = float(self.time_function(t)) * self.actor.T @ x
        if settings.probing > 0:
            self._held += settings.probing * self.rng.standard_normal(self.cost.m)
        self._past[:-1] = self._past[1:]
        self._past[-1] = [*x, *self._held]
        self._known = min(self._known + 1, len(self._past))
        if self._known < len(self._past):
            return
        if self._steps % self._store_every == 0:
            self._stored[self._remembered % settings.memory] = x
            self._remembered += 1
        self._steps += 1
        late, horizon = t - settings.resolution, self.cost.horizon
        moments = [t, late, late, horizon]
        if Slip.DELAYED_TIME in self.slips:
            moments = [t, t - horizon, t, horizon]
        begun = thread_time()
        if Slip.ESTIMATED_QUU in self.slips and not self._invert_estimate(t):
            self.diverged = True
            return
        paper_step(
            self._past,
            self._stored[: min(self._remembered, settings.memory)],
            self.time_function(np.array(moments)),
            *self._matrices,
            self._inverse,
            np.array([self._step_length, settings.critic_gain, settings.actor_gain]),
            self._flags,
            self.critic,
            self.actor,
            self._excitation,
        )
        self.update_times.append(thread_time() - begun)

    def _invert_estimate(self, t: float) -> bool:
        """Q_uu^-1 of the critic; False if it has become singular."""
        rows, columns = np.triu_indices(self.cost.m)
        entries = self._uu_scale * self.time_function(t) * self.critic[self._xx + self._xu :]
        block = np.empty((self.cost.m, self.cost.m))
        block[rows, columns] = entries
        block[columns, rows] = entries
        try:
            self._inverse = np.linalg.inv(block)
        except np.linalg.LinAlgError:
            return False
        return bool(np.isfinite(self._inverse).all())
