"""What RRT^X answers: the route, what an update changed and why, and the tree for drawing."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planners.blockage import Blockage


class Cause(Enum):
    """Why an update was made."""

    GROWTH = "samples were added"
    APPEARANCE = "obstacles appeared"
    DISAPPEARANCE = "obstacles vanished"
    MOVEMENT = "obstacles moved"
    PADDING = "the padding changed"
    ROBOT = "the robot moved"
    GOAL = "the goal changed"
    SETTLING = "the repair was run to its end"


@dataclass(frozen=True)
class Route:
    """A way for the robot to the goal, along straight lines.

    Attributes:
        points: `[k, d]`, from the robot to the goal.
        cost: its length.
        certified: whether every line was proved free; else it was only sampled.
    """

    points: NDArray[np.float64]
    cost: float
    certified: bool


@dataclass(frozen=True)
class Update:
    """What an update changed, why, and how long it took.

    Attributes:
        causes: why.
        handles: of the obstacles that appeared, in order.
        edges_blocked, edges_freed: edges that changed.
        orphans: nodes that lost their way to the goal.
        repaired: nodes made consistent.
        settled: whether all nodes are consistent; else those farther than the robot may lag.
        route: the robot's way now; `None` if there is none.
        route_changed: whether it differs from before.
        cost_before: the length of the way before; infinite if there was none.
        blockage: what bars the way, if there is none.
        geometry_seconds: of `seconds`, spent on distances, certificates and blockage.
        seconds: wall-clock time of the whole update.
    """

    causes: tuple[Cause, ...]
    handles: tuple[int, ...]
    edges_blocked: int
    edges_freed: int
    orphans: int
    repaired: int
    settled: bool
    route: Route | None
    route_changed: bool
    cost_before: float
    blockage: Blockage | None
    geometry_seconds: float
    seconds: float


@dataclass(frozen=True)
class TreeView:
    """The tree as it is now, for drawing; copies.

    Attributes:
        points: `[n, d]`.
        root: the goal's node.
        parent: `[n]`, -1 at the root and at nodes without a way.
        cost_to_go: `[n]`, the look-ahead value; infinite at nodes without a way.
        announced: `[n]`, the cost-to-go the neighbours last heard of (g).
        consistent: `[n]`, whether the node waits for no repair.
        edges, lengths, blocked: `[m, 2]`, `[m]`, `[m]`, the whole graph; the first of an edge's
            ends is the older.
        clearance: `[m]`, at least so far from every obstacle; infinite beyond the horizon.
        radius: the connection radius, metres.
    """

    points: NDArray[np.float64]
    root: int
    parent: NDArray[np.int32]
    cost_to_go: NDArray[np.float64]
    announced: NDArray[np.float64]
    consistent: NDArray[np.bool_]
    edges: NDArray[np.int64]
    lengths: NDArray[np.float64]
    blocked: NDArray[np.bool_]
    clearance: NDArray[np.float64]
    radius: float
