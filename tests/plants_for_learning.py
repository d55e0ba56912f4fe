"""Plants for the tests of learning, and an oracle of the optimal gain that shares no code."""

import numpy as np
from scipy.linalg import expm


class HiddenPlant:
    """A robot to be driven, not looked into: `step(u)` holds an input for `period` seconds."""

    __slots__ = ("_step", "state")

    def __init__(self, A, B, start, period, drift=None):
        n, m = np.shape(B)
        block = np.zeros((n + m + 1, n + m + 1))
        block[:n] = np.column_stack([A, B, np.zeros(n) if drift is None else drift])
        power = expm(block * period)[:n]
        self.state = np.array(start, dtype=float)
        self._step = lambda x, u: power @ np.concatenate([x, u, [1.0]])

    def step(self, u):
        self.state = self._step(self.state, u)
        return self.state


def optimal_gains(A, B, M, R, terminal, horizon, times):
    """K at `times` by short steps of the Hamiltonian matrix exponential (Radon's lemma)."""
    n = len(A)
    S = B @ np.linalg.solve(R, B.T)
    count = int(max(200, 40 * horizon * (1 + np.linalg.norm(A, 2))))
    step = horizon / count
    power = expm(-np.block([[A, -S], [-M, -A.T]]) * step)
    P = np.array(terminal, dtype=float)
    table = [P]
    for _ in range(count):
        both = power @ np.vstack([np.eye(n), P])
        P = both[n:] @ np.linalg.inv(both[:n])
        P = (P + P.T) / 2
        table.append(P)
    gains = []
    for t in times:
        to_go = horizon - t
        k = min(int(to_go / step), count)
        rest = expm(-np.block([[A, -S], [-M, -A.T]]) * (to_go - k * step))
        both = rest @ np.vstack([np.eye(n), table[k]])
        gains.append(np.linalg.solve(R, B.T @ both[n:] @ np.linalg.inv(both[:n])))
    return np.array(gains)


def exact_map(A, B):
    """Theta of a known plant, monomial by monomial from the definition."""
    n, m = np.shape(B)
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    theta = np.zeros((len(pairs) + m * n, len(pairs)))
    for column, (i, j) in enumerate(pairs):
        # d(x_i x_j)/dt = x_j (A x + B u)_i + x_i (A x + B u)_j
        for a, b in ((i, j), (j, i)):
            for k in range(n):
                theta[pairs.index((min(b, k), max(b, k))), column] += A[a, k]
            for k in range(m):
                theta[len(pairs) + k * n + b, column] += B[a, k]
    return theta


def held_motion(A, B, start, period, substeps, inputs, drift=None):
    """States `[k s + 1, n]` while each of `inputs` `[k, m]` is held for `substeps` periods."""
    plant = HiddenPlant(A, B, start, period, drift)
    states = [plant.state]
    for u in inputs:
        states.extend(plant.step(u) for _ in range(substeps))
    return np.array(states)
