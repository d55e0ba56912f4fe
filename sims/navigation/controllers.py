"""The controllers that drive legs: they satisfy `planners.leg_controller.LegController`.

All but `ExactController` know nothing of the plant; what the simulator tells them (how hard to
probe, what holds the robot where it stands) is what a driver would know.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.certificate import Certificate
from learning.q_learning.learned_regulator import LearnedRegulator
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.paper_law import LITERAL, REPAIRED, PaperLaw, PaperSettings
from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.riccati import LinearQuadratic, differential_riccati
from planners.leg_controller import LegController
from sims.navigation.plants import Plant
from sims.regulation.simulation import LinearPlant

Array = NDArray[np.float64]

CONTROLLERS = ("q-learning", "paper-literal", "paper-repaired", "riccati", "open-loop")
SUBSTEPS = 4
"""States measured a sample period while learning, for the order of its integrals."""
LOOK_EVERY = 5
"""Holds between two looks at the certificate."""
PAPER_STEP = 0.005
"""Seconds, of the repaired law's Euler steps."""
AT_REST = 0.01
"""A forecast ends when this share of the error is left."""


class Driver(LegController, Protocol):
    """A leg controller as the simulator runs it."""

    @property
    def substeps(self) -> int:
        """How often a sample period `control` is called."""
        ...

    def feedforward(self, reference: Array) -> Array:
        """The input `[m]` that holds the robot at the reference `[n]`, added to `control`."""
        ...


class ClosedLoop:
    """x' = A x + B u under u = -K(t) x, the input held for a period: what it will do."""

    def __init__(self, A: Array, B: Array, gains: Array, period: float, dimension: int) -> None:
        """`gains` `[k, m, n]`, one a period from the leg's beginning to its horizon."""
        F, G, _ = LinearPlant(A, B).held_step(period)
        self._receding = _positions([F - G @ gains[0]] * len(gains), dimension)
        self._fixed = _positions([F - G @ K for K in gains], dimension)

    def forecast(self, errors: Array, receding: bool) -> Array:
        """Positions `[c, k, d]` relative to the reference, from errors `[c, n]`."""
        table = self._receding if receding else self._fixed
        return np.einsum("kdn,cn->ckd", table, errors)


def _positions(steps: list[Array], dimension: int) -> Array:
    """`[k, d, n]`, what takes an error to the positions a sample a period, up to rest."""
    motion = np.eye(len(steps[0]))
    table = [motion[:dimension]]
    for step in steps:
        motion = step @ motion
        table.append(motion[:dimension])
        if np.abs(motion[:dimension]).max() < AT_REST:
            break
    return np.array(table)


class ExactController:
    """The optimal regulator of the true plant: the differential Riccati equation."""

    substeps = 1
    ready = True

    def __init__(self, plant: Plant, cost: QuadraticCost, period: float) -> None:
        problem = LinearQuadratic(plant.A, plant.B, cost.M, cost.R)
        exact = differential_riccati(problem, cost.terminal, cost.horizon)
        self.gains = exact.gain(sample_times(cost.horizon, period))
        self._plant = plant
        self._loop = ClosedLoop(plant.A, plant.B, self.gains, period, plant.dimension)
        self._samples = 0

    def new_leg(self) -> None:
        self._samples = 0

    def control(self, error: Array) -> Array:
        gain = self.gains[min(self._samples, len(self.gains) - 1)]
        self._samples += 1
        return -gain @ error

    def feedforward(self, reference: Array) -> Array:
        return self._plant.holding_input(reference)

    def forecast(self, errors: Array, receding: bool) -> Array | None:
        return self._loop.forecast(errors, receding)


class LearningController:
    """Q-learning that converges: probes where the robot stands, then regulates as certified.

    It is handed states (or errors) `SUBSTEPS` times a sample period while it probes and remembers
    its own inputs. The learned map holds the closed loop: the columns of Theta that belong to the
    squares x_i^2 have the rates 2 x_i x_i' as rows, from which forecasts are made.
    """

    substeps = SUBSTEPS

    def __init__(
        self,
        cost: QuadraticCost,
        period: float,
        dimension: int,
        anchored: bool,
        probing: float,
        behaviour_gain: Array,
        holding: Array,
        rng: np.random.Generator,
    ) -> None:
        """See `Plant` for most of the arguments.

        Args:
            holding: `[m]`, the input that holds the robot where it stands: it stands there.
        """
        self.learner = QLearner(
            cost, LearnerSettings(sample_period=period / SUBSTEPS, substeps=SUBSTEPS)
        )
        self.certificate: Certificate | None = None
        self.gains = np.zeros((0, cost.m, cost.n))
        self._cost, self._period, self._dimension = cost, period, dimension
        self._anchored, self._probing, self._holding = anchored, probing, holding
        self._behaviour, self._rng = behaviour_gain, rng
        self._reference = np.zeros(cost.n)
        self._hold: list[Array] = []
        self._held = np.zeros(cost.m)
        self._calls, self._samples = 0, 0
        self._model: tuple[Array, Array] | None = None
        self._loop: ClosedLoop | None = None

    @property
    def ready(self) -> bool:
        return self._loop is not None

    def new_leg(self) -> None:
        self._samples = 0

    def feedforward(self, reference: Array) -> Array:
        self._reference = reference
        if self._anchored:
            return np.zeros(self._cost.m)
        if self._model is None:
            return self._holding
        A, B = self._model
        return np.asarray(-np.linalg.lstsq(B, A @ reference, rcond=None)[0], float)

    def control(self, error: Array) -> Array:
        begins = self._calls % SUBSTEPS == 0
        self._calls += 1
        if self._loop is None:
            self._measure(error)
        if not begins:
            return self._held
        if self._loop is None:
            noise = self._rng.standard_normal(self._cost.m)
            self._held = self._probing * noise - self._behaviour @ error
        else:
            self._held = -self.gains[min(self._samples, len(self.gains) - 1)] @ error
            self._samples += 1
        return self._held

    def forecast(self, errors: Array, receding: bool) -> Array | None:
        return None if self._loop is None else self._loop.forecast(errors, receding)

    def _measure(self, error: Array) -> None:
        """Gather a hold's states; at its end learn from it, and look whether it is enough."""
        # An anchored plant acts on the error; the others on the state itself.
        self._hold.append(error if self._anchored else error + self._reference)
        if len(self._hold) <= SUBSTEPS:
            return
        total = self._held if self._anchored else self._held + self._holding
        self.learner.absorb(np.array(self._hold), total[None])
        self._hold = self._hold[-1:]
        data = self.learner.data
        if data.rows >= data.p and data.rows % LOOK_EVERY == 0:
            self.certificate = self.learner.certify()
            if self.certificate.holds and self.learner.regulator is not None:
                self._learned(self.learner.regulator)

    def _learned(self, regulator: LearnedRegulator) -> None:
        times = sample_times(self._cost.horizon, self._period)
        self.gains = regulator.gain(times)
        self._model = A, B = closed_loop_of(regulator)
        self._loop = ClosedLoop(A, B, self.gains, self._period, self._dimension)


class PaperController:
    """The paper's law, literal or repaired; it can foretell nothing."""

    ready = True

    def __init__(self, cost: QuadraticCost, period: float, literal: bool, rng: np.random.Generator):
        self.substeps = 1 if literal else max(1, round(period / PAPER_STEP))
        settings = PaperSettings(sample_period=period / self.substeps, resolution=period)
        self.law = PaperLaw(cost, settings, rng, LITERAL if literal else REPAIRED)
        self._m = cost.m

    def new_leg(self) -> None:
        self.law.new_leg()

    def control(self, error: Array) -> Array:
        return self.law.control(error)

    def feedforward(self, reference: Array) -> Array:  # noqa: ARG002
        return np.zeros(self._m)

    def forecast(self, errors: Array, receding: bool) -> Array | None:  # noqa: ARG002
        return None


class OpenLoop:
    """u = 0."""

    substeps = 1
    ready = True

    def __init__(self, m: int) -> None:
        self._m = m

    def new_leg(self) -> None:
        return

    def control(self, error: Array) -> Array:  # noqa: ARG002
        return np.zeros(self._m)

    def feedforward(self, reference: Array) -> Array:  # noqa: ARG002
        return np.zeros(self._m)

    def forecast(self, errors: Array, receding: bool) -> Array | None:  # noqa: ARG002
        return None


def make_controller(
    name: str,
    plant: Plant,
    cost: QuadraticCost,
    period: float,
    start: Array,
    rng: np.random.Generator,
) -> Driver:
    """The controller of this name (see `CONTROLLERS`) for a robot that stands at `start` `[n]`.

    Raises:
        ValueError: if there is none.
    """
    if name == "q-learning":
        return LearningController(
            cost,
            period,
            plant.dimension,
            plant.anchored,
            plant.probing,
            plant.behaviour_gain,
            plant.holding_input(start),
            rng,
        )
    if name == "riccati":
        return ExactController(plant, cost, period)
    if name in ("paper-literal", "paper-repaired"):
        return PaperController(cost, period, name == "paper-literal", rng)
    if name == "open-loop":
        return OpenLoop(plant.m)
    raise ValueError(f"controller: {name!r} is unknown; known are {', '.join(CONTROLLERS)}")


def closed_loop_of(regulator: LearnedRegulator) -> tuple[Array, Array]:
    """A `[n, n]` and B `[n, m]` as they stand in the learned map.

    Theta maps the coefficients of x'Px to those of its rate. Of x_i^2 the rate is 2 x_i times row i
    of A x + B u: the column of Theta' that belongs to x_i^2 holds that row.
    """
    n, m = regulator.cost.n, regulator.cost.m
    theta = regulator.theta
    rows, columns = np.triu_indices(n)
    place = np.zeros((n, n), dtype=int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    q = len(rows)
    A, B = np.empty((n, n)), np.empty((n, m))
    for i in range(n):
        square = place[i, i]
        A[i] = 0.5 * theta[place[i], square]
        B[i] = 0.5 * theta[q + np.arange(m) * n + i, square]
    return A, B


def sample_times(horizon: float, period: float) -> Array:
    """The samples of a leg, from 0 to its horizon."""
    return np.asarray(period * np.arange(round(horizon / period) + 1), float)
