"""The oracle: one question to every exact method, and where they disagree.

An optimal cost counts as truth (`established`) only when two independent methods found it to
`TRUTH_TOLERANCE` and no method, homotopy class or guess found a cheaper one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.closed_form import straight_value
from ocp.collocation import solve_collocation
from ocp.extremals.extremal import find_extremal
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.riccati import LinearQuadratic, algebraic_riccati
from ocp.trajectory import SolveError, Status, Trajectory

TRUTH_TOLERANCE = 1e-4
METHODS = ("closed form", "PMP", "collocation", "collocation from PMP", "Riccati", "grid")
"""Collocation is asked twice: from its own guesses, and from the motion that PMP found. Where the
goal is an equilibrium, PMP starts from collocation's answer, Riccati answers for linear robots, and
the grid, which is a few per cent off, where it is asked for and the dimension allows."""


@dataclass(frozen=True)
class Answer:
    """What one method says about one state.

    Attributes:
        value: the optimal cost; `None` without an answer.
        motion: the optimal motion; `None` without an answer, and for the closed form.
        status: how the solve ended.
        detail: why there is no answer.
    """

    value: float | None
    motion: Trajectory | None
    status: Status = Status.SOLVED
    detail: str = ""

    @property
    def gradient(self) -> NDArray[np.float64] | None:
        """The costate `[n]` at the state."""
        return (
            None if self.motion is None or self.motion.costates is None else self.motion.costates[0]
        )

    @property
    def input(self) -> NDArray[np.float64] | None:
        """The optimal input `[m]` at the state."""
        return None if self.motion is None else self.motion.inputs[0]


@dataclass(frozen=True)
class Verdict:
    """What all methods say about one state.

    Attributes:
        state: `[n]`.
        answers: by the name of the method, see `METHODS`.
    """

    state: NDArray[np.float64]
    answers: dict[str, Answer]

    @property
    def value(self) -> float | None:
        """The least cost that any method found."""
        return min((a.value for a in self.answers.values() if a.value is not None), default=None)

    @property
    def best(self) -> Trajectory | None:
        """The cheapest motion that any method found; PMP's if it is as cheap as any."""
        motions = [a.motion for a in self.answers.values() if a.motion is not None]
        if not motions:
            return None
        least = min(m.cost for m in motions)
        return next(m for m in motions if m.cost <= least * (1 + TRUTH_TOLERANCE) + 1e-12)

    @property
    def spread(self) -> dict[str, float]:
        """By how much each method's cost exceeds the least, as a fraction of it."""
        least = self.value
        if least is None:
            return {}
        scale = max(least, 1e-12)
        return {
            name: (a.value - least) / scale
            for name, a in self.answers.items()
            if a.value is not None
        }

    @property
    def established(self) -> bool:
        """Whether the least cost counts as truth: two independent methods found it."""
        found = {name for name, gap in self.spread.items() if gap <= TRUTH_TOLERANCE}
        independent = {"collocation" if n.startswith("collocation") else n for n in found}
        return len(independent) >= 2

    def disagreements(self, tolerance: float = TRUTH_TOLERANCE) -> dict[str, float]:
        """The methods whose cost exceeds the least by more than `tolerance`, and by how much."""
        return {name: gap for name, gap in self.spread.items() if gap > tolerance}

    @property
    def explanation(self) -> str:
        """Why the cost does not count as truth, or that it does."""
        if self.established:
            return "established"
        gaps = ", ".join(f"{name} +{gap:.2e}" for name, gap in self.spread.items())
        failures = "; ".join(
            f"{name}: {a.status.value} {a.detail}".strip()
            for name, a in self.answers.items()
            if a.value is None and a.status is not Status.NOT_APPLICABLE
        )
        if len(self.spread) == 1:
            (only,) = self.spread
            return f"only {only} has an answer, which no second method confirms" + (
                f": {failures}" if failures else ""
            )
        return "no two methods agree on the least cost: " + "; ".join(
            filter(None, (gaps, failures))
        )


def consult(query: Query, state: ArrayLike, with_grid: bool = False) -> Verdict:
    """Ask every exact method that applies about V at `state` `[n]`.

    Args:
        query: the query.
        state: in the domain, outside hard obstacles.
        with_grid: ask value iteration too, where the goal is an equilibrium.

    Raises:
        ValueError: if the state does not fit the query.

    Example:
        >>> from ocp.query_family import PAPER_START, paper_query
        >>> verdict = consult(paper_query((1.0, 1.0)), PAPER_START)
        >>> verdict.established, round(verdict.value, 4)
        (True, 15.5772)
    """
    start = query.check_start(state)
    if query.is_regulation:
        return Verdict(start, _of_regulation(query, start, with_grid))
    answers: dict[str, Answer] = {}
    try:
        answers["closed form"] = Answer(straight_value(query, start), None)
    except SolveError as error:
        answers["closed form"] = _failed(error)
    answers["PMP"] = _answer(lambda: _extremal(query, start))
    answers["collocation"] = _answer(lambda: solve_collocation(query, start))
    guess = answers["PMP"].motion
    if guess is not None:
        answers["collocation from PMP"] = _answer(
            lambda: solve_collocation(query, start, guess=guess)
        )
    return Verdict(start, answers)


def _of_regulation(query: Query, start: NDArray[np.float64], with_grid: bool) -> dict[str, Answer]:
    """The answers where the goal is an equilibrium."""
    from ocp.regulation import pmp_regulation, solve_regulation

    answers: dict[str, Answer] = {}
    try:
        problem = LinearQuadratic.of_query(query)
        answers["Riccati"] = Answer(float(algebraic_riccati(problem).value(start)), None)
    except SolveError as error:
        answers["Riccati"] = _failed(error)
    answers["collocation"] = _answer(lambda: solve_regulation(query, start))
    direct = answers["collocation"].motion
    if direct is not None:
        answers["PMP"] = _answer(lambda: pmp_regulation(query, direct))
    if with_grid:
        from ocp.grids.regulation_grid import solve_regulation_grid

        try:
            value = float(solve_regulation_grid(query).value(start))
            answers["grid"] = Answer(value, None)
        except SolveError as error:
            answers["grid"] = _failed(error)
    return answers


def _extremal(query: Query, start: NDArray[np.float64]) -> Trajectory:
    """The cheapest motion found, if it is an extremal: some answers are collocation's own."""
    motion = exact_trajectory(query, start)
    if motion.duration == 0:
        return motion
    extremal = find_extremal(query, start, motion)
    if extremal.trajectory is None:
        raise SolveError(extremal.status, extremal.detail)
    return extremal.trajectory


def _answer(solve: Callable[[], Trajectory]) -> Answer:
    try:
        motion = solve()
    except SolveError as error:
        return _failed(error)
    return Answer(motion.cost, motion)


def _failed(error: SolveError) -> Answer:
    return Answer(None, None, error.status, str(error))
