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
# # The set-valued method, and what its radius does
#
# Equation (7) of Xu and Zhu lets a step end at any grid point within $\alpha$ of where the robot
# arrives. Read as printed, $\alpha$ is free motion. Three readings are named options here; all are
# solved to their fixed point, by value iteration and by label setting.

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

from ocp import exact_trajectory
from ocp.grid import Grid
from ocp.query_family import PAPER_START, paper_query, sample_start
from ocp.set_valued import Image, Method, SetValuedSettings, solve_set_valued
from sims.closed_loop import rollout

query = paper_query((4.0, 4.0))
start = np.array(PAPER_START)
truth = exact_trajectory(query, start).cost
print(f"exact optimum {truth:.4f}")

# %% [markdown]
# ## Two solvers, one fixed point

# %%
values, seconds = {}, {}
for method in (Method.JACOBI, Method.LABEL_SETTING):
    solve_set_valued(query, method=method)
    begun = time.perf_counter()
    values[method] = solve_set_valued(query, method=method).value.values
    seconds[method] = time.perf_counter() - begun
    print(f"{method.name.lower():14s} {seconds[method]:.2f} s")
difference = np.nanmax(np.abs(values[Method.JACOBI] - values[Method.LABEL_SETTING]))
print(f"largest difference {difference:.1e}")
assert difference == 0.0

# %% [markdown]
# ## The readings of alpha
#
# `NEAREST` takes the nearest grid point, `BALL` any within alpha (the printed equation), `LATERAL`
# only those to the side of the motion. A value below the optimum is impossible to drive.

# %%
spacing = 10 / 57
readings = {
    "nearest node": SetValuedSettings(),
    "ball, 0.87 h": SetValuedSettings(image=Image.BALL, radius=0.866 * spacing),
    "ball, 2 h": SetValuedSettings(image=Image.BALL, radius=2 * spacing),
    "lateral, h / 2": SetValuedSettings(image=Image.LATERAL, radius=0.5 * spacing),
}
found = {}
print("reading           value at start   closed loop   over the optimum")
for name, settings in readings.items():
    solution = solve_set_valued(query, settings=settings)
    loop = rollout(solution.policy(), start)
    value = float(solution.value.value(start))
    found[name] = value
    cost = (
        "never arrives"
        if loop.cost is None
        else f"{loop.cost:10.3f}      {loop.cost / truth - 1:+.1%}"
    )
    print(f"{name:16s}  {value:10.3f}     {cost}")
assert found["ball, 2 h"] < 0.6 * truth
assert abs(found["lateral, h / 2"] / truth - 1) < 0.05

# %% [markdown]
# ## Does it converge?
#
# Values at twelve random states against exact trajectories, grid after grid: with a step at a fixed
# ratio to the spacing h, and with one that shrinks slower than h, as the convergence theorem asks.
# At the fixed ratio, nearest node and ball settle on a wrong limit.

# %%
rng = np.random.default_rng(1)
states = [sample_start(query, rng) for _ in range(12)]
exact = np.array([exact_trajectory(query, state).cost for state in states])
CELLS = (29, 41, 58, 82)
COARSEST = 10 / (CELLS[0] - 1)


def median_error(cells: int, image: Image, alpha: float | None, power: float) -> float:
    """Of values on one grid; `alpha` in spacings, the step proportional to spacing ** power."""
    grid = Grid.of(query.system, (cells, cells, round(0.61 * cells)))
    h = 10 / (cells - 1)
    step = 2.28 * COARSEST * (h / COARSEST) ** power
    radius = None if alpha is None else alpha * h
    chosen = SetValuedSettings(image=image, radius=radius, step=step)
    found = solve_set_valued(query, grid, chosen).value.value(np.array(states))
    return float(np.median(np.abs(found / exact - 1)))


studies = {
    "nearest node, step ~ h": (Image.NEAREST, None, 1.0),
    "nearest node, step ~ √h": (Image.NEAREST, None, 0.5),
    "ball 0.87 h, step ~ h": (Image.BALL, 0.866, 1.0),
    "ball 0.87 h, step ~ √h": (Image.BALL, 0.866, 0.5),
    "lateral h / 2, step ~ h": (Image.LATERAL, 0.5, 1.0),
}
curves = {name: [median_error(cells, *study) for cells in CELLS] for name, study in studies.items()}
print("median value error      " + "".join(f"{cells:4d} cells" for cells in CELLS))
for name, errors in curves.items():
    print(f"{name:24s}" + "".join(f"{error:10.1%}" for error in errors))
assert curves["nearest node, step ~ h"][-1] > curves["nearest node, step ~ h"][0]
assert curves["nearest node, step ~ √h"][-1] < curves["nearest node, step ~ h"][-1]
assert curves["ball 0.87 h, step ~ √h"][-1] < 0.8 * curves["ball 0.87 h, step ~ √h"][0]
assert curves["lateral h / 2, step ~ h"][-1] < 0.6 * curves["lateral h / 2, step ~ h"][0]

# %%
figure, axes = plt.subplots(1, 2, figsize=(11.5, 4.0), layout="constrained")
axes[0].barh(list(found), list(found.values()), color="#0072B2")
axes[0].axvline(truth, color="#D55E00", label=f"exact optimum {truth:.1f}")
axes[0].set(xlabel="value at the paper's start", xlim=(0, 33), title="what alpha does")
axes[0].legend(frameon=False, loc="lower right")
for (name, errors), mark in zip(curves.items(), "oosso"[: len(curves)], strict=True):
    line = "-" if name.endswith("~ h") else "--"
    axes[1].loglog(
        [10 / (c - 1) for c in CELLS], [100 * e for e in errors], mark + line, label=name
    )
axes[1].set(xlabel="spacing h (m)", ylabel="median value error (%)", title="convergence")
axes[1].set_xticks([0.15, 0.2, 0.3], ["0.15", "0.2", "0.3"])
axes[1].minorticks_off()
axes[1].set_yticks([2, 5, 10, 20], ["2", "5", "10", "20"])
axes[1].grid(alpha=0.25)
axes[1].legend(frameon=False, fontsize=8)
plt.show()
