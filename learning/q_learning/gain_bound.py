"""The paper's bound (25) on the actor's gain, evaluated."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from learning.q_learning.quadratic_cost import QuadraticCost


@dataclass(frozen=True)
class GainBound:
    """The bound (25) on alpha_a, evaluated.

    The printed dimensions clash (mu is n x n, R^-1 is m x m, their product is not defined): the
    largest eigenvalues are taken apart and multiplied. delta, "of unity order", is 1.

    Attributes:
        bound: the right-hand side; no positive alpha_a is admissible where it is not positive.
        actor_gain: alpha_a as used.
    """

    bound: float
    actor_gain: float

    @property
    def is_admissible(self) -> bool:
        return 0 < self.actor_gain < self.bound

    def __str__(self) -> str:
        if self.is_admissible:
            return f"alpha_a = {self.actor_gain:g} is below the bound (25), {self.bound:.3g}"
        if self.bound <= 0:
            return f"the bound (25) is {self.bound:.3g}: no alpha_a is admissible"
        return f"alpha_a = {self.actor_gain:g} violates the bound (25), {self.bound:.3g}"


def gain_bound(
    cost: QuadraticCost, Q_xu: ArrayLike, time_value: float, actor_gain: float
) -> GainBound:
    """(25) for Q_xu `[n, m]` and mu(t) = `time_value` I."""
    Q = np.asarray(Q_xu, dtype=float)
    inverse = np.linalg.inv(cost.R)
    least = float(np.linalg.eigvalsh(cost.M + Q @ inverse @ Q.T).min())
    largest = float(np.linalg.eigvalsh(Q @ Q.T).max())
    below = time_value * float(np.linalg.eigvalsh(inverse).max()) / (1.0 + time_value**2) ** 2
    return GainBound((2.0 * least - largest) / below, actor_gain)
