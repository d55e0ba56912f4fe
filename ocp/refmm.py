"""ReFMM: repairing fast marching on an adaptively refined simplicial mesh.

After Yershov and Frazzoli (2016), "Asymptotically optimal feedback planning using a numerical
Hamilton-Jacobi-Bellman solver and an adaptive mesh refinement": solve on a coarse mesh in the order
of the values, refine the mesh where an error indicator says so, repair the values that the
refinement has made invalid, and go on as long as there is time. The mesh, the update, the march and
the indicator are in `ocp.simplicial`; docs/refmm.md says what was chosen where the paper is silent.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ocp.grid import Grid
from ocp.query import Query
from ocp.simplicial.indicator import error_indicator, marked_leaves
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.mesh_value import MeshPolicy, MeshValue
from ocp.simplicial.solution import TOLERANCE, Effort, MeshSolution, solve_on_mesh
from ocp.simplicial.stencils import goal_ball

Floats = NDArray[np.float64]

COARSE, FINE = 12_000, 96_000
"""Simplices of the paper's coarse and fine meshes."""


@dataclass(frozen=True)
class RefmmSettings:
    """How the mesh begins and grows.

    Attributes:
        first: simplices of the first mesh, about.
        last: simplices of the last mesh: a refinement beyond is trimmed to about this.
        share: of the error indicator's sum that the leaves bisected in a round hold.
        growth: the mesh grows by at most about this factor a round.
        table: correct the scheme by the exact value without obstacles, where the robot has one.
        tolerance: of V, relative to the fixed point on the mesh.
    """

    first: int = 6_000
    last: int = FINE
    share: float = 0.5
    growth: float = 2.0
    table: bool = True
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.last:
            raise ValueError(
                f"first: must lie between 1 and last = {self.last} simplices, got {self.first}"
            )
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"share: must lie in (0, 1], got {self.share}")
        if not self.growth > 1.0:
            raise ValueError(f"growth: must be more than 1, got {self.growth}")


def uniform_mesh(query: Query, simplices: int) -> Mesh:
    """A Kuhn mesh of about so many simplices that suits a time-free query (see `Grid.for_query`).

    Raises:
        SolveError: NOT_APPLICABLE, see `stencils.goal_ball`.
        ValueError: if there are too few simplices for a mesh.
    """
    goal_ball(query)
    orders = (1, 2, 6)[query.system.n - 1]
    low, high = 3**query.system.n, max(2 * simplices, 3**query.system.n + 1)
    while high - low > 1:  # nodes of the largest grid that has no more cells
        middle = (low + high) // 2
        grid = Grid.for_query(query, middle)
        cells = np.prod(np.array(grid.shape) - 1 + np.array(grid.periodic))
        low, high = (middle, high) if orders * cells <= simplices else (low, middle)
    return Mesh.kuhn(Grid.for_query(query, low))


@dataclass(frozen=True, eq=False)
class Round:
    """One round of refinement.

    Attributes:
        simplices, vertices: of the mesh after it.
        effort: of its repair.
        seconds: wall time of marking, refinement and repair.
    """

    simplices: int
    vertices: int
    effort: Effort
    seconds: float


@dataclass(frozen=True, eq=False)
class RefmmState:
    """The state of ReFMM, a `PlannerState`: a valid value and policy on the mesh so far.

    Attributes:
        solution: on the present mesh.
        settings: see `RefmmSettings`.
        starts: `[k, n]`, the states that matter; none means the whole box.
        rounds: what has been done.
    """

    solution: MeshSolution
    settings: RefmmSettings
    starts: Floats
    rounds: tuple[Round, ...]

    @property
    def finished(self) -> bool:
        """Whether the mesh has its last size, but for what a single bisection may add."""
        return self.solution.mesh.size >= 0.97 * self.settings.last

    @property
    def trajectories(self) -> int:
        return 0

    @property
    def next_seconds(self) -> float:
        """As long as the last round, times the growth of the mesh."""
        last = self.rounds[-1]
        before = self.rounds[-2] if len(self.rounds) > 1 else last
        return last.seconds * last.simplices / before.simplices

    def refined(self) -> "RefmmState":
        """The state after one more round."""
        began = time.perf_counter()
        mesh = self.solution.mesh
        indicator = error_indicator(self.solution, self.starts)
        marked = marked_leaves(indicator, self.settings.share)
        room = min(self.settings.last, int(self.settings.growth * mesh.size)) - mesh.size
        # A bisection brings some others with it, so the number is found by trying.
        grown = mesh.refined(marked)
        while len(marked) > 1 and grown.size - mesh.size > 1.03 * room:
            marked = marked[: max(1, int(len(marked) * room / (grown.size - mesh.size)))]
            grown = mesh.refined(marked)
        solution = self.solution.repaired(grown)
        done = Round(
            solution.mesh.size, len(solution.values), solution.effort, time.perf_counter() - began
        )
        return replace(self, solution=solution, rounds=(*self.rounds, done))


@dataclass(frozen=True)
class Refmm:
    """ReFMM as a planner: coarse first, then refined as long as time allows."""

    settings: RefmmSettings = RefmmSettings()

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]] = ()) -> RefmmState:
        """Solve on the first mesh; it will be refined for the `starts` `[n]`.

        Raises:
            SolveError: NOT_APPLICABLE, NOT_CONVERGED or INFEASIBLE.
        """
        began = time.perf_counter()
        s = self.settings
        mesh = uniform_mesh(query, s.first)
        solution = solve_on_mesh(query, mesh, table=s.table, tolerance=s.tolerance)
        rows = np.array(starts, dtype=float).reshape(-1, query.system.n)
        seconds = time.perf_counter() - began
        first = Round(mesh.size, len(solution.values), solution.effort, seconds)
        return RefmmState(solution, s, rows, (first,))

    def refine(self, state: RefmmState) -> RefmmState:
        """One more round of refinement and repair."""
        return state.refined()

    def policy(self, state: RefmmState) -> MeshPolicy:
        return state.solution.policy()

    def value(self, state: RefmmState) -> MeshValue:
        return state.solution.value


def solve_refmm(
    query: Query,
    starts: Sequence[NDArray[np.float64]] = (),
    settings: RefmmSettings | None = None,
) -> RefmmState:
    """Refine until the mesh has its last size.

    Args:
        query: time-free; up to 3 states.
        starts: the states `[n]` that matter; none means the whole box.
        settings: by default the paper's fine mesh.

    Raises:
        SolveError: NOT_APPLICABLE, NOT_CONVERGED or INFEASIBLE.
    """
    planner = Refmm(settings or RefmmSettings())
    state = planner.start(query, starts)
    while not state.finished:
        state = state.refined()
    return state
