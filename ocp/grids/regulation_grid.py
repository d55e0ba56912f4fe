"""The value of regulation to an equilibrium on a grid, by value iteration.

It starts from what the linear regulator really costs, where that comes to rest (regulator_loop.py):
without, interpolation in the narrow valley at the equilibrium makes all of V dear.
"""

import numpy as np

from ocp.compiled.batch import state_costs
from ocp.grid import Grid, GridValue
from ocp.grids.regulator_loop import regulator_costs
from ocp.grids.value_iteration import iterate_values
from ocp.query import Query
from ocp.regulation import RegulatorValue
from ocp.trajectory import SolveError, Status

MAX_STATES = 4
NODES = {1: 400, 2: 20_000, 3: 100_000, 4: 400_000}
CAP_SECONDS = 100.0  # at the largest cost rate: no optimal motion costs as much
HELD_CELLS = 2.0  # from the equilibrium, where the linear regulator's value is held


def solve_regulation_grid(query: Query, grid: Grid | None = None) -> GridValue:
    """V on a grid; the regulator's x'P x holds next to the equilibrium.

    The grid's box constrains the motion: near its faces V is too large.

    Args:
        query: with an `Equilibrium` as its goal, of a robot with at most 4 states.
        grid: by default one of the size that its dimension allows.

    Raises:
        SolveError: NOT_APPLICABLE, with what a grid would need; NOT_CONVERGED.
        ValueError: if the equilibrium cannot be stabilised.
    """
    system = query.system
    if not query.is_regulation:
        raise SolveError(Status.NOT_APPLICABLE, "value iteration: the goal is no equilibrium")
    if system.n > MAX_STATES:
        nodes = 40**system.n
        raise SolveError(
            Status.NOT_APPLICABLE,
            f"value iteration: {system.name} has {system.n} states; 40 nodes an axis are "
            f"{nodes:.1e} nodes, {nodes * 8 / 1e9:.1e} GB",
        )
    grid = grid or Grid.for_query(query, NODES[system.n])
    nodes = grid.nodes()
    cells = np.abs(system.difference(nodes, query.reference)) / grid.spacing
    near = (cells <= HELD_CELLS).all(axis=-1)
    held = np.where(near, RegulatorValue(query).value(nodes), np.inf)
    # From infinite values the scheme can lock: nodes whose motions end among each other wait for
    # one another for ever. A finite bound lets values fall; where they do not, there is no motion.
    cap = CAP_SECONDS * float(state_costs(query, nodes.reshape(-1, system.n)).max())
    bound = np.fmin(cap, regulator_costs(query, grid))
    values = iterate_values(query, grid, bound, held=held).checked().values
    return GridValue(grid, np.where(values < 0.5 * cap, values, np.inf))
