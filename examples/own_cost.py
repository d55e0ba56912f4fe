"""A running cost of one's own: slow ground, the policy around it, the exact optimum beside."""

import casadi as ca
import numpy as np

from ocp import Goal, Query, RunningCost, exact_trajectory
from ocp.eikonal import solve_eikonal
from sims import rollout

x = ca.SX.sym("x", 3)  # pyright: ignore[reportArgumentType]
mud = 3 / (1 + ca.exp(-4 * (x[1] - 1.5)))  # a cost a second for being above y = 1.5
query = Query(
    "unicycle", Goal((4.0, 4.0), 0.5), cost=RunningCost(own=ca.Function("mud", [x], [mud]))
)
start = np.array([-4.0, 3.0, 0.0])
loop = rollout(solve_eikonal(query).policy(), start)
truth = exact_trajectory(query, start)
print(f"closed loop {loop.cost:.3f}, exact {truth.cost:.3f}")
