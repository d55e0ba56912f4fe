"""A query: a robot, a goal ball, obstacles, a running cost and limits; and families of queries.

V(x) is the least cost from x to the *first hit* of the goal ball. A query is data: it travels to
and from TOML, and to worker processes.
"""

import os
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from ocp import cost as costs
from ocp.cost import RunningCost
from ocp.models import get_model
from ocp.obstacle import Obstacle
from ocp.system import System


@dataclass(frozen=True)
class Goal:
    """The goal region: positions within `radius` metres of `center`."""

    center: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        if not np.isfinite(self.center).all():
            raise ValueError(f"goal.center: numbers must be finite, got {list(self.center)}")
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(f"goal.radius: must be a positive finite number, got {self.radius}")


@dataclass(frozen=True)
class Query:
    """One planning problem.

    Attributes:
        model: a registered robot's name, or a `System` of one's own (which no file can hold).
        goal: the goal ball.
        obstacles: soft, or hard too.
        cost: weights of the running cost.
        input_lower, input_upper: `m` bounds each, or `None` for no bound.
        robot_radius: metres; hard obstacles and collisions are judged for a ball of this radius.
    """

    model: str | System
    goal: Goal
    obstacles: tuple[Obstacle, ...] = ()
    cost: RunningCost = field(default_factory=RunningCost)
    input_lower: tuple[float, ...] | None = None
    input_upper: tuple[float, ...] | None = None
    robot_radius: float = 0.0

    def __post_init__(self) -> None:
        system = self.system
        d = len(system.position)
        if len(self.goal.center) != d:
            raise ValueError(
                f"goal.center: {system.name} has {d} position coordinates, "
                f"got {list(self.goal.center)}"
            )
        for x, index in zip(self.goal.center, system.position, strict=True):
            c = system.coordinates[index]
            if not c.lower <= x <= c.upper:
                raise ValueError(
                    f"goal.center: {c.name} = {x:g} lies outside [{c.lower:g}, {c.upper:g}]"
                )
        for k, obstacle in enumerate(self.obstacles, start=1):
            if len(obstacle.center) != d:
                raise ValueError(
                    f"obstacle {k}: {system.name} has {d} position coordinates, "
                    f"got {len(obstacle.center)}"
                )
        self.cost.check(system.n, system.m)
        if self.cost.state is not None:
            for i, c in enumerate(system.coordinates):
                if c.periodic and any(self.cost.state[i]):
                    raise ValueError(
                        f"cost.state: row {i + 1} must be 0, {c.name} is periodic and a quadratic "
                        "cost would jump"
                    )
        for name, bound in (("lower", self.input_lower), ("upper", self.input_upper)):
            if bound is not None and (len(bound) != system.m or np.isnan(bound).any()):
                raise ValueError(f"input.{name}: needs {system.m} numbers, got {list(bound)}")
        lower, upper = self.input_bounds
        if not (lower < upper).all():
            raise ValueError(
                f"input.lower: must be below input.upper, got {lower.tolist()}, {upper.tolist()}"
            )
        if not (np.isfinite(self.robot_radius) and self.robot_radius >= 0):
            raise ValueError(f"robot.radius: must be a finite number >= 0, got {self.robot_radius}")

    @cached_property
    def system(self) -> System:
        return self.model if isinstance(self.model, System) else get_model(self.model)

    def __getstate__(self) -> dict[str, Any]:
        """Only the data: what is derived from it is made anew in another process."""
        return {f.name: self.__dict__[f.name] for f in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    # Derived numbers

    @property
    def input_weights(self) -> NDArray[np.float64]:
        """Diagonal of R, `[m]`."""
        return np.ones(self.system.m) if self.cost.input is None else np.array(self.cost.input)

    @property
    def input_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper input bounds, `[m]` each, infinite where there is none.

        The query's own, within what the robot's actuators can do.
        """
        lower = np.array([i.lower for i in self.system.inputs], dtype=float)
        upper = np.array([i.upper for i in self.system.inputs], dtype=float)
        if self.input_lower is not None:
            lower = np.maximum(lower, self.input_lower)
        if self.input_upper is not None:
            upper = np.minimum(upper, self.input_upper)
        return lower, upper

    @property
    def is_bounded(self) -> bool:
        """Whether any input is bounded."""
        lower, upper = self.input_bounds
        return bool(np.isfinite(lower).any() or np.isfinite(upper).any())

    @property
    def is_time_free(self) -> bool:
        """Whether time can be scaled away: no drift, no input bounds (facts: V is an eikonal)."""
        return not self.system.has_drift and not self.is_bounded

    @property
    def reference(self) -> NDArray[np.float64]:
        """x_g `[n]`: the goal's centre in position coordinates, 0 elsewhere."""
        reference = np.zeros(self.system.n)
        reference[list(self.system.position)] = self.goal.center
        return reference

    @property
    def hard_obstacles(self) -> tuple[Obstacle, ...]:
        return tuple(o for o in self.obstacles if o.hard)

    def position(self, states: ArrayLike) -> NDArray[np.float64]:
        """Position coordinates `[..., d]` of states `[..., n]`."""
        return np.asarray(states, dtype=float)[..., list(self.system.position)]

    def goal_distance(self, states: ArrayLike) -> NDArray[np.float64]:
        """Signed distance `[...]` from states `[..., n]` to the goal ball, negative inside."""
        return (
            np.linalg.norm(self.position(states) - np.array(self.goal.center), axis=-1)
            - self.goal.radius
        )

    def clearance(self, states: ArrayLike, hard_only: bool = False) -> NDArray[np.float64]:
        """Distance `[...]` from the robot's ball to the nearest obstacle; negative in collision.

        Infinite where there is no obstacle.
        """
        positions = self.position(states)
        nearest = np.full(positions.shape[:-1], np.inf)
        for obstacle in self.hard_obstacles if hard_only else self.obstacles:
            nearest = np.minimum(nearest, obstacle.signed_distance(positions))
        return nearest - self.robot_radius

    def check_start(self, start: ArrayLike) -> NDArray[np.float64]:
        """`start` as a state inside the domain and outside hard obstacles.

        Raises:
            ValueError: naming the value and what would be right.
        """
        state = self.system.check_state(start)
        if self.clearance(state, hard_only=True) < 0:
            raise ValueError(f"start: {state.tolist()} lies inside a hard obstacle")
        return state

    # The running cost in CasADi, with this query's numbers

    def state_cost_expression(self, state: ca.SX) -> ca.SX:
        """W(x) for `state` `n x 1`."""
        p = state[list(self.system.position)]
        w = self.cost
        total = costs.goal_cost(
            p, ca.DM(self.goal.center), self.goal.radius, w.goal, w.goal_steepness
        )
        if w.state is not None:
            M = ca.DM(np.array(w.state))
            total += costs.quadratic_cost(state, ca.DM(self.reference), M)
        for o in self.obstacles:
            scale = (o.radius, w.obstacle, w.obstacle_steepness)
            if o.vertices:
                total += costs.polygon_penalty(p, ca.DM(o.center), ca.DM(o.facets), *scale)
            else:
                total += costs.ball_penalty(p, ca.DM(o.center), *scale)
        return total

    @cached_property
    def running_cost(self) -> ca.Function:
        """CasADi function (x, u) -> L(x, u)."""
        x = ca.SX.sym("x", self.system.n)  # pyright: ignore[reportArgumentType]
        u = ca.SX.sym("u", self.system.m)  # pyright: ignore[reportArgumentType]
        effort = ca.dot(ca.DM(self.input_weights), u**2)
        return ca.Function("running_cost", [x, u], [self.state_cost_expression(x) + effort])

    # Files (the format is in query_file.py)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Query":
        """Read a query file (TOML).

        Raises:
            ValueError: if the file is no TOML or a field is wrong; the message names the field.
            OSError: if the file cannot be read.
        """
        from ocp.query_file import query_from_dict, read_toml

        return query_from_dict(read_toml(path))

    def dumps(self) -> str:
        """The text of a query file that loads to an equal query.

        Raises:
            ValueError: if the model is a `System` of one's own, which no file can hold.
        """
        from ocp.query_file import query_to_dict

        return tomli_w.dumps(query_to_dict(self))
