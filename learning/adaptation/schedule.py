"""The refinements of a plan: which there are, in which order, and how long each takes."""

from dataclasses import dataclass, field
from functools import cache

USUAL = {4_500: 3e-3, 9_000: 4.7e-3, 18_000: 8e-3, 60_000: 28e-3, 240_000: 125e-3}
"""Nodes, and the seconds that one solve usually takes: only ratios matter."""
TRAJECTORY = 2e-3  # seconds that an exact one usually takes
FORGOTTEN = 0.02  # part of what was learned of the machine, with each plan
COARSE = 4_500  # answers where the network's check fails
FIRST = 18_000  # begun together with the network, unless a deadline has it otherwise
TRAJECTORIES = 8  # exact ones, from states of the planner's choice if no starts are asked for
FEW = 4  # exact trajectories that a grid must leave time for
LAST = 1  # exact trajectories left to one core while another solves the next grid
OUTLIER = 4.0  # a step's time counts for at most so many times what was expected
GRID_PART = 0.85  # of a deadline for the first grid
READY = 3e-4  # seconds to take up what another core has finished


@dataclass(frozen=True)
class Step:
    """One refinement: an exact trajectory from the start with this number, or a grid."""

    start: int = -1
    nodes: int = 0


def steps(asked: int, first: int, patient: bool, doubted: bool) -> tuple[Step, ...]:
    """What there is to do for so many starts asked for.

    Args:
        asked: starts; without any, the planner chooses its own.
        first: nodes of the first grid; 0 for no grids at all.
        patient: whether there is a deadline. Then finer grids follow even exact trajectories that
            leave them little to gain.
        doubted: whether the first grid comes before exact trajectories: it tells from which starts
            the network's loop is in a wrong class. It takes the time of several of them.
    """
    exact = [Step(start=i) for i in range(asked or TRAJECTORIES)]
    if not first:
        return tuple(exact)
    finer = (n for n in USUAL if n > max(first, FIRST))
    if asked and asked <= TRAJECTORIES and not patient:
        finer = ()
    grids = (Step(nodes=first), *(Step(nodes=n) for n in finer))
    return (grids[0], *exact, *grids[1:]) if doubted else (*exact, *grids)


@dataclass
class Clock:
    """How long steps take on this machine, learned as they are taken.

    Attributes:
        trajectory: seconds of an exact one.
        motion: seconds of a grid's closed loop.
        pace: a grid's time over the usual one.
        doubted: of "grid" and "trajectory" those whose last time was out of all proportion.
    """

    trajectory: float = TRAJECTORY
    motion: float = 0.3e-3
    pace: float = 1.0
    doubted: set[str] = field(default_factory=set)

    def expected(self, step: Step, motions: int = 0) -> float:
        """Seconds; a grid's with so many of its closed loops."""
        if step.nodes:
            return self.pace * USUAL[step.nodes] + self.motion * motions
        return self.trajectory

    def first_grid(self, asked: int, seconds: float) -> int:
        """Nodes of the finest grid, up to `FIRST`, that ends well before a deadline; 0 for none.

        What is left after it is for exact trajectories that it asks for. One as coarse as `COARSE`
        knows less than the networks.

        Args:
            asked: starts, from which it drives its closed loops.
            seconds: until the deadline, from when it is begun.
        """
        most = GRID_PART * seconds
        sizes = [n for n in USUAL if COARSE < n <= FIRST]
        return max((n for n in sizes if self.expected(Step(nodes=n), asked) <= most), default=0)

    def learn(self, step: Step, seconds: float, motions: int = 0) -> None:
        """Take note of a step's time.

        A time out of all proportion is believed only if the next one is so too, and then in part:
        the first step also loads code, and whoever believed that time would never take a step
        before a deadline again, and so never learn better.
        """
        kind = "grid" if step.nodes else "trajectory"
        most = OUTLIER * self.expected(step, motions)
        if seconds <= most:
            self.doubted.discard(kind)
        elif kind not in self.doubted:
            self.doubted.add(kind)
            return
        seconds = min(seconds, most)
        if step.nodes:
            pace = max(seconds - self.motion * motions, 0.0) / USUAL[step.nodes]
            self.pace += 0.5 * (pace - self.pace)
        else:
            self.trajectory += 0.3 * (seconds - self.trajectory)

    def forget(self) -> None:
        """Come back a little to what is usual; once a plan.

        A step that seems too slow for any deadline is never taken, so nothing else would tell that
        it is fast again.
        """
        self.trajectory += FORGOTTEN * (TRAJECTORY - self.trajectory)
        self.pace += FORGOTTEN * (1.0 - self.pace)


@cache
def machine_clock() -> Clock:
    """What all plans of this process have learned of the machine."""
    return Clock()
