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
# # Analytic LQR against everything
#
# A double integrator with a quadratic cost has a solution on paper. Riccati (python-control
# and Drake), Pontryagin shooting and direct collocation are four roads to it.

# %%
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import expm

from ocp import Goal, Query, RunningCost
from ocp.collocation import solve_collocation
from ocp.extremals.fixed_time import solve_fixed_time
from ocp.riccati import LinearQuadratic, algebraic_riccati, differential_riccati

M, R = ((2.0, 0.2), (0.2, 1.0)), (0.5,)
query = Query(
    "double-integrator-1d", Goal((0.0,), 0.1), cost=RunningCost(goal=0.0, state=M, input=R)
)
problem = LinearQuadratic.of_query(query)
terminal, horizon, start = np.diag([1.0, 0.5]), 3.0, np.array([1.0, 2.0])

# %% [markdown]
# The matrix exponential of the Hamiltonian matrix gives P(0) in closed form (Radon's lemma).

# %%
S = problem.B @ np.linalg.solve(problem.R, problem.B.T)
hamiltonian = np.block([[problem.A, -S], [-problem.M, -problem.A.T]])
both = expm(-hamiltonian * horizon) @ np.vstack([np.eye(2), terminal])
P = both[2:] @ np.linalg.inv(both[:2])
value = float(start @ P @ start)

riccati = differential_riccati(problem, terminal, horizon)
motion = solve_fixed_time(query, start, horizon, terminal)
collocation = solve_collocation(query, start, horizon=horizon, terminal_cost=terminal)
end = collocation.states[-1]
errors = {
    "differential Riccati (Drake)": abs(float(riccati.value(start)) / value - 1),
    "Pontryagin shooting": abs(motion.value / value - 1),
    "its Hessian": float(np.abs(motion.hessian / 2 - P).max() / np.abs(P).max()),
    "collocation": abs((collocation.cost + end @ terminal @ end) / value - 1),
}
for name, error in errors.items():
    print(f"{name:30s} {error:.1e}")
assert max(errors.values()) < 1e-6

# %% [markdown]
# With a long horizon the differential equation tends to the algebraic one.

# %%
steady = algebraic_riccati(problem)
horizons = np.array([0.5, 1, 2, 4, 8, 16])
gaps = [np.abs(differential_riccati(problem, terminal, h).P() - steady.P()).max() for h in horizons]
print("python-control at infinity, Drake at 16 s:", f"{gaps[-1]:.1e}")
assert gaps[-1] < 1e-8

# %%
figure, axes = plt.subplots(1, 2, figsize=(10.5, 3.8), layout="constrained")
assert motion.trajectory.costates is not None
times = motion.trajectory.times
axes[0].plot(times, motion.trajectory.inputs, label="Pontryagin")
axes[0].plot(collocation.times, collocation.inputs, ".", label="collocation")
exact = riccati.input(motion.trajectory.states, times)
axes[0].plot(times, exact, "--", label="Riccati feedback")
axes[0].set(xlabel="time (s)", ylabel="input")
axes[0].legend(frameon=False)
axes[1].semilogy(horizons, gaps, "o-")
axes[1].set(xlabel="horizon (s)", ylabel="largest entry of P(0) - P")
plt.show()
