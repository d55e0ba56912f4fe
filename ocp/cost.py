"""The running cost L(x, u) = W(x) + (u - u_g)' R (u - u_g), written once in CasADi.

W(x) = goal Q(x) + (x - x_g)' M (x - x_g) + obstacle sum_k phi_k(x)   (Xu and Zhu, section IV-A)

and what a user's own function adds. u_g holds the robot at rest in the goal's equilibrium, if that
is the goal; else it is 0. In periodic coordinates the quadratic term is made periodic, see
`quadratic_cost`.

Q(x)     = max(2 / (1 + exp(-a (|p - p_g|^2 - r_g^2))) - 1, 0) = max(tanh(a (...) / 2), 0)
phi_k(x) = exp(-b r_k^2 (g_k(p)^2 - 1)),   g_k the gauge of obstacle k

For circles and diamonds phi_k is the paper's exp(-b (|p - c|_m^2 - r^2)) with the 2- and 1-norm.
Every function takes CasADi symbols or numbers, so that one definition serves IPOPT (constants) and
the compiled kernels (parameters).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Expression = ca.SX | ca.DM


@dataclass(frozen=True)
class RunningCost:
    """Weights of the running cost; the defaults are the paper's.

    Attributes:
        input: diagonal of R, one positive weight an input; `None` means all 1.
        goal: weight of Q.
        goal_steepness: a, 1/m^2.
        obstacle: weight of the obstacle penalties.
        obstacle_steepness: b, 1/m^2.
        state: M, `n` rows of `n` numbers, symmetric positive semidefinite; `None` means 0.
            x_g is the goal's equilibrium, or has the goal's centre in its position coordinates and
            0 elsewhere.
        own: one's own cost, a CasADi function x `n x 1` -> cost >= 0 with two derivatives, added to
            W. It is kept as text, so that queries compare and travel; no file can hold it.
    """

    input: tuple[float, ...] | None = None
    goal: float = 1.0
    goal_steepness: float = 3.0
    obstacle: float = 1.0
    obstacle_steepness: float = 4.0
    state: tuple[tuple[float, ...], ...] | None = None
    own: "str | ca.Function" = ""

    def __post_init__(self) -> None:
        if isinstance(self.own, ca.Function):
            object.__setattr__(self, "own", self.own.serialize())

    def check(self, n: int, m: int) -> None:
        """Raise ValueError, naming the field, unless the weights fit `n` states, `m` inputs."""
        for name in ("goal", "goal_steepness", "obstacle", "obstacle_steepness"):
            number = getattr(self, name)
            if not (np.isfinite(number) and number >= 0):
                raise ValueError(f"cost.{name}: must be a finite number >= 0, got {number}")
        if self.input is not None and (
            len(self.input) != m or not all(np.isfinite(w) and w > 0 for w in self.input)
        ):
            raise ValueError(
                f"cost.input: needs {m} positive finite weights, got {list(self.input)}"
            )
        if self.state is not None:
            M = np.array([list(row) for row in self.state], dtype=float)
            if M.shape != (n, n) or not np.isfinite(M).all() or not np.allclose(M, M.T):
                raise ValueError(f"cost.state: must be a symmetric {n} x {n} matrix")
            if np.linalg.eigvalsh(M).min() < -1e-12 * max(1.0, abs(M).max()):
                raise ValueError("cost.state: must be positive semidefinite")
        if self.own:
            function = own_cost(self.own)
            shapes = [function.size_in(i) for i in range(function.n_in())]
            shapes += [function.size_out(i) for i in range(function.n_out())]
            if shapes != [(n, 1), (1, 1)] or not function.is_a("SXFunction"):
                raise ValueError(
                    f"cost.own: must be an SX function of a {n} x 1 state to one number, got "
                    f"{function}"
                )


@lru_cache(maxsize=64)
def own_cost(text: str) -> ca.Function:
    """The function kept in `RunningCost.own`."""
    return ca.Function.deserialize(text)


def goal_cost(position: Expression, center: Expression, radius, weight, steepness) -> ca.SX:
    """goal Q(x): 0 in the goal ball, rising to `weight` far from it."""
    excess = ca.sumsqr(position - center) - radius**2
    return weight * ca.fmax(ca.tanh(steepness * excess / 2), 0)


def quadratic_cost(
    state: Expression, reference: Expression, matrix: Expression, period: NDArray[np.float64]
) -> ca.SX:
    """(x - x_g)' M (x - x_g), made periodic in the coordinates with a `period` `[n]` that is not 0.

    There, with a = x_i - x_gi in units where the period is 2 pi, s = sin a takes the place of a,
    and M_ii (4 sin^2(a / 2) - s^2) >= 0 is added: the square of the chord, which is largest half a
    period away. Near the goal both are the quadratic form, to second order.
    """
    moved = state - reference
    if not period.any():
        return ca.bilin(matrix, moved, moved)
    total, parts = ca.SX(0), []
    for i, p in enumerate(period):
        if p == 0:
            parts.append(moved[i])
            continue
        scale = float(p) / (2 * np.pi)
        angle = moved[i] / scale
        parts.append(scale * ca.sin(angle))
        total += matrix[i, i] * (4 * scale**2 * ca.sin(angle / 2) ** 2 - parts[-1] ** 2)
    wrapped = ca.vertcat(*parts)
    return ca.bilin(matrix, wrapped, wrapped) + total


def circle_penalty(distance_squared, radius, weight, steepness, exp: Callable[..., Any]) -> Any:
    """phi of a circle at a squared distance from its centre, in symbols or arrays: `exp` is theirs.

    Its derivative by the squared distance is -steepness phi.
    """
    return weight * exp(-steepness * (distance_squared - radius**2))


def ball_penalty(position: Expression, center: Expression, radius, weight, steepness) -> ca.SX:
    """phi of a circle: 1 on its boundary, exp(b r^2) at its centre."""
    return circle_penalty(ca.sumsqr(position - center), radius, weight, steepness, ca.exp)


def facet_penalty(
    position: Expression, center: Expression, facet: Expression, radius, weight, steepness
) -> ca.SX:
    """phi of a polygon where `facet` (the row a of `Obstacle.facets`) attains the gauge."""
    gauge = ca.dot(facet, position - center)
    return weight * ca.exp(-steepness * radius**2 * (gauge**2 - 1))


def polygon_penalty(
    position: Expression, center: Expression, facets: Expression, radius, weight, steepness
) -> ca.SX:
    """phi of a polygon with `facets` `[k, 2]`: the gauge is the largest facet's."""
    gauge = ca.mmax(facets @ (position - center))
    return weight * ca.exp(-steepness * radius**2 * (gauge**2 - 1))
