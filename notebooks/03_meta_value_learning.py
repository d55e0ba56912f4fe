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
# # Meta value learning, step by step
#
# A network that knows the query answers at once; exact trajectories then replace it where the robot
# will be. At each step: the policy's cost against the exact optimum, and where the network's value
# is wrong.

# %%
import matplotlib.pyplot as plt
import numpy as np

from learning import MetaPlanner
from ocp import exact_trajectory
from ocp.eikonal import solve_eikonal
from ocp.query_family import PAPER_FIGURE_STARTS, paper_query
from sims.closed_loop import rollouts
from sims.pictures.plan_figure import draw_plan, least_over_other_coordinates

query = paper_query((1.3, 3.4))
starts = [np.array(s) for s in PAPER_FIGURE_STARTS]
optima = [exact_trajectory(query, s) for s in starts]
best = sum(motion.cost for motion in optima)

# %%
planner = MetaPlanner.pretrained("paper")
state = planner.start(query, starts)
print("step  trajectories   cost over the optimum, all starts")
step, excesses = 0, []
while True:
    loops = rollouts(planner.policy(state), starts)
    reached = [loop.cost for loop in loops if loop.cost is not None]
    assert len(reached) == len(starts)
    excesses.append(sum(reached) / best - 1)
    print(f"{step:4d}  {state.trajectories:12d}   {excesses[-1]:.4%}")
    if state.finished or step == len(starts) + 1:
        break
    state = planner.refine(state)
    step += 1
assert excesses[-1] <= excesses[0] + 1e-4
assert excesses[-1] < 0.005

# %% [markdown]
# ## Where the network's value is wrong
#
# Against a fine grid, least over heading. The largest errors lie where two ways are equally good:
# there V has a kink that a smooth network rounds off.

# %%
fine = solve_eikonal(query, nodes=240_000).value
x, y, exact = least_over_other_coordinates(query, fine, 61)
_, _, learned = least_over_other_coordinates(query, state.network, 61)
outside = exact > 0.5
error = np.where(outside, 100 * (learned / np.where(outside, exact, 1.0) - 1), np.nan)
print(f"median |error| {np.nanmedian(np.abs(error)):.2f} %, "
      f"95 % {np.nanpercentile(np.abs(error), 95):.2f} %")  # fmt: skip
figure, axes = plt.subplots(1, 2, figsize=(11.5, 4.8), layout="constrained")
limit = float(np.nanpercentile(np.abs(error), 99))
shown = axes[0].pcolormesh(x, y, error.T, cmap="RdBu_r", vmin=-limit, vmax=limit)
figure.colorbar(shown, ax=axes[0], label="network over grid, %")
axes[0].set(xlabel="x (m)", ylabel="y (m)", title="value error before adaptation", aspect="equal")
draw_plan(axes[1], query, loops, optima)
axes[1].set_title("closed loops after adaptation")
plt.show()

# %% [markdown]
# ## Its gradient against the costate
#
# Along an optimal trajectory the costate is the gradient of V.

# %%
motion = optima[0]
assert motion.costates is not None
inside = query.goal_distance(motion.states) > 0.05
gradient = np.asarray(state.network.gradient(motion.states[inside]))
figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
for i, name in enumerate(("x", "y", "heading")):
    (line,) = axes.plot(motion.times, motion.costates[:, i], label=name)
    axes.plot(motion.times[inside], gradient[:, i], "--", color=line.get_color())
axes.set(xlabel="time (s)", title="costate (lines), gradient of the network (dashed)")
axes.legend(frameon=False)
plt.show()
scale = np.abs(motion.costates).max()
difference = np.abs(gradient - motion.costates[inside]).max(axis=1) / scale
print(f"median difference {np.median(difference):.2%} of the largest costate")
