"""How long an update and a sweep of the learner take, by the number of states."""

from pathlib import Path
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.learned_regulator import solve_backward
from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import WindowRegression
from sims.regulation.regulate import SUBSTEPS
from sims.regulation.simulation import LinearPlant, probed_motions

Array = NDArray[np.float64]


def times(out: Path | None = None) -> None:
    print("CPU time, median of 30: one update (a window), one sweep over 10 s")
    sizes = (1, 2, 4, 6, 8, 10, 12, 16, 20)
    updates, sweeps = [], []
    for n in sizes:
        m = max(1, n // 2)
        update, sweep = time_of(n, m)
        updates.append(update)
        sweeps.append(sweep)
        print(f"n = {n:2d}, m = {m:2d}: update {1e6 * update:8.1f} us, sweep {1e3 * sweep:7.2f} ms")
    if out is not None:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
        axes.loglog(sizes, updates, "o-", color="#0072B2", label="update (one window)")
        axes.loglog(sizes, sweeps, "s-", color="#D55E00", label="backward sweep")
        axes.set_xlabel("states n (inputs n/2)")
        axes.set_ylabel("CPU seconds")
        axes.legend()
        figure.savefig(out / "q-learning-times.png", dpi=110)
        plt.close(figure)


def time_of(n: int, m: int, repetitions: int = 30) -> tuple[float, float]:
    """Median CPU seconds of an update and of a sweep for a random stable plant."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n)) / np.sqrt(n)
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(n)
    B = rng.normal(size=(n, m))
    data = WindowRegression(n, m, 0.01, SUBSTEPS, 1, 1.0)
    plant = LinearPlant(A, B)
    holds = data.p + 2 * repetitions
    states, inputs = probed_motions(
        plant, rng.normal(size=n), holds * SUBSTEPS * 0.01, 0.01, SUBSTEPS, 1.0, 0 * B.T, 0.0, [0]
    )
    first = data.p + repetitions
    data.absorb(states[0][: first * SUBSTEPS + 1], inputs[0][:first])
    seconds = [
        data.absorb(states[0][k * SUBSTEPS : (k + 1) * SUBSTEPS + 1], inputs[0][k : k + 1])
        for k in range(first, first + repetitions)
    ]
    cost = QuadraticCost(10 * np.eye(n), 2 * np.eye(m), 0.5 * np.eye(n), 10.0)
    theta = exact_map(A, B)
    sweeps = []
    for _ in range(repetitions):
        begun = thread_time()
        solve_backward(cost, theta, False)
        sweeps.append(thread_time() - begun)
    return float(np.median(seconds)), float(np.median(sweeps))


def exact_map(A: Array, B: Array) -> Array:
    """Theta `[p, q]` of a known plant."""
    n, m = B.shape
    rows, columns = np.triu_indices(n)
    q = len(rows)
    theta = np.zeros((q + m * n, q))
    for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
        P = np.zeros((n, n))
        P[i, j] = P[j, i] = 1.0 if i == j else 0.5
        H = A.T @ P + P @ A
        theta[:q, k] = H[rows, columns] * np.where(rows == columns, 1.0, 2.0)
        theta[q:, k] = 2.0 * (B.T @ P).ravel()
    return theta
