"""One extremal from a guess: multiple shooting, then every claim checked again.

Pontryagin: along an optimal motion z = [x, p] follows the flow of the minimised Hamiltonian, ends
on the terminal manifold (transversality.py), and H = 0 if the final time is free.
"""

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ocp.extremals.first_iterate import first_nodes, with_costates
from ocp.extremals.hamiltonian_flow import flow_layout
from ocp.extremals.second_look import SecondLook, look_again
from ocp.extremals.shooting import (
    BROKEN,
    CONVERGED,
    DAMPED_OUT,
    SINGULAR,
    shoot,
    shooting_addresses,
)
from ocp.extremals.transversality import NEGLIGIBLE, Condition, goal_condition
from ocp.extremals.warm_start import until_goal
from ocp.kernels import parameters
from ocp.query import Query
from ocp.trajectory import Status, Trajectory

Array = NDArray[np.float64]

SEGMENTS = 24
REFINEMENTS = 2  # how often segments are halved where a converged answer is not accurate enough
SAMPLES = 8  # points of the answer in each segment
MAX_GAP = 1e-5  # between both integrations, over one segment and its growth of errors
MAX_HAMILTONIAN = 1e-6  # |H| allowed where it should be 0, relative to the largest W
MAX_DEPTH = 1e-9  # inside the goal before the end, relative to its radius
LEAST_DAMPING = 1e-3

WHY = {
    DAMPED_OUT: "the Newton iteration stalled",
    SINGULAR: "the linearised problem is singular",
    BROKEN: "an iterate could not be integrated",
}


@dataclass(frozen=True)
class Precision:
    """How exactly an extremal is solved for; all tolerances are relative to 1 + size.

    Attributes:
        newton: of the last Newton correction; the answer's error is its square.
        step: of a step of the integration.
        check: of a step of the second integration, which the answer's cost comes from.
        iterations: the most of Newton's method.
    """

    newton: float = 1e-7
    step: float = 1e-8
    check: float = 1e-11
    iterations: int = 40


EXACT = Precision()


@dataclass(frozen=True)
class Extremal:
    """How a solve ended, and what it found.

    Attributes:
        status: SOLVED only if every check passed.
        detail: why not, or empty.
        iterations: of Newton's method.
        seconds: spent in them.
        trajectory: with costates; `None` unless solved.
        tangents: `[segments, 2n, n]`, of the field of extremals where the segments begin; `None`
            unless solved.
        bounds_active: whether the input touches a bound somewhere. The flow is then only once
            differentiable there, and the extremal as valid.
    """

    status: Status
    detail: str = ""
    iterations: int = 0
    seconds: float = 0.0
    trajectory: Trajectory | None = None
    tangents: Array | None = None
    bounds_active: bool = False

    @property
    def cost(self) -> float:
        """Cost of the motion; infinite unless solved."""
        return np.inf if self.trajectory is None else self.trajectory.cost

    @cached_property
    def hessians(self) -> Array | None:
        """Second derivatives of V `[segments, n, n]` where the segments begin, at every
        `SAMPLES`-th point of the trajectory but the last (on the goal's boundary there are none).

        `None` unless solved.
        """
        if self.tangents is None:
            return None
        n = self.tangents.shape[2]
        turned = self.tangents.transpose(0, 2, 1)
        hessians = np.linalg.solve(turned[:, :, :n], turned[:, :, n:])
        return (hessians + hessians.transpose(0, 2, 1)) / 2

    @property
    def hessian(self) -> Array | None:
        """Second derivatives of V `[n, n]` at the start; `None` unless solved."""
        return None if self.hessians is None else self.hessians[0]


def find_extremal(
    query: Query,
    start: Array,
    guess: Trajectory,
    condition: Condition | None = None,
    *,
    segments: int = SEGMENTS,
    precision: Precision = EXACT,
) -> Extremal:
    """The extremal near `guess`; never raises for want of convergence.

    Args:
        query: the query.
        start: `[n]`; not checked.
        guess: a motion from near `start` to near the goal (or lasting the fixed time).
        condition: the end's; by default the goal's.
        segments: of multiple shooting.
        precision: of the answer.
    """
    condition = condition or goal_condition(query)
    start = np.ascontiguousarray(start, dtype=float)
    if condition.at_goal:
        guess = until_goal(query, guess)
    guess = with_costates(query, guess)
    shot = _shoot(query, condition, start, guess, segments, precision)
    iterations, seconds = shot.iterations, shot.seconds
    for _ in range(REFINEMENTS):
        if shot.motion is None or not shot.detail:
            break
        segments *= 2
        shot = _shoot(query, condition, start, shot.motion, segments, precision)
        iterations, seconds = iterations + shot.iterations, seconds + shot.seconds
    if shot.motion is None or shot.detail:
        return Extremal(Status.NOT_CONVERGED, shot.detail, iterations, seconds)
    status, detail = _verdict(query, condition, shot.motion, shot.basis)
    if status is not Status.SOLVED:
        return Extremal(status, detail, iterations, seconds)
    active = False
    if query.is_bounded:
        lower, upper = query.input_bounds
        active = bool(((shot.motion.inputs <= lower) | (shot.motion.inputs >= upper)).any())
    return Extremal(status, "", iterations, seconds, shot.motion, shot.basis[:-1, :-1], active)


@dataclass(frozen=True)
class _Shot:
    """A Newton solve: `motion` if it converged; `detail` says what is wrong, if anything is."""

    iterations: int
    seconds: float
    detail: str
    motion: Trajectory | None
    basis: Array


def _shoot(
    query: Query,
    condition: Condition,
    start: Array,
    guess: Trajectory,
    segments: int,
    precision: Precision,
) -> _Shot:
    n = query.system.n
    fractions, nodes = first_nodes(guess, segments)
    end = guess.states[-1].copy()
    basis = np.zeros((segments + 1, 2 * n + 1, n))
    functions, q, layout = shooting_addresses(query), parameters(query), flow_layout(query)
    # Near the goal costates and costs are small themselves.
    small = min(max(guess.cost, 1e-5), 1.0) if condition.at_goal else 1.0
    settings = np.array(
        [small * precision.newton, small * precision.step, precision.iterations, LEAST_DAMPING]
    )
    begun = time.perf_counter()
    ended, iterations, duration, _ = shoot(
        condition.kind, condition.at_goal, functions, q, layout, condition.terms, settings,
        start, fractions, nodes, end, guess.duration, basis,
    )  # fmt: skip
    seconds = time.perf_counter() - begun
    if ended != CONVERGED:
        detail = WHY.get(ended, f"no convergence in {iterations} iterations")
        return _Shot(iterations, seconds, detail, None, basis)
    nodes[0, :n] = start
    look = look_again(query, fractions, nodes, duration, SAMPLES, small * precision.check)
    if not look.gap < np.inf:
        return _Shot(iterations, seconds, "the answer could not be integrated again", None, basis)
    detail = ""
    off, allowed = _hamiltonian_error(condition, look)
    if not look.gap <= MAX_GAP:
        detail = f"integrated again, nodes are missed by {look.gap:.1e}"
    elif not off <= allowed:
        detail = f"the Hamiltonian is off by {off:.1e}"
    return _Shot(iterations, seconds, detail, look.motion, basis)


def _hamiltonian_error(condition: Condition, look: SecondLook) -> tuple[float, float]:
    """By how much H is off along a motion (0 at the goal, else constant), and the error allowed."""
    constant = 0.0 if condition.at_goal else look.hamiltonians[0]
    size = look.costs.max() + np.abs(look.hamiltonians - look.costs).max()
    off = np.abs(look.hamiltonians - constant).max()
    return float(off), float(MAX_HAMILTONIAN * size + NEGLIGIBLE)


def _verdict(
    query: Query, condition: Condition, motion: Trajectory, basis: Array
) -> tuple[Status, str]:
    """Whether the extremal is what was asked for, and a local minimum."""
    x = motion.states
    if condition.at_goal and -query.goal_distance(x[:-1]).min() > MAX_DEPTH * query.goal.radius:
        return Status.WRONG_EXTREMAL, "it crosses the goal before it ends"
    n = query.system.n
    signs = np.sign(np.linalg.det(basis[:-1, :n]))
    if (signs != signs[0]).any():
        return Status.WRONG_EXTREMAL, "it has a conjugate point, so it is no local minimum"
    if query.hard_obstacles:
        clearance = query.clearance(x, hard_only=True)
        steps = np.linalg.norm(np.diff(query.position(x), axis=0), axis=1)
        if not (np.minimum(clearance[1:], clearance[:-1]) > steps / 2).all():
            return Status.NOT_APPLICABLE, "it touches a hard obstacle, or nearly"
    return Status.SOLVED, ""
