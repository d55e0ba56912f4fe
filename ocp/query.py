"""A query: a robot, a goal, obstacles, a running cost and limits.

With a `Goal`, V(x) is the least cost from x to the *first hit* of the goal ball. With an
`Equilibrium`, V(x) is the least cost of regulation to it, for ever; its region says when a motion
counts as having reached it. A query is data: it travels to and from TOML, and to worker processes.
"""

import os
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from ocp import cost as costs
from ocp.cost import RunningCost
from ocp.equilibrium import equilibrium_input
from ocp.models import get_model, get_model_file
from ocp.obstacle import Obstacle
from ocp.system import System

RESTING_COST = 1e-6  # largest cost rate at an equilibrium that counts as none


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
class Equilibrium:
    """A goal to come to and stay at: a state in which some constant input holds the robot.

    Attributes:
        state: x_g, `n` numbers.
        radius: of the region that counts as reached: |x - x_g| <= radius over all coordinates, each
            in its SI unit.
    """

    state: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        if not np.isfinite(self.state).all():
            raise ValueError(f"goal.state: numbers must be finite, got {list(self.state)}")
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(f"goal.radius: must be a positive finite number, got {self.radius}")


@dataclass(frozen=True)
class ModelFile:
    """A robot in a file beside a query file.

    Attributes:
        name: as the query file has it, relative to its folder.
        folder: of the query file.
    """

    name: str
    folder: str

    @property
    def path(self) -> Path:
        """The file.

        Raises:
            ValueError: if it lies outside the folder, or does not exist.
        """
        folder = Path(self.folder).resolve()
        path = (folder / self.name).resolve()
        if not path.is_relative_to(folder):
            raise ValueError(f"model: {self.name!r} lies outside the query file's folder")
        if not path.is_file():
            raise ValueError(f"model: {self.name!r} is not in the query file's folder")
        return path


@dataclass(frozen=True)
class Query:
    """One planning problem.

    Attributes:
        model: a registered robot's name, a robot's file, or a `System` of one's own (which no file
            can hold).
        goal: a ball of positions, or an equilibrium. The latter needs `cost.state`, and no cost
            may remain there: `cost.goal` is 0.
        obstacles: soft, or hard too.
        cost: weights of the running cost.
        input_lower, input_upper: `m` bounds each, or `None` for no bound.
        robot_radius: metres; hard obstacles and collisions are judged for a ball of this radius.

    Example:
        >>> from ocp.obstacle import Obstacle
        >>> query = Query("unicycle", Goal((1.0, 4.0), 0.5), (Obstacle.circle((-1.0, -1.0), 1.0),))
        >>> float(query.goal_distance([1.0, 3.0, 0.0]))
        0.5
        >>> float(query.clearance([-1.0, 1.0, 0.0]))
        1.0
    """

    model: str | ModelFile | System
    goal: Goal | Equilibrium
    obstacles: tuple[Obstacle, ...] = ()
    cost: RunningCost = field(default_factory=RunningCost)
    input_lower: tuple[float, ...] | None = None
    input_upper: tuple[float, ...] | None = None
    robot_radius: float = 0.0

    def __post_init__(self) -> None:
        system = self.system
        d = len(system.position)
        for k, obstacle in enumerate(self.obstacles, start=1):
            if len(obstacle.center) != d:
                raise ValueError(
                    f"obstacle {k}: {system.name} has {d} position coordinates, "
                    f"got {len(obstacle.center)}"
                )
            for c in (system.coordinates[i] for i in system.position):
                if c.periodic:
                    raise ValueError(f"obstacle {k}: {c.name} is an angle, where none can stand")
        self.cost.check(system.n, system.m)
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
        if isinstance(self.goal, Equilibrium):
            self._check_equilibrium(self.goal)
        else:
            self._check_ball(self.goal)

    def _check_ball(self, goal: Goal) -> None:
        system, d = self.system, len(self.system.position)
        if len(goal.center) != d:
            raise ValueError(
                f"goal.center: {system.name} has {d} position coordinates, got {list(goal.center)}"
            )
        for x, index in zip(goal.center, system.position, strict=True):
            c = system.coordinates[index]
            if not c.lower <= x <= c.upper:
                raise ValueError(
                    f"goal.center: {c.name} = {x:g} lies outside [{c.lower:g}, {c.upper:g}]"
                )
            if c.periodic:
                raise ValueError(
                    f"goal.center: {c.name} is an angle and no ball has room for it; give an "
                    "equilibrium, goal.state"
                )

    def _check_equilibrium(self, goal: Equilibrium) -> None:
        system = self.system
        system.check_state(goal.state, "goal.state")
        if self.cost.state is None:
            raise ValueError("cost.state: missing; an equilibrium needs a quadratic cost")
        if self.cost.goal != 0:
            raise ValueError(
                f"cost.goal: must be 0 with an equilibrium as the goal, got {self.cost.goal}"
            )
        held = self.reference_input
        for i, u, low, high in zip(system.inputs, held, *self.input_bounds, strict=True):
            if not low < u < high:
                raise ValueError(
                    f"goal.state: holding {system.name} there takes {i.name} = {u:.4g} {i.unit}, "
                    f"which is not inside [{low:g}, {high:g}]"
                )
        expression = self.state_cost_expression(system.state)
        left = float(ca.Function("W", [system.state], [expression])(self.reference))
        if left > RESTING_COST:
            raise ValueError(
                f"goal.state: staying there costs {left:.2g} a second; move the obstacles away or "
                "set cost.obstacle = 0 and make them hard"
            )

    @cached_property
    def system(self) -> System:
        if isinstance(self.model, System):
            return self.model
        if isinstance(self.model, ModelFile):
            return get_model_file(self.model.path)
        return get_model(self.model)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Kept, since most of what is derived from a query is looked up by it."""
        return hash(tuple(getattr(self, f.name) for f in fields(self)))

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

    @cached_property
    def is_bounded(self) -> bool:
        """Whether any input is bounded."""
        lower, upper = self.input_bounds
        return bool(np.isfinite(lower).any() or np.isfinite(upper).any())

    @property
    def is_time_free(self) -> bool:
        """Whether time can be scaled away: no drift, no input bounds (facts: V is an eikonal)."""
        return not (self.system.has_drift or self.is_bounded or self.is_regulation)

    @property
    def is_regulation(self) -> bool:
        """Whether the goal is an equilibrium."""
        return isinstance(self.goal, Equilibrium)

    @property
    def reference(self) -> NDArray[np.float64]:
        """x_g `[n]`: the equilibrium, or the goal's centre in position coordinates, 0 elsewhere."""
        if isinstance(self.goal, Equilibrium):
            return np.array(self.goal.state, dtype=float)
        reference = np.zeros(self.system.n)
        reference[list(self.system.position)] = self.goal.center
        return reference

    @cached_property
    def reference_input(self) -> NDArray[np.float64]:
        """u_g `[m]`: the input that holds the robot at the equilibrium; 0 with a goal ball."""
        if not self.is_regulation:
            return np.zeros(self.system.m)
        return equilibrium_input(self.system, self.reference)

    @property
    def goal_position(self) -> NDArray[np.float64]:
        """The goal's position, `[d]`."""
        return self.reference[list(self.system.position)]

    def terminal_cost(self, state: ArrayLike, matrix: ArrayLike) -> float:
        """(x - x_g)' P (x - x_g), periodic where the robot is, at `state` `[n]`; P `[n, n]`."""
        return float(self._terminal(np.asarray(state, float), np.asarray(matrix, float))[0])

    def terminal_gradient(self, state: ArrayLike, matrix: ArrayLike) -> NDArray[np.float64]:
        """Its gradient `[n]`."""
        gradient = self._terminal(np.asarray(state, float), np.asarray(matrix, float))[1]
        return np.array(gradient)[:, 0]

    @cached_property
    def _terminal(self) -> ca.Function:
        n = self.system.n
        x, P = self.system.state, ca.SX.sym("P", n, n)  # pyright: ignore[reportArgumentType]
        cost = costs.quadratic_cost(x, ca.DM(self.reference), P, self.system.period)
        return ca.Function("terminal", [x, P], [cost, ca.densify(ca.gradient(cost, x))])

    @property
    def hard_obstacles(self) -> tuple[Obstacle, ...]:
        return tuple(o for o in self.obstacles if o.hard)

    def position(self, states: ArrayLike) -> NDArray[np.float64]:
        """Position coordinates `[..., d]` of states `[..., n]`."""
        return np.asarray(states, dtype=float)[..., list(self.system.position)]

    def goal_distance(self, states: ArrayLike) -> NDArray[np.float64]:
        """Signed distance `[...]` from states `[..., n]` to the goal's region, negative inside."""
        if isinstance(self.goal, Equilibrium):
            offset = self.system.difference(states, self.reference)
        else:
            offset = self.position(states) - np.array(self.goal.center)
        with np.errstate(over="ignore"):  # so far away that the square overflows: infinitely far
            return np.linalg.norm(offset, axis=-1) - self.goal.radius

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
            p, ca.DM(self.goal_position), self.goal.radius, w.goal, w.goal_steepness
        )
        if w.state is not None:
            M = ca.DM(np.array(w.state))
            total += costs.quadratic_cost(state, ca.DM(self.reference), M, self.system.period)
        if w.own:
            total += costs.own_cost(w.own)(state)
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
        effort = ca.dot(ca.DM(self.input_weights), (u - ca.DM(self.reference_input)) ** 2)
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

        return query_from_dict(read_toml(path), Path(path).parent)

    def dumps(self) -> str:
        """The text of a query file that loads to an equal query.

        Raises:
            ValueError: if the model is a `System` of one's own, which no file can hold.
        """
        from ocp.query_file import query_to_dict

        return tomli_w.dumps(query_to_dict(self))
