# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # RRT^X: a route repaired in milliseconds
#
# A tree of 5,000 nodes rooted at the goal, among twenty convex obstacles in a Drake SceneGraph. An
# obstacle appears on the route; the tree is repaired, not regrown. A visibility graph gives the
# true optimum beside each route.

# %%
import matplotlib.pyplot as plt
import numpy as np

from planners.rrtx import RRTX
from planners.solids import Solid
from planners.world import SceneWorld
from sims.benchmarks.rrtx_maps import HALF, obstacles_20
from sims.benchmarks.visibility_graph import shortest_way
from sims.pictures.planner_figure import draw_planner

problem = obstacles_20(0)
box = np.full(2, HALF)
world = SceneWorld(-box, box, problem.solids)
planner = RRTX(world, problem.goal, problem.start, 5000, padding=0.2, seed=0)


def optimum() -> float:
    bounds = (world.lower, world.upper)
    return shortest_way(
        world.obstacles.values(), planner.robot, planner.goal, planner.padding, 24, bounds
    )[0]


grown = planner.construction
first = planner.route.cost / optimum() - 1
print(f"grown     {1e3 * grown.seconds:7.1f} ms   route {planner.route.cost:.3f} m, "
      f"{first:.2%} over the optimum")  # fmt: skip

# %%
# A figure lives in one cell; the first panel is drawn before the obstacle appears.
figure, axes = plt.subplots(1, 2, figsize=(12, 5.4), layout="constrained")
draw_planner(axes[0], planner, colourbar=False)
axes[0].set_title(f"grown: {1e3 * grown.seconds:.0f} ms, {first:.2%} over the optimum")
middle = planner.route.points[len(planner.route.points) // 2]
planner.appear(Solid.ball([-18.0, -18.0], 0.1))  # so that the next change finds all code loaded
update = planner.appear(Solid.ball(middle, 1.0))
assert update.route is not None
excess = update.route.cost / optimum() - 1
print(f"repaired  {1e3 * update.seconds:7.1f} ms   route {update.route.cost:.3f} m, "
      f"{excess:.2%} over the optimum; {update.orphans} orphans")  # fmt: skip
assert excess < 0.02
assert update.route.certified
draw_planner(axes[1], planner, colourbar=False)
axes[1].set_title(f"repaired: {1e3 * update.seconds:.1f} ms, {excess:.2%} over the optimum")
figure.colorbar(axes[1].collections[0], ax=axes, label="cost-to-go (m)", shrink=0.8)
plt.show()

# %% [markdown]
# Run to its end, the repair leaves the same cost-to-go as Dijkstra's algorithm would; the obstacle
# taken away again, the former costs come back.

# %%
(handle,) = update.handles
planner.vanish(handle)
planner.settle()
errors = {
    "grown route, over the visibility graph's": first,
    "repaired route, over the visibility graph's": excess,
    "restored route, off the first one": abs(planner.route.cost / grown.route.cost - 1),
}
print("relative errors")
for name, error in errors.items():
    print(f"  {name:44s} {error:.1e}")
assert errors["restored route, off the first one"] < 1e-10
