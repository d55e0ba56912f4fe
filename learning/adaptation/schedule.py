"""The refinements of a plan: which there are, in which order, and how long each takes."""

from dataclasses import dataclass
from itertools import chain

COARSE = 4_500  # nodes of the grid that answers where the network's check fails
GRIDS = (18_000, 60_000, 240_000)
TRAJECTORIES = 8  # exact ones, from states of the planner's choice if no starts are asked for
EARLY = 4  # so many starts are solved exactly before any grid; the grid comes from another core
CAUTION = 1.3  # by how much a step's expected time is overestimated
OUTLIER = 4.0  # a step's time counts for at most so many times what was expected
READY = 3e-4  # seconds to take up what another core has finished


@dataclass(frozen=True)
class Step:
    """One refinement: an exact trajectory from the start with this number, or a grid."""

    start: int = -1
    nodes: int = 0


def steps(asked: int, grids: bool, patient: bool) -> tuple[Step, ...]:
    """What there is to do for so many starts asked for.

    Args:
        asked: starts; without any, the planner chooses its own.
        grids: whether grids are allowed.
        patient: whether finer grids follow exact trajectories that leave them little to gain.
    """
    coarse, *finer = ([Step(nodes=n)] for n in GRIDS) if grids else ([],)
    exact = [Step(start=i) for i in range(asked or TRAJECTORIES)]
    if asked and asked <= TRAJECTORIES and not patient:
        finer = []
    begin = [*exact, *coarse] if 0 < asked <= EARLY else [*coarse, *exact]
    return (*begin, *chain(*finer))


@dataclass
class Clock:
    """How long steps take on this machine, learned as they are taken.

    Attributes:
        trajectory: seconds of an exact one.
        grid: seconds of a grid before its first node.
        node: seconds a node.
        motion: seconds of a grid's closed loop.
    """

    trajectory: float = 3e-3
    grid: float = 2.0e-3
    node: float = 0.5e-6
    motion: float = 0.4e-3

    def expected(self, step: Step, motions: int = 0) -> float:
        """Seconds, with caution; a grid's with so many of its closed loops."""
        if step.nodes:
            return CAUTION * (self.grid + self.node * step.nodes + self.motion * motions)
        return CAUTION * self.trajectory

    def learn(self, step: Step, seconds: float, motions: int = 0) -> None:
        """Take note of a step's time.

        An outlier counts in part only: the first step also loads code, and whoever believed that
        time would never take a step before a deadline again, and so never learn better.
        """
        seconds = min(seconds, OUTLIER * self.expected(step, motions) / CAUTION)
        if step.nodes:
            nodes = max(seconds - self.grid - self.motion * motions, 0.0)
            self.node += 0.5 * (nodes / step.nodes - self.node)
        else:
            self.trajectory += 0.3 * (seconds - self.trajectory)
