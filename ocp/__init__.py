"""Optimal control problems and their exact and convergent solvers."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from ocp.cost import RunningCost
    from ocp.obstacle import Obstacle
    from ocp.planning import deadline, iterations, plan, trajectories
    from ocp.pontryagin import exact_trajectory
    from ocp.query import Goal, Query
    from ocp.system import System
    from ocp.trajectory import SolveError, Status, Trajectory
    from ocp.value import greedy

_HOMES = {
    "Goal": "query",
    "Obstacle": "obstacle",
    "Query": "query",
    "RunningCost": "cost",
    "SolveError": "trajectory",
    "Status": "trajectory",
    "System": "system",
    "Trajectory": "trajectory",
    "deadline": "planning",
    "exact_trajectory": "pontryagin",
    "greedy": "value",
    "iterations": "planning",
    "plan": "planning",
    "trajectories": "planning",
}

__all__ = [
    "Goal",
    "Obstacle",
    "Query",
    "RunningCost",
    "SolveError",
    "Status",
    "System",
    "Trajectory",
    "deadline",
    "exact_trajectory",
    "greedy",
    "iterations",
    "plan",
    "trajectories",
]


__getattr__ = lazy_names(__name__, _HOMES)
