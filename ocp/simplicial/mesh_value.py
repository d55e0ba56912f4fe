"""The value on a mesh, linear on each simplex, and the feedback policy that is read off it.

The policy is that of the grids (`ocp.grids.bellman.feedback`): the input that minimises the
Hamiltonian with the gradient by differences, if a step under it keeps the Bellman equation; else
the best step. A step is as long as the simplex that the robot is in.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.function_address import addresses
from ocp.compiled.parameters import parameters
from ocp.grids.bellman import bellman_addresses, bellman_geometry, bellman_settings
from ocp.grids.input_samples import sampled_inputs
from ocp.query import Query
from ocp.simplicial.location import (
    gradient_rows,
    interpolate_mesh,
    interpolate_rows,
    lookahead,
)
from ocp.simplicial.mesh import Mesh

CELLS = 1.0  # length of a step, in the lengths of the simplex along the axes
ROUNDS = 3  # of refinement of the best input


@dataclass(frozen=True, eq=False)
class MeshValue:
    """A value on a mesh; a `Value`.

    Attributes:
        query: what it is the value of: 0 in the goal.
        mesh: where the vertices are.
        values: `[N]` at the vertices, never NaN.

    Outside the mesh's box, and in hard obstacles, the value is infinite. Beside a hard obstacle
    only the vertices that a state sees past it are mixed.
    """

    query: Query
    mesh: Mesh
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.mesh.vertices),) or np.isnan(self.values).any():
            raise ValueError(f"values: needs {len(self.mesh.vertices)} numbers, none of them NaN")

    def __getstate__(self) -> dict[str, Any]:
        """Without what holds addresses of this process."""
        return {name: self.__dict__[name] for name in ("query", "mesh", "values")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def value(self, states: ArrayLike) -> NDArray[np.float64]:
        """V `[...]` at states `[..., n]`.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        rows, shape = self._rows(states)
        out = np.empty(len(rows))
        interpolate_rows(*self._packed, rows, out)
        return np.where(self.query.goal_distance(states) <= 0, 0.0, out.reshape(shape))

    def gradient(self, states: ArrayLike) -> NDArray[np.float64]:
        """The gradient `[..., n]` at states `[..., n]`, by differences over the simplex's lengths
        to both sides; 0 in the goal, and along axes where no difference is finite.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        rows, shape = self._rows(states)
        out = np.empty_like(rows)
        gradient_rows(*self._packed, rows, out)
        outside = np.asarray(self.query.goal_distance(states) > 0)
        return np.where(outside[..., None], out.reshape(*shape, -1), 0.0)

    def _rows(self, states: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
        states = np.asarray(states, dtype=float)
        n = self.query.system.n
        if states.shape[-1:] != (n,):
            raise ValueError(f"states: expected [..., {n}], got shape {states.shape}")
        if not np.isfinite(states).all():
            raise ValueError("states: numbers must be finite")
        rows = np.require(states.reshape(-1, n), requirements=["C", "W"])
        return rows, states.shape[:-1]

    @cached_property
    def _packed(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What `interpolate_mesh` is given for values and geometry."""
        return self.mesh.packed(self.values), bellman_geometry(self.query, self.mesh.grid)


@dataclass(frozen=True, eq=False)
class MeshPolicy:
    """Feedback by one-step lookahead on a mesh's value; see `LookaheadPolicy` for its rules.

    Attributes:
        value: its value.
        margin: metres that the lookahead adds to the robot's radius around hard obstacles.
    """

    value: MeshValue
    margin: float = 0.0

    @property
    def query(self) -> Query:
        return self.value.query

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        """Inputs `[..., m]` at states `[..., n]`.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        rows, shape = self.value._rows(states)
        grid = self.value.mesh.grid
        free = ~np.array(grid.periodic)
        rows = np.where(free, np.clip(rows, grid.lower, grid.upper), rows)
        inputs = np.empty((len(rows), self.query.system.m))
        flat, _ = self.value._packed
        lookahead(rows, *self._arguments, flat, self._geometry.copy(), inputs)
        return inputs.reshape(*shape, -1)

    @cached_property
    def _geometry(self) -> NDArray[np.float64]:
        return bellman_geometry(self.query, self.value.mesh.grid, self.margin)

    @cached_property
    def _arguments(self):
        query = self.query
        candidates, spread = sampled_inputs(query)
        functions = bellman_addresses(query).copy()  # shared by all policies of such queries
        functions[2] = addresses([interpolate_mesh])[0]
        settings = bellman_settings(query, CELLS)
        return candidates, spread, ROUNDS, functions, parameters(query), settings

    def __getstate__(self) -> dict[str, Any]:
        """Without what holds addresses of this process."""
        return {name: self.__dict__[name] for name in ("value", "margin")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
