"""Model-free finite-horizon regulation of a linear robot: the law that converges.

Value iteration in the manner of Bian and Jiang on windows of motion: probe, regress
(`window_regression`), sweep backward (`backward_sweep`), certify (`certificate`), regulate. The
learner is handed measured states and remembers the inputs it gave; nothing else.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.certificate import Certificate, certify
from learning.q_learning.learned_regulator import LearnedRegulator
from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import WindowRegression
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LearnerSettings:
    """How a robot is probed and judged.

    Attributes:
        sample_period: seconds between measured states.
        substeps: samples during which an input is held while probing; the integrals' order follows.
        window: holds a regression window; longer ones average measurement noise.
        probing: standard deviation of the probing input, in the input's unit.
        behaviour_gain: `[m, n]`, u = -K x + probing while learning; must stabilise an unstable
            plant. Zero by default.
        affine: learn the plant's constant term too (a spring away from its rest).
        memory: factor on older information at each window; below 1 a changing plant is followed.
        largest_condition: of the scaled regressors; beyond, they count as rank-deficient.
        accuracy: the largest claimed gain error with which a plant counts as learned.
        probe_throughout: keep probing although the certificate holds, to collect more data.
        check_every: windows between two looks at the certificate.
    """

    sample_period: float = 0.01
    substeps: int = 4
    window: int = 1
    probing: float = 1.0
    behaviour_gain: Array | None = None
    affine: bool = False
    memory: float = 1.0
    largest_condition: float = 1e7
    accuracy: float = 0.1
    probe_throughout: bool = False
    check_every: int = 5

    def __post_init__(self) -> None:
        for name in ("sample_period", "largest_condition", "accuracy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: must be positive and finite, got {value}")
        if not (np.isfinite(self.probing) and self.probing >= 0):
            raise ValueError(f"probing: must be non-negative and finite, got {self.probing}")
        if not 0 < self.memory <= 1:
            raise ValueError(f"memory: must lie in (0, 1], got {self.memory}")
        for name in ("window", "check_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")


@dataclass(eq=False)
class QLearner:
    """Learns while it controls; `control` once a sample, `new_leg` at every waypoint switch.

    States are measured from the waypoint. The learner probes, its input held for a hold at a time,
    and looks at the certificate every few windows. While the certificate holds it regulates with
    the learned K(t), its input renewed every sample. A learner that forgets (`memory` below 1) goes
    on learning, hold by hold, and probes again when the certificate fails: the information has
    faded, or the plant has changed and no longer fits.

    Attributes:
        cost: what to minimise, of the robot's own state.
        settings: how to probe and judge.
        rng: draws the probing.
        certificate: the latest; `None` before the first look.
        regulator: the latest learned regulator, certified or not; `None` before.
        probing: whether the learner is probing now.
        update_times: seconds of CPU time of each regression update.

    Raises:
        ValueError: if a setting does not fit the cost's dimensions.

    Example:
        >>> cost = QuadraticCost(M=[[1.0]], R=[[1.0]], terminal=[[0.0]], horizon=10.0)
        >>> learner, x = QLearner(cost), np.array([1.0])
        >>> for _ in range(200):  # the plant, which it does not know: x' = u
        ...     x = x + learner.settings.sample_period * learner.control(x)
        >>> bool(abs(learner.learned().gain(0.0)[0, 0] - 1.0) < 1e-6)  # K = 1
        True
    """

    cost: QuadraticCost
    settings: LearnerSettings = field(default_factory=LearnerSettings)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    certificate: Certificate | None = None
    regulator: LearnedRegulator | None = None
    probing: bool = True
    update_times: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings, n, m = self.settings, self.cost.n, self.cost.m
        gain = settings.behaviour_gain
        self._gain = np.zeros((m, n)) if gain is None else np.array(gain, dtype=float)
        if self._gain.shape != (m, n) or not np.isfinite(self._gain).all():
            raise ValueError(
                f"behaviour_gain: must be finite and have shape {(m, n)}, got {self._gain.tolist()}"
            )
        self._learned_cost = self.cost.with_constant() if settings.affine else self.cost
        self.data = WindowRegression(
            self._learned_cost.n,
            m,
            settings.sample_period,
            settings.substeps,
            settings.window,
            settings.memory,
        )
        self._hold: list[Array] = []
        self._held = np.zeros(m)
        self._clock = 0.0
        self._checked = 0

    @property
    def clock(self) -> float:
        """Seconds since the leg began."""
        return self._clock

    def control(self, state: ArrayLike) -> Array:
        """The input `[m]` to hold until the next sample, given the state `[n]` measured now.

        Raises:
            ValueError: if the state has a wrong shape or is not finite.
        """
        x = np.asarray(state, dtype=float)
        if x.shape != (self.cost.n,) or not np.isfinite(x).all():
            raise ValueError(f"state: must be {self.cost.n} finite numbers, got {x.tolist()}")
        self._hold.append(x)
        if len(self._hold) == self.settings.substeps + 1:
            self._learn_from_hold()
            self._hold = [x]
        if len(self._hold) == 1:
            self._held = self._next_input(x)
        if not self.probing and self.settings.memory == 1.0:
            self._hold = []
            self.data.interrupt()
        self._clock += self.settings.sample_period
        return self._held

    def new_leg(self) -> None:
        """The state jumps to error coordinates of the next waypoint; the horizon starts anew."""
        self._hold = []
        self._clock = 0.0
        self.data.interrupt()

    def absorb(self, states: ArrayLike, inputs: ArrayLike) -> None:
        """Learn from a recorded stretch: states `[k s + 1, n]`, held inputs `[k, m]`, s substeps.

        The stretch stands alone: no window reaches across its ends.
        """
        self.new_leg()
        self._absorb(np.asarray(states, dtype=float), np.asarray(inputs, dtype=float))
        self.data.interrupt()

    def certify(self) -> Certificate:
        """Look at the data now: updates and returns the certificate, and the regulator."""
        settings = self.settings
        self.certificate, regulator = certify(
            self.data,
            self._learned_cost,
            settings.affine,
            settings.largest_condition,
            settings.accuracy,
        )
        self.regulator = regulator if regulator is not None else self.regulator
        self._checked = self.data.rows
        return self.certificate

    def learned(self) -> LearnedRegulator:
        """The certified regulator.

        Raises:
            SolveError: NOT_CONVERGED, with the reason, if the certificate does not hold.
        """
        certificate = self.certify()
        if not certificate.holds or self.regulator is None:
            raise SolveError(Status.NOT_CONVERGED, certificate.reason)
        return self.regulator

    def _next_input(self, x: Array) -> Array:
        regulating = (
            self.certificate is not None and self.certificate.holds and self.regulator is not None
        )
        self.probing = self.settings.probe_throughout or not regulating
        if self.probing:
            noise = self.rng.standard_normal(self.cost.m)
            return self.settings.probing * noise - self._gain @ x
        assert self.regulator is not None
        return self.regulator.input(x, self._clock)

    def _learn_from_hold(self) -> None:
        self._absorb(np.array(self._hold), self._held[None])
        if self.data.rows - self._checked >= self.settings.check_every:
            self.certify()

    def _absorb(self, states: Array, inputs: Array) -> None:
        if self.settings.affine:
            states = np.column_stack([states, np.ones(len(states))])
        seconds = self.data.absorb(states, inputs)
        self.update_times.append(seconds / max(1, len(inputs)))
