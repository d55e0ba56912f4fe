"""What a navigator says: its orders to the controller, and the record of its replanning."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planners.update import Cause

Array = NDArray[np.float64]


class Phase(Enum):
    """What the robot is doing."""

    LEARNING = "learning where it stands"
    DRIVING = "driving"
    STOPPED = "stopped"
    ARRIVED = "arrived"


@dataclass(frozen=True)
class Replan:
    """The planner was told of a change.

    Attributes:
        time: seconds.
        causes: why.
        seconds: wall-clock time that the planner took.
        repaired: nodes whose cost-to-go was computed anew.
        route: whether there is one.
    """

    time: float
    causes: tuple[Cause, ...]
    seconds: float
    repaired: int
    route: bool


@dataclass(frozen=True, eq=False)
class Order:
    """What the controller is to do until the next sample.

    Attributes:
        reference: x_r `[n]`.
        phase: what the robot is doing.
        reason: why it stopped; empty unless it did.
        leg: number of the leg, from 1.
        deviation: D_rob, metres.
        largest_deviation: D_kin, metres.
        padding: of the planner, metres.
    """

    reference: Array
    phase: Phase
    reason: str
    leg: int
    deviation: float
    largest_deviation: float
    padding: float
