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
# # Bring your own robot from SDF
#
# A file that Drake can read is all that is asked for: the equations of motion, the exact swing-up,
# the feedback policy and the simulation that judges it follow. The robot here is a Furuta pendulum,
# which no part of the library knows.

# %%
import logging
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML, display
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.primitives import Linearize

from ocp import Query, RunningCost, greedy
from ocp.compiled.batch import rates
from ocp.models.multibody import multibody_model
from ocp.oracle import consult
from ocp.query import Equilibrium
from ocp.regulation import regulator
from ocp.regulation_value import RegulationValue
from sims.closed_loop import LoopSettings, drake_rollout
from sims.pictures.skeleton import OBLIQUE, Skeleton, draw_strobe, save_robot_replay

logging.getLogger("drake").setLevel(logging.WARNING)
here = Path.cwd()
root = next(folder for folder in (here, *here.parents) if (folder / "examples").is_dir())
robot = multibody_model(root / "examples" / "furuta.sdf")
for c in (*robot.system.coordinates, *robot.system.inputs):
    print(f"{c.name:8s} {c.unit:6s} [{c.lower:.4g}, {c.upper:.4g}]")

# %% [markdown]
# ## The same robot as Drake's
#
# The compiled equations against Drake's own time derivatives, at random states and torques; and the
# linear regulator at the top, by python-control on our linearisation, against Drake's regulator on
# Drake's linearisation.

# %%
weights = np.diag([1.0, 5.0, 0.1, 0.1])
top = np.array([0.0, np.pi, 0.0, 0.0])
query = Query(
    robot.system,
    Equilibrium(state=tuple(top), radius=0.1),
    cost=RunningCost(goal=0.0, state=tuple(map(tuple, weights)), input=(5.0,)),
)
errors: dict[str, float] = {}

rng = np.random.default_rng(0)
states = rng.uniform(robot.system.lower, robot.system.upper, (200, 4))
torques = rng.uniform(-0.5, 0.5, (200, 1))
drake = robot.diagram()
context = drake.CreateDefaultContext()
theirs = np.empty_like(states)
for k, (state, torque) in enumerate(zip(states, torques, strict=True)):
    context.SetContinuousState(robot.to_drake(state))
    drake.get_input_port().FixValue(context, torque)
    derivative = drake.EvalTimeDerivatives(context).CopyToVector()
    theirs[k] = robot.from_drake(derivative)
errors["dynamics, against Drake"] = float(
    np.max(np.abs(rates(query, states, torques) - theirs) / (1 + np.abs(theirs)))
)

context.SetContinuousState(robot.to_drake(top))
drake.get_input_port().FixValue(context, np.zeros(1))
linear = Linearize(drake, context, equilibrium_check_tolerance=1e-6)
_, P = LinearQuadraticRegulator(linear.A(), linear.B(), weights, np.diag(query.input_weights))
order = np.ix_(robot.order, robot.order)
errors["regulator at the top, against Drake"] = float(
    np.abs(regulator(query).matrix - P[order]).max() / np.abs(P).max()
)

# %% [markdown]
# ## The exact swing-up
#
# Direct collocation and Pontryagin shooting, asked by the oracle; it calls a cost established only
# where both agree.

# %%
hanging = np.zeros(4)
verdict = consult(query, hanging)
assert verdict.established
assert verdict.best is not None
optimum = verdict.best
costs = {name: a.value for name, a in verdict.answers.items() if a.value is not None}
print("optimal cost:", {name: round(cost, 5) for name, cost in costs.items()})
errors["Pontryagin shooting, against collocation"] = abs(costs["PMP"] / costs["collocation"] - 1)

# %% [markdown]
# ## The policy, closed in Drake's Simulator
#
# V is known to second order around the optimum; its gradient gives the torque. How often must the
# motor hear from it?

# %%
value = RegulationValue(query)
value.add(optimum)
policy = greedy(query, value)
loops = {}
for period in (0.01, 0.005, 0.0025):
    loops[period] = drake_rollout(policy, hanging, LoopSettings(period=period))
    cost = loops[period].cost
    assert cost is not None
    errors[f"closed loop, {1e3 * period:g} ms samples, over the optimum"] = cost / optimum.cost - 1
print("errors")
for name, error in errors.items():
    print(f"  {name:52s} {error:.1e}")
assert errors["dynamics, against Drake"] < 1e-12
assert errors["regulator at the top, against Drake"] < 1e-6
assert -1e-6 < errors["closed loop, 2.5 ms samples, over the optimum"] < 0.005

# %%
skeleton = Skeleton.of(robot)
loop = loops[0.0025].trajectory
figure, axes = plt.subplots(1, 3, figsize=(13.5, 4.0), layout="constrained")
draw_strobe(axes[0], skeleton, loop, count=26, view=OBLIQUE)
axes[0].set_axis_off()
axes[0].set_title("swing-up; the way of the pole's tip")
for i, label in ((0, "arm"), (1, "pole")):
    (line,) = axes[1].plot(loop.times, loop.states[:, i], label=label)
    shown = optimum.times <= loop.times[-1]
    axes[1].plot(
        optimum.times[shown], optimum.states[shown, i], "--", color=line.get_color(), linewidth=3,
        alpha=0.4,
    )  # fmt: skip
axes[1].axhline(np.pi, color="grey", linewidth=0.8, linestyle=":")
axes[1].set(xlabel="time (s)", ylabel="angle (rad)", title="closed loop; optimum (dashed)")
axes[1].legend(frameon=False)
axes[2].plot(loop.times[1:], loop.inputs[1:, 0], label="closed loop")
axes[2].plot(optimum.times[shown], optimum.inputs[shown, 0], "--", label="optimum")
for limit in query.input_bounds:
    axes[2].axhline(limit[0], color="grey", linewidth=0.8, linestyle=":")
axes[2].set(xlabel="time (s)", ylabel="torque (N m)", title="the motor and its limits")
axes[2].legend(frameon=False)
plt.show()

# %% [markdown]
# The same in Meshcat: it plays in the page, and turns with the mouse.

# %%
with tempfile.TemporaryDirectory() as folder:
    page = Path(folder) / "replay.html"
    save_robot_replay(skeleton, loop, page)
    source = page.read_text(encoding="utf-8").replace("&", "&amp;").replace('"', "&quot;")
display(HTML(f'<div><iframe srcdoc="{source}" width="100%" height="420"></iframe></div>'))
