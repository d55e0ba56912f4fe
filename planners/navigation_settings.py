"""The numbers of a robot that navigates, and which of the paper's rules it keeps.

What the rules mean is said in `rrt_qx`.
"""

from dataclasses import dataclass
from enum import Enum


class PaddingRule(Enum):
    """What obstacles are augmented by."""

    LARGEST_DEVIATION = "largest deviation so far"
    EACH_LEG = "each leg foretold"


class WaypointRule(Enum):
    """How the robot goes from one waypoint to the next."""

    WINDOW = "each until within its window"
    MOVING = "a reference that runs ahead"


@dataclass(frozen=True)
class Rules:
    """Which of the paper's rules are kept."""

    padding: PaddingRule
    waypoints: WaypointRule

    @property
    def foretell(self) -> bool:
        """Whether they need a controller that can forecast."""
        return self.padding is PaddingRule.EACH_LEG


PAPER = Rules(PaddingRule.LARGEST_DEVIATION, WaypointRule.WINDOW)
FORETOLD = Rules(PaddingRule.EACH_LEG, WaypointRule.WINDOW)
FLOWING = Rules(PaddingRule.EACH_LEG, WaypointRule.MOVING)


@dataclass(frozen=True)
class NavigatorSettings:
    """A robot's numbers; lengths in metres, times in seconds.

    Attributes:
        sample_period: Delta t.
        horizon: T.
        admissible_window: rho.
        goal_tolerance: of the goal.
        perception_radius: how far the robot sees.
        robot_radius: of its body.
        rules: see `rrt_qx`.
        margin: kept between body and obstacles by every foretold motion.
        comfort: padding beyond the body that routes keep where there is room.
        lead: how far the reference runs ahead at most; by default three quarters of the perception.
        foresight: how long moving obstacles are extrapolated.
        growth: metres a second by which bodies are extended while they change their velocity.
        nodes: of the planner's tree.
    """

    sample_period: float = 0.05
    horizon: float = 10.0
    admissible_window: float = 0.15
    goal_tolerance: float = 0.25
    perception_radius: float = 8.0
    robot_radius: float = 0.0
    rules: Rules = FLOWING
    margin: float = 0.1
    comfort: float = 0.4
    lead: float | None = None
    foresight: float = 3.0
    growth: float = 0.5
    nodes: int = 2000

    @property
    def least_padding(self) -> float:
        return self.robot_radius + self.margin

    @property
    def farthest(self) -> float:
        return 0.75 * self.perception_radius if self.lead is None else self.lead
