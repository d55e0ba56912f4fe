"""Direct collocation: exact optimal motions by Radau transcription and IPOPT, checked and refined.

A transcription is true at its nodes only: with a long last interval it can claim .041 where .147 is
right. Every answer is therefore replayed (replay.py). The mesh is refined, its intervals short
where the replay disagrees, until costs and states agree; what cannot be brought to agree raises.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.extremals.guess import default_guesses
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.transcription.check import ReplayVerdict, judge
from ocp.transcription.programme import (
    FIRST_TIME_PRICE,
    TIME_PRICE,
    Problem,
    Program,
    program,
)
from ocp.transcription.radau import CollocatedMotion
from ocp.transcription.terms import Structure

Array = NDArray[np.float64]

CAP = 3.0  # largest duration as a multiple of the guess's; raised when an answer lies there
MAX_CAP = 100.0
STATE_TOLERANCE = 1e-5  # largest gap of a replayed interval's end state
HARD_MARGIN = 1e-4  # metres
MAX_MARGIN = 1e-2  # metres; a motion that enters an obstacle deeper needs a finer mesh
ROUNDS = 16
MAX_MOVES = 3  # of the mesh, before its intervals double
MAX_BREACHES = 5
STRAY = 0.1  # relative difference of cost beyond which a warm start did not stay near its guess
DUPLICATE = 1e-6  # relative difference of cost below which two answers count as one


def solve_collocation(
    query: Query,
    start: ArrayLike,
    guess: Trajectory | None = None,
    *,
    horizon: float | None = None,
    terminal_cost: ArrayLike | None = None,
    intervals: int = 20,
    degree: int = 3,
    tolerance: float = 1e-6,
    max_intervals: int = 160,
    max_iterations: int = 300,
    time_limit: float = 60.0,
    state_tolerance: float = STATE_TOLERANCE,
) -> Trajectory:
    """The optimal motion from `start` `[n]`.

    Without `horizon` the motion ends at the first hit of the goal ball, at a free time, and its
    cost is V(start). With `horizon` it takes that many seconds, ignores the goal ball, and
    minimises running cost plus (x - x_g)' P_T (x - x_g) at the end; the trajectory's cost is the
    running cost alone.

    The answer is a local optimum, as a rule the one near the guess; where obstacles give the cost
    kinks it may be another one. Without a guess several are tried (either side of
    obstacles, driving forward and backward) and the cheapest answer is kept.

    Args:
        query: the query.
        start: a state in the domain, outside hard obstacles.
        guess: a motion to start from.
        horizon: seconds, or `None` for a free final time.
        terminal_cost: P_T `[n, n]`, symmetric positive semidefinite; only with a `horizon`.
        intervals: of the first mesh.
        degree: Radau points in an interval, 2 to 5.
        tolerance: how far the replayed cost may lie from the claimed one, relative to the cost.
        max_intervals: of the finest mesh.
        max_iterations: of IPOPT, in one solve.
        time_limit: seconds for all solves, the building of programs not counted.
        state_tolerance: largest gap of a replayed interval's end state.

    Returns:
        The motion at its start and all collocation points, with costates.

    Raises:
        ValueError: naming the argument that is wrong.
        SolveError: if no guess led to an answer that stands the replay.
    """
    start = query.check_start(start)
    terminal = _checked(query, horizon, terminal_cost)
    for name, value, least, most in (
        ("intervals", intervals, 2, 1000),
        ("degree", degree, 2, 5),
        ("max_intervals", max_intervals, intervals, 1000),
        ("max_iterations", max_iterations, 1, 100_000),
    ):
        if not least <= value <= most:
            raise ValueError(f"{name}: must be between {least} and {most}, got {value}")
    if not 1e-10 <= tolerance < 1:
        raise ValueError(f"tolerance: must be between 1e-10 and 1, got {tolerance}")
    if horizon is None and query.is_regulation:
        raise ValueError("horizon: needed where the goal is an equilibrium; see exact_trajectory")
    if horizon is None and query.goal_distance(start) <= 0:
        return _at_rest(query, start)
    search = _Search(
        query,
        start,
        horizon,
        terminal,
        intervals,
        degree,
        tolerance,
        max_intervals,
        max_iterations,
        time.monotonic() + time_limit,
        state_tolerance,
    )
    guesses = default_guesses(query, start, horizon) if guess is None else [guess]
    return search.cheapest(guesses).trajectory()


def _checked(query: Query, horizon: float | None, terminal: ArrayLike | None) -> Array | None:
    if horizon is not None and not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"horizon: must be a positive finite number of seconds, got {horizon}")
    if terminal is None:
        return None
    if horizon is None:
        raise ValueError("terminal_cost: needs a horizon; at a free time the motion ends in V = 0")
    n = query.system.n
    matrix = np.array(terminal, dtype=float)
    if matrix.shape != (n, n) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        raise ValueError(f"terminal_cost: must be a symmetric {n} x {n} matrix, got {terminal}")
    if np.linalg.eigvalsh(matrix).min() < -1e-12 * max(1.0, np.abs(matrix).max()):
        raise ValueError("terminal_cost: must be positive semidefinite")
    return matrix


def _at_rest(query: Query, start: Array) -> Trajectory:
    n, m = query.system.n, query.system.m
    return Trajectory(
        np.zeros(1), start[None], np.zeros((1, m)), np.zeros((1, n)), np.zeros(1), Status.SOLVED
    )


@dataclass
class _Search:
    query: Query
    start: Array
    horizon: float | None
    terminal: Array | None
    intervals: int
    degree: int
    tolerance: float
    max_intervals: int
    max_iterations: int
    deadline: float
    state_tolerance: float

    def cheapest(self, guesses: list[Trajectory]) -> CollocatedMotion:
        """Solve on a coarse mesh from every guess, then refine the cheapest answers."""
        failures: list[SolveError] = []
        coarse: list[CollocatedMotion] = []
        for guess in guesses:
            try:
                coarse.append(self._first(guess))
            except SolveError as failure:
                failures.append(failure)
        best: CollocatedMotion | None = None
        tried: list[float] = []
        for motion in sorted(coarse, key=lambda motion: motion.total_cost):
            cost = motion.total_cost
            if best is not None and cost > best.total_cost * (1 + 1e-3):
                break
            if any(abs(cost - other) <= DUPLICATE * other for other in tried):
                continue
            tried.append(cost)
            try:
                refined = self._refined(motion)
            except SolveError as failure:
                failures.append(failure)
                continue
            if best is None or refined.total_cost < best.total_cost:
                best = refined
        if best is None:
            raise _gravest(failures)
        return best

    def _first(self, guess: Trajectory) -> CollocatedMotion:
        """Solve from a guess.

        One with costates is a solution, perhaps of a neighbouring problem: the mesh follows its
        points, and an answer of quite another cost has strayed, so that a finer mesh is tried.
        """
        even = np.linspace(0.0, 1.0, self.intervals + 1)
        if guess.costates is None:
            return self._loose(guess, even, self._first_margin)
        points = np.unique(guess.times) / guess.duration
        strayed: CollocatedMotion | None = None
        for count in (self.intervals, min(2 * self.intervals, self.max_intervals)):
            places = np.linspace(0.0, len(points) - 1.0, count + 1)
            mesh = np.interp(places, np.arange(len(points)), points)
            try:
                motion = self._bounded(guess, mesh, self._first_margin)
            except SolveError as failure:
                if failure.status is Status.TIME_LIMIT:
                    raise
                continue
            if abs(motion.cost / guess.cost - 1) < STRAY:
                return motion
            strayed = strayed or motion
        return strayed or self._loose(guess, even, self._first_margin)

    @property
    def _first_margin(self) -> float:
        return HARD_MARGIN if self.query.hard_obstacles else 0.0

    def _program(self, intervals: int) -> Program:
        free = self.horizon is None
        began = time.monotonic()
        ready = program(Structure.of(self.query, intervals, self.degree, free, self.max_iterations))
        self.deadline += time.monotonic() - began
        return ready

    def _problem(self, mesh: Array, longest: float, margin: float) -> Problem:
        limits = (1e-6 * longest, longest)
        if self.horizon is not None:
            limits = (self.horizon, self.horizon)
        return Problem(self.query, self.start, mesh, limits, self.terminal, margin)

    def _loose(
        self, guess: Trajectory | CollocatedMotion, mesh: Array, margin: float
    ) -> CollocatedMotion:
        """Solve on a mesh with a large price of time, which guides the duration.

        Should a guess's costates mislead, the rest of it is used alone.
        """
        try:
            return self._bounded(guess, mesh, margin)
        except SolveError as failure:
            if guess.costates is None or failure.status is Status.TIME_LIMIT:
                raise
            plain = guess.trajectory() if isinstance(guess, CollocatedMotion) else guess
            return self._bounded(replace(plain, costates=None), mesh, margin)

    def _bounded(
        self, guess: Trajectory | CollocatedMotion, mesh: Array, margin: float
    ) -> CollocatedMotion:
        """Solve on a mesh; the cap on the duration is raised while the answer lies at it."""
        cap = CAP * guess.duration
        while cap <= MAX_CAP * guess.duration:
            problem = self._problem(mesh, cap, margin)
            ready = self._program(len(mesh) - 1)
            motion = ready.solve(problem, guess, FIRST_TIME_PRICE, self.deadline)
            if self.horizon is not None or motion.duration < 0.99 * cap:
                return motion
            cap *= CAP
        raise _unbounded(cap / CAP)

    def _tight(self, loose: CollocatedMotion, margin: float) -> CollocatedMotion | None:
        """The answer proper: from a loose one, with a negligible price of time.

        `None` if the mesh is too coarse for that to converge.
        """
        if self.horizon is not None:
            return loose
        cap = CAP * loose.duration
        problem = self._problem(loose.mesh, cap, margin)
        ready = self._program(len(loose.durations))
        try:
            motion = ready.solve(problem, loose, TIME_PRICE, self.deadline)
        except SolveError as failure:
            if failure.status is Status.TIME_LIMIT:
                raise
            return None
        if motion.duration > 0.99 * cap:
            raise _unbounded(cap)
        return motion

    def _refined(self, loose: CollocatedMotion) -> CollocatedMotion:
        """Refine mesh and margin until a replay agrees and is clear of hard obstacles."""
        margin = self._first_margin
        trouble, status = "", Status.NOT_CONVERGED
        moves = breaches = 0
        for _ in range(ROUNDS):
            motion = self._tight(loose, margin)
            verdict = judge(motion or loose, self.horizon is None)
            mesh, errors = loose.mesh, np.abs(verdict.errors)
            if motion is None or verdict.depth > MAX_MARGIN or not self._agrees(motion, verdict):
                if verdict.depth > MAX_MARGIN:
                    trouble = f"the motion enters a hard obstacle by {verdict.depth:.2g} m"
                    errors = np.where(verdict.breached, 1.0, 1e-9)
                    breaches += 1
                    if breaches > MAX_BREACHES:
                        status = Status.INFEASIBLE
                        break
                elif motion is None:
                    trouble = "the final time does not settle"
                else:
                    trouble = f"costs differ by {errors.sum():.1e}, states by {verdict.gap:.1e}"
                # A kink of the cost spoils few intervals: these shrink before there are more.
                few = motion is not None and moves < MAX_MOVES
                few = few and np.sort(errors)[-4:].sum() > 0.9 * errors.sum()
                moves = moves + 1 if few else 0
                count = (len(mesh) - 1) * (1 if few else 2)
                if count > self.max_intervals:
                    break
                loose = self._loose(loose, _moved(mesh, errors, count), margin)
            elif verdict.hit is not None:
                trouble = f"the motion crosses the goal at {verdict.hit:.4g} s"
                uniform = np.linspace(0.0, 1.0, len(mesh))
                loose = self._loose(_until(motion.trajectory(), verdict.hit), uniform, margin)
            elif verdict.depth > 0:
                trouble = f"the motion enters a hard obstacle by {verdict.depth:.2g} m"
                margin += 1.5 * verdict.depth
                loose = self._loose(loose, mesh, margin)
            else:
                return motion
        raise SolveError(status, f"replayed on {len(loose.durations)} intervals, {trouble}")

    def _agrees(self, motion: CollocatedMotion, verdict: ReplayVerdict) -> bool:
        allowed = self.tolerance * max(motion.total_cost, 1e-9)
        return bool(np.abs(verdict.errors).sum() <= allowed) and verdict.gap <= self.state_tolerance


def _moved(mesh: Array, errors: Array, count: int) -> Array:
    """A mesh of `count` intervals, shorter where the errors `[k]` on `mesh` are large.

    Smooth errors go with length^(2 d), those of a kink with length^2; the exponent here is for
    kinks, and every interval keeps at least half its share, so that smooth parts do not starve.
    """
    wanted = (errors + 1e-6 * errors.max() + 1e-300) ** (1 / 3)
    wanted = np.maximum(wanted / wanted.sum(), 0.5 / len(errors))
    so_far = np.concatenate([[0.0], np.cumsum(wanted / wanted.sum())])
    moved = np.interp(np.linspace(0.0, 1.0, count + 1), so_far, mesh)
    moved[0], moved[-1] = 0.0, 1.0
    return moved


def _until(guess: Trajectory, end: float) -> Trajectory:
    """The part of a motion up to the time `end`."""
    keep = guess.times < end
    keep[0] = True
    times = np.append(guess.times[keep], end)

    def cut(values: Array) -> Array:
        columns = values.reshape(len(values), -1).T
        return np.stack([np.interp(times, guess.times, c) for c in columns], axis=-1)

    return replace(
        guess,
        times=times,
        states=cut(guess.states),
        inputs=cut(guess.inputs),
        costates=None,
        cost_so_far=cut(guess.cost_so_far)[:, 0],
    )


def _unbounded(duration: float) -> SolveError:
    return SolveError(
        Status.NOT_CONVERGED,
        f"the duration grows without bound, beyond {duration:.3g} s: does it cost anything to be "
        "away from the goal? If not, give a horizon",
    )


def _gravest(failures: list[SolveError]) -> SolveError:
    """What to report when every guess failed: infeasible only if all are."""
    for status in (Status.TIME_LIMIT, Status.NOT_CONVERGED):
        for failure in failures:
            if failure.status is status:
                return failure
    return failures[0]
