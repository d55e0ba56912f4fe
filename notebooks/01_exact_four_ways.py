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
# # Exact four ways
#
# One optimal control problem, four methods that share nothing but its definition: the closed form,
# Pontryagin's minimum principle, direct collocation and a grid. Where all apply, they must agree.

# %%
import matplotlib.pyplot as plt
import numpy as np

from ocp import exact_trajectory
from ocp.closed_form import straight_value
from ocp.collocation import solve_collocation
from ocp.eikonal import solve_eikonal
from ocp.query_family import PAPER_START, paper_query
from sims.closed_loop import rollout
from sims.pictures.plan_figure import draw_plan

# %% [markdown]
# ## Facing the goal
#
# Without obstacles, a unicycle that faces the goal drives straight: $V = 2\int\sqrt{Q}\,ds$.

# %%
plain = paper_query((4.0, 4.0))
grid = solve_eikonal(plain)
rows = []
for distance in (1.0, 2.0, 4.0, 6.0, 8.0):
    offset = distance * np.array([np.cos(0.7), np.sin(0.7)])
    state = np.array([4.0 - offset[0], 4.0 - offset[1], 0.7])
    exact = straight_value(plain, state)
    others = (
        exact_trajectory(plain, state).cost,
        solve_collocation(plain, state).cost,
        float(grid.value.value(state)),
    )
    rows.append((distance, exact, *(abs(other / exact - 1) for other in others)))
print("distance    closed form   PMP      collocation  grid (relative errors)")
for distance, exact, pmp, collocation, on_grid in rows:
    print(f"{distance:6.1f} m  {exact:12.6f}   {pmp:.1e}  {collocation:.1e}      {on_grid:.1e}")
assert max(row[2] for row in rows) < 1e-6
assert max(row[3] for row in rows) < 1e-5

# %% [markdown]
# ## Among obstacles
#
# No closed form is left; the other three still have to agree. The start is the paper's.

# %%
query = paper_query((1.0, 4.0))
start = np.array(PAPER_START)
motion = exact_trajectory(query, start)
collocation = solve_collocation(query, start)
solution = solve_eikonal(query)
loop = rollout(solution.policy(), start)
assert loop.cost is not None
print(f"PMP          {motion.cost:.5f}")
print(f"collocation  {collocation.cost:.5f}   ({collocation.cost / motion.cost - 1:+.1e})")
print(f"grid value   {float(solution.value.value(start)):.5f}")
print(f"closed loop  {loop.cost:.5f}   ({loop.cost / motion.cost - 1:+.1e})")
assert abs(collocation.cost / motion.cost - 1) < 1e-4

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
draw_plan(axes[0], query, [loop], [motion], solution.value)
assert motion.costates is not None
assert collocation.costates is not None
for i, name in enumerate(("x", "y", "heading")):
    (line,) = axes[1].plot(motion.times, motion.costates[:, i], label=f"costate of {name}")
    axes[1].plot(collocation.times, collocation.costates[:, i], ".", color=line.get_color())
axes[1].set(xlabel="time (s)", ylabel="costate", title="PMP (lines), collocation's duals (dots)")
axes[1].legend(frameon=False)
plt.show()
