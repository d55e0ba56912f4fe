"""Exact trajectories by Pontryagin's minimum principle, and the value that they make.

`solve_pmp` finds one extremal near a guess. `exact_trajectory` tries every class of motions that it
can think of and keeps the cheapest; that is the truth that other methods are held against.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.collocation import solve_collocation
from ocp.extremals.candidates import candidate_guesses
from ocp.extremals.extremal import Extremal, Precision, find_extremal
from ocp.extremals.warm_start import onward, policy_of, rollouts
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.value import Policy, Value

Array = NDArray[np.float64]

DUPLICATE = 1e-6  # extremals whose costs and costates differ less, relatively, are one
SUSPICIOUS = 1.02  # an extremal that costs so many times a rough motion is not the cheapest
NEARBY = 0.02  # of the domain: so near to a known motion, its rest serves as the guess
REMEMBERED = 256  # motions that an `ExactValue` keeps


def solve_pmp(
    query: Query,
    start: ArrayLike,
    guess: Trajectory | Value | Policy | None = None,
    *,
    segments: int = 24,
    tolerance: float = 1e-7,
    max_iterations: int = 40,
) -> Trajectory:
    """The extremal from `start` `[n]` to the goal near a guess: a local minimum, verified.

    Args:
        query: the query.
        start: a state in the domain, outside hard obstacles.
        guess: a motion from near `start` to near the goal, with or without costates, such as an
            answer for a neighbouring start or query; or a value or policy, which is rolled out. By
            default the rough motions of `candidates.py` in turn, until one leads to an extremal.
        segments: of multiple shooting.
        tolerance: of the last Newton correction, relative to 1 + size.
        max_iterations: of Newton's method, a guess.

    Raises:
        ValueError: if an argument does not fit.
        SolveError: NOT_CONVERGED; WRONG_EXTREMAL if the extremal crosses the goal before it ends or
            has a conjugate point; NOT_APPLICABLE if it touches a hard obstacle; DID_NOT_REACH if
            the rollout of the guess does not reach the goal.
    """
    start = query.check_start(start)
    for name, value, least in (
        ("segments", segments, 2),
        ("max_iterations", max_iterations, 1),
    ):
        if value < least:
            raise ValueError(f"{name}: must be at least {least}, got {value}")
    if not 1e-12 <= tolerance <= 1e-3:
        raise ValueError(f"tolerance: must be between 1e-12 and 1e-3, got {tolerance}")
    if query.goal_distance(start) <= 0:
        return _at_rest(query, start)
    if guess is None:
        guesses = candidate_guesses(query, start).guesses
    elif isinstance(guess, Trajectory):
        _check_guess(query, guess)
        guesses = [guess]
    else:
        rolled = rollouts(query, policy_of(query, guess), start)[0]
        if rolled is None:
            raise SolveError(Status.DID_NOT_REACH, "the rollout of the guess")
        guesses = [rolled]
    extremal = Extremal(Status.NOT_CONVERGED)
    for rough in guesses:
        extremal = find_extremal(
            query,
            start,
            rough,
            segments=segments,
            precision=Precision(newton=tolerance, iterations=max_iterations),
        )
        if extremal.trajectory is not None:
            return extremal.trajectory
    raise SolveError(extremal.status, extremal.detail)


def exact_trajectory(
    query: Query, start: ArrayLike, guess: Value | Policy | None = None
) -> Trajectory:
    """The cheapest motion from `start` `[n]` to the goal that could be found.

    Args:
        query: the query.
        start: a state in the domain, outside hard obstacles.
        guess: a value or policy to roll out; by default a coarse value solved for the purpose.

    Raises:
        ValueError: if the start does not fit.
        SolveError: if no class of motions led to a verified answer.

    Example:
        >>> from ocp.query_family import PAPER_START, paper_query
        >>> motion = exact_trajectory(paper_query((4.0, 4.0)), PAPER_START)
        >>> round(motion.cost, 4)
        23.2998
    """
    return exact_trajectories(query, start, guess)[0]


def exact_trajectories(
    query: Query, start: ArrayLike, guess: Value | Policy | None = None
) -> list[Trajectory]:
    """All locally optimal motions found from `start` `[n]`, the cheapest first.

    At a state where two classes of motions cost the same (where V is not differentiable), the first
    two cost the same. Where no extremal applies or is found (hard obstacles that the motion
    touches), the answer is direct collocation's.

    Raises:
        ValueError: if the start does not fit.
        SolveError: if there is no verified answer.
    """
    start = query.check_start(start)
    if query.goal_distance(start) <= 0:
        return [_at_rest(query, start)]
    return _search(query, start, guess)


def _search(query: Query, start: Array, guess: Value | Policy | None) -> list[Trajectory]:
    candidates = candidate_guesses(query, start, guess)
    extremals: list[Extremal] = []
    found: list[Trajectory] = []
    for segments in (24, 72):  # the finer one converges from worse guesses, but takes its time
        extremals = [find_extremal(query, start, g, segments=segments) for g in candidates.guesses]
        found = _distinct([e.trajectory for e in extremals if e.trajectory is not None])
        if found:
            break
    touching = any(e.status is Status.NOT_APPLICABLE for e in extremals)
    missed = bool(found) and found[0].cost > SUSPICIOUS * candidates.bound
    # Without a value to tell which class is best, two guesses must agree.
    agreed = sum(e.cost <= (1 + DUPLICATE) * found[0].cost for e in extremals if found)
    lonely = query.system.has_drift and guess is None and agreed < 2
    if not found or touching or missed or lonely:
        found = _distinct(found + _by_collocation(query, start, candidates.guesses))
    if not found:
        raise SolveError(extremals[0].status, extremals[0].detail)
    return found


def _by_collocation(query: Query, start: Array, guesses: list[Trajectory]) -> list[Trajectory]:
    """Direct collocation's answers, polished to extremals where that is possible."""
    system = query.system
    if not ((start >= system.lower) & (start <= system.upper) | (system.period > 0)).all():
        return []  # collocation takes starts in the domain only
    answers = []
    for guess in [None, *guesses[:1]]:
        try:
            direct = solve_collocation(query, start, guess)
        except SolveError:
            continue
        polished = find_extremal(query, start, direct).trajectory
        close = polished is not None and abs(polished.cost - direct.cost) < 1e-4 * direct.cost
        answers.append(polished if close else direct)
    return answers


def _distinct(motions: list[Trajectory]) -> list[Trajectory]:
    """Those that differ, the cheapest first."""
    kept: list[Trajectory] = []
    for motion in sorted(motions, key=lambda t: t.cost):
        if not any(_same(motion, other) for other in kept):
            kept.append(motion)
    return kept


def _same(a: Trajectory, b: Trajectory) -> bool:
    if abs(a.cost - b.cost) > DUPLICATE * max(a.cost, b.cost):
        return False
    if a.costates is None or b.costates is None:
        return True
    gap = np.abs(a.costates[0] - b.costates[0]).max()
    return bool(gap <= DUPLICATE**0.5 * np.abs(a.costates[0]).max())


def _at_rest(query: Query, start: Array) -> Trajectory:
    zero = np.zeros(1)
    return Trajectory(zero, start[None], np.zeros((1, query.system.m)), 0 * start[None], zero)


def _check_guess(query: Query, guess: Trajectory) -> None:
    n, m, k = query.system.n, query.system.m, len(guess.times)
    shapes = guess.states.shape == (k, n) and guess.inputs.shape == (k, m)
    if k < 2 or not shapes or not (np.diff(guess.times) > 0).all():
        raise ValueError(
            f"guess: needs at least 2 increasing times, states [k, {n}] and inputs [k, {m}], got "
            f"{k} times, shapes {guess.states.shape} and {guess.inputs.shape}"
        )


class ExactValue:
    """V and grad V by solving for the exact motion from each state asked for.

    A state near a motion already known is solved from its rest, in a few milliseconds, and stays in
    the same class of motions; another one is searched from scratch. So a closed loop that is greedy
    for this value is exact feedback.
    """

    def __init__(self, query: Query, guide: Value | Policy | None = None) -> None:
        """`guide` is rolled out for first guesses; by default a coarse value is solved for that."""
        self.query = query
        self._guide = guide
        self._known: list[Trajectory] = []
        self._last: tuple[bytes, Trajectory] | None = None

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`.

        Raises:
            SolveError: if there is no verified motion from a state.
        """
        rows = self._rows(states)
        costs = [self.trajectory(x).cost for x in rows.reshape(-1, rows.shape[-1])]
        return np.array(costs).reshape(rows.shape[:-1])

    def gradient(self, states: ArrayLike) -> Array:
        """The costates `[..., n]` at states `[..., n]`: 0 in the goal.

        Raises:
            SolveError: if there is no verified motion from a state.
        """
        rows = self._rows(states)
        costates = []
        for x in rows.reshape(-1, rows.shape[-1]):
            motion = self.trajectory(x)
            if motion.costates is None:
                raise SolveError(Status.NOT_APPLICABLE, "the exact motion has no costates")
            costates.append(motion.costates[0])
        return np.array(costates).reshape(rows.shape)

    def trajectory(self, state: ArrayLike) -> Trajectory:
        """The exact motion from `state` `[n]`, which may lie outside the robot's domain.

        Raises:
            SolveError: if there is no verified motion.
        """
        x = np.ascontiguousarray(state, dtype=float)
        if self._last is not None and self._last[0] == x.tobytes():
            return self._last[1]
        if self.query.goal_distance(x) <= 0:
            return _at_rest(self.query, x)
        near = self._nearest(x)
        motion = None if near is None else find_extremal(self.query, x, near).trajectory
        if motion is None:
            motion = _search(self.query, x, self._guide)[0]
            self._known = [*self._known[1 - REMEMBERED :], motion]
        self._last = (x.tobytes(), motion)
        return motion

    def _nearest(self, x: Array) -> Trajectory | None:
        """The rest of the known motion that passes nearest to x, from there on."""
        system = self.query.system
        extent = system.upper - system.lower
        best, least = None, NEARBY
        for motion in self._known:
            gaps = np.abs(system.difference(motion.states[:-1], x) / extent).max(axis=1)
            k = int(gaps.argmin())
            if gaps[k] < least:
                best, least = (motion, k), gaps[k]
        if best is None:
            return None
        motion, k = best
        rest = onward(motion, motion.times[k])
        turns = x - rest.states[0] - system.difference(x, rest.states[0])
        return replace(rest, states=rest.states + turns)

    def _rows(self, states: ArrayLike) -> Array:
        rows = np.asarray(states, dtype=float)
        n = self.query.system.n
        if rows.shape[-1:] != (n,) or not np.isfinite(rows).all():
            raise ValueError(f"states: need finite numbers [..., {n}], got shape {rows.shape}")
        return rows
