"""The conditioned network without framework overhead: value, gradient, policy and closed loops.

Everything is one compiled call; matrix products go to BLAS in single precision, the rest is double.
It equals the torch network to some 1e-6 (tested), at some 20 microseconds for one state.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numba import float32, int64, types
from numpy.typing import ArrayLike, NDArray

from learning.conditioned.network_weights import NetworkWeights
from learning.conditioned.query_encoder import ENCODE, QueryEncoder, encode_state
from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.compiled.kernel_call import KernelCall
from ocp.kernels import Kernels, kernels
from ocp.query import Query

Floats = NDArray[np.float64]

BLOCK = 64  # states evaluated together: more do not fit the fast caches
WEIGHTS = float32[::1]
SIZES = int64[::1]

encode_at = function_at(ENCODE)
kernel_at = function_at(KERNEL)
scalar_at = function_at(SCALAR)

KNOWLEDGE = (ADDRESSES, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, WEIGHTS, SIZES)


@dataclass(frozen=True, eq=False)
class NetworkValue:
    """V of the conditioned network for one query; a `Value`.

    Attributes:
        encoder: of the query.
        weights: of the network.
    """

    encoder: QueryEncoder
    weights: NetworkWeights

    @property
    def query(self) -> Query:
        return self.encoder.query

    def value(self, states: ArrayLike) -> Floats:
        """V `[...]` at states `[..., 3]`; 0 in the goal.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        return self.value_and_gradient(states)[0]

    def gradient(self, states: ArrayLike) -> Floats:
        """grad V `[..., 3]` at states `[..., 3]`; 0 in the goal.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        return self.value_and_gradient(states)[1]

    def value_and_gradient(self, states: ArrayLike) -> tuple[Floats, Floats]:
        """V `[...]` and its gradient `[..., 3]` at states `[..., 3]`, at the latter's price."""
        rows, shape = _rows(states)
        values, gradients = np.empty(len(rows)), np.empty((len(rows), 3))
        _evaluate(*self.arguments, rows, values, gradients)
        return values.reshape(shape), gradients.reshape(*shape, 3)

    @cached_property
    def arguments(self):
        """What the kernels know of query and network, in the order of `KNOWLEDGE`."""
        functions, *numbers = self.encoder.arguments
        own = _addresses(kernels(self.query))
        functions = np.concatenate([functions, own])
        return functions, *numbers, self.weights.packed, self.weights.sizes

    def drive(self, starts: Floats, stride: float, most: int) -> tuple[Floats, NDArray[np.int64]]:
        """Closed loops of the greedy policy from states `[k, 3]`, in steps of length `stride`.

        The first `stride` goes in `FINE` steps: a random start may lie in a trap (see `_drive`).

        Returns:
            `[most, k, 7]`, each step's state, input, duration and the cost before it; and `[k]`,
            the number of steps after which the goal was reached, or -1 if it was not, or the
            robot shuttled.
        """
        path = np.empty((most, len(starts), 7))
        steps = _drive(*self.arguments, np.ascontiguousarray(starts, dtype=float), stride, path)
        return path, steps


@cache
def _addresses(of_query: Kernels) -> NDArray[np.intp]:
    functions = (of_query.dynamics, of_query.optimal_input, of_query.state_cost)
    return np.concatenate([addresses([f]) for f in (encode_state, *functions)])


@dataclass(frozen=True, eq=False)
class NetworkPolicy:
    """`greedy` for a `NetworkValue`, in one compiled call."""

    value: NetworkValue

    @property
    def query(self) -> Query:
        return self.value.query

    @property
    def kernel_call(self) -> KernelCall:
        """The one compiled function behind the policy."""
        return KernelCall(_control, self.value.arguments)

    def __call__(self, states: ArrayLike) -> Floats:
        """Inputs `[..., 2]` at states `[..., 3]`; 0 in the goal."""
        rows, shape = _rows(states)
        inputs = np.empty((len(rows), 2))
        _control(*self.value.arguments, rows, inputs)
        return inputs.reshape(*shape, 2)


def _rows(states: ArrayLike) -> tuple[Floats, tuple[int, ...]]:
    states = np.asarray(states, dtype=float)
    if states.shape[-1:] != (3,) or not np.isfinite(states).all():
        raise ValueError(f"states: need finite numbers [..., 3], got shape {states.shape}")
    return np.require(states.reshape(-1, 3), requirements=["C"]), states.shape[:-1]


def _signature(*more):
    return types.void(*KNOWLEDGE, *more)


ONE, HALF, TWO, EIGHTH = np.float32(1), np.float32(0.5), np.float32(2), np.float32(0.125)
FINE = 6  # short steps of a loop, before those of its full stride
SATURATED = np.float32(17)  # beyond, the sigmoid is 0 or 1 in single precision
P0, P1, P2 = np.float32(135135), np.float32(17325), np.float32(378)
Q0, Q1, Q2, Q3 = np.float32(135135), np.float32(62370), np.float32(3150), np.float32(28)


@compiled(float32(float32))
def _sigmoid(z):
    """1 / (1 + exp(-z)) to 1e-7, by arithmetic that the compiler puts into vectors.

    (1 + tanh(z / 2)) / 2, where tanh(z / 8) is Lambert's continued fraction up to the seventh
    power, p / q, and its argument is doubled twice: tanh 2x = 2 p q / (p^2 + q^2) = a / b. Then
    1 + tanh 4x = (a + b)^2 / (a^2 + b^2) with a + b = (p + q)^2: no small difference for z < 0.
    """
    x = EIGHTH * max(-abs(z), -SATURATED)
    s = x * x
    p = x * (P0 + s * (P1 + s * (P2 + s)))
    q = Q0 + s * (Q1 + s * (Q2 + s * Q3))
    a, b = TWO * p * q, p * p + q * q
    c = (p + q) * (p + q)
    small = HALF * c * c / (a * a + b * b)
    return small if z < 0 else ONE - small


@compiled(types.void(types.Array(float32, 2, "C"), types.Array(float32, 2, "C")))
def _silu(z, slope):
    """z becomes silu(z), `slope` silu'(z)."""
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            gate = _sigmoid(z[i, j])
            value = z[i, j] * gate
            slope[i, j] = gate + value * (ONE - gate)
            z[i, j] = value


@compiled(_signature(MATRIX, VECTOR, MATRIX))
def _evaluate(
    functions, table, numbers, q, bare, obstacles, weights, sizes, states, values, gradients
):
    """V `[k]` and grad V `[k, 3]` at states `[k, 3]`."""
    S, F, M, T, K = sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]
    encode = encode_at(functions[3, 0], functions[3, 1])
    count = obstacles.shape[0]
    block = max(1, min(BLOCK, states.shape[0]))
    free = np.empty((block, 4))
    x, dx = np.empty((block, S)), np.empty((block, S, 3))
    f, df = np.empty((block, count, F)), np.empty((block, count, F, 3))

    # The packed matrices, each as inputs x outputs, then the biases.
    at = 0
    A = weights[at : at + F * M].reshape((F, M))
    at += F * M
    B = weights[at : at + S * M].reshape((S, M))
    at += S * M
    C = weights[at : at + M * M].reshape((M, M))
    at += M * M
    D = weights[at : at + M * T].reshape((M, T))
    at += M * T
    E = weights[at : at + S * T].reshape((S, T))
    at += S * T
    G = weights[at : at + T * T].reshape((T, T))
    at += T * T
    H = weights[at : at + T * K].reshape((T, K))
    at += T * K
    first_bias = weights[at : at + M]
    second_bias = weights[at + M : at + 2 * M]
    third_bias = weights[at + 2 * M : at + 2 * M + T]
    fourth_bias = weights[at + 2 * M + T : at + 2 * M + 2 * T]
    head_bias = weights[at + 2 * M + 2 * T : at + 2 * M + 2 * T + K]
    at += 2 * M + 2 * T + K
    # And as outputs x inputs, for the way back.
    A_back = weights[at : at + F * M].reshape((M, F))
    at += F * M
    B_back = weights[at : at + S * M].reshape((M, S))
    at += S * M
    C_back = weights[at : at + M * M].reshape((M, M))
    at += M * M
    D_back = weights[at : at + M * T].reshape((T, M))
    at += M * T
    E_back = weights[at : at + S * T].reshape((T, S))
    at += S * T
    G_back = weights[at : at + T * T].reshape((T, T))
    at += T * T
    H_back = weights[at : at + T * K].reshape((K, T))

    for begin in range(0, states.shape[0], block):
        k = min(block, states.shape[0] - begin)
        for i in range(k):
            encode(
                functions, table, numbers, q, bare, obstacles, states[begin + i], free[i], x[i],
                dx[i], f[i], df[i],
            )  # fmt: skip
        if count == 0:
            for i in range(k):
                values[begin + i] = free[i, 0]
                for j in range(3):
                    gradients[begin + i, j] = free[i, 1 + j]
            continue
        state = x[:k].astype(np.float32)
        obstacle = f[:k].copy().reshape((k * count, F)).astype(np.float32)

        # Forward.
        z1, g1 = np.dot(obstacle, A), np.empty((k * count, M), dtype=np.float32)
        shared = np.dot(state, B)
        for i in range(k):
            for o in range(count):
                for j in range(M):
                    z1[i * count + o, j] += shared[i, j] + first_bias[j]
        _silu(z1, g1)
        z2, g2 = np.dot(z1, C), np.empty((k * count, M), dtype=np.float32)
        z2 += second_bias
        _silu(z2, g2)
        total = np.zeros((k, M), dtype=np.float32)
        for i in range(k):
            for o in range(count):
                for j in range(M):
                    total[i, j] += z2[i * count + o, j]
        z3, g3 = np.dot(total, D), np.empty((k, T), dtype=np.float32)
        z3 += np.dot(state, E)
        z3 += third_bias
        _silu(z3, g3)
        z4, g4 = np.dot(z3, G), np.empty((k, T), dtype=np.float32)
        z4 += fourth_bias
        _silu(z4, g4)
        heads = np.dot(z4, H)

        # Backward from the least head.
        for i in range(k):
            least = 0
            for j in range(K):
                heads[i, j] += head_bias[j]
                if heads[i, j] < heads[i, least]:
                    least = j
            heads[i, 0] = heads[i, least]
            for j in range(T):
                g4[i, j] *= H_back[least, j]
        back3 = np.dot(g4, G_back)
        back3 *= g3
        by_state = np.dot(back3, E_back)
        by_total = np.dot(back3, D_back)
        for i in range(k):
            for o in range(count):
                for j in range(M):
                    g2[i * count + o, j] *= by_total[i, j]
        back1 = np.dot(g2, C_back)
        back1 *= g1
        by_obstacle = np.dot(back1, A_back)
        for i in range(k):
            for j in range(M):
                shared[i, j] = np.float32(0.0)
                for o in range(count):
                    shared[i, j] += back1[i * count + o, j]
        by_state += np.dot(shared, B_back)

        for i in range(k):
            n = float(heads[i, 0])
            extra = max(n, 0.0) + np.log1p(np.exp(-abs(n)))
            gate = 1.0 / (1.0 + np.exp(-n)) if n > -30.0 else np.exp(n)
            values[begin + i] = free[i, 0] * (1.0 + extra)
            for c in range(3):
                slope = 0.0
                for j in range(S):
                    slope += by_state[i, j] * dx[i, j, c]
                for o in range(count):
                    for j in range(F):
                        slope += by_obstacle[i * count + o, j] * df[i, o, j, c]
                gradients[begin + i, c] = free[i, 1 + c] * (1.0 + extra) + free[i, 0] * gate * slope
        for i in range(k):
            if free[i, 0] <= 0.0:  # in the goal
                values[begin + i] = 0.0
                gradients[begin + i] = 0.0


@compiled(_signature(MATRIX, MATRIX))
def _control(functions, table, numbers, q, bare, obstacles, weights, sizes, states, inputs):
    """Inputs `[k, m]`: the gradient's direction, and the size u' R u = W of time-free optima."""
    optimal_input = kernel_at(functions[5, 0], functions[5, 1])
    cost = scalar_at(functions[6, 0], functions[6, 1])
    n, m = states.shape[1], inputs.shape[1]
    values, gradients = np.empty(states.shape[0]), np.empty(states.shape)
    _evaluate(
        functions, table, numbers, q, bare, obstacles, weights, sizes, states, values, gradients
    )
    z = np.empty(2 * n)
    for i in range(states.shape[0]):
        z[:n] = states[i]
        z[n:] = gradients[i]
        optimal_input(z, q, inputs[i])
        effort = 0.0
        for j in range(m):
            effort += q[j] * inputs[i, j] ** 2
        if effort > 0.0:
            inputs[i] *= np.sqrt(cost(states[i], q) / effort)


@compiled(types.Array(int64, 1, "C")(*KNOWLEDGE, MATRIX, float64, types.Array(float64, 3, "C")))
def _drive(functions, table, numbers, q, bare, obstacles, weights, sizes, starts, stride, path):
    """Closed loops in midpoint steps, until the goal; the first `FINE` of them short.

    A random start may lie beside a kink of the learned V, where a robot can shuttle for ever; a
    long step would pass over it. Farther on the motion itself leads away from kinks. A loop whose
    input is reversed twice in succession is given up.

    Fills path `[s, k, n + m + 2]` with states, inputs, durations of steps and costs before them;
    returns the number of steps after which each was in the goal, or -1.
    """
    dynamics = kernel_at(functions[4, 0], functions[4, 1])
    state_cost = scalar_at(functions[6, 0], functions[6, 1])
    most, count, n = path.shape[0], starts.shape[0], starts.shape[1]
    m = path.shape[2] - n - 2
    steps = np.full(count, -1)
    active = np.arange(count)
    rate, half = np.empty(n), np.empty(n)
    x = starts.copy()
    spent = np.zeros(count)
    reversals = np.zeros(count, dtype=np.int64)
    left = count
    for s in range(most):
        length = stride / FINE if s < FINE else stride
        remaining = 0
        for a in range(left):
            i = active[a]
            path[s, i, :n] = x[i]
            path[s, i, n + m + 1] = spent[i]
            gap = math.hypot(x[i, 0] - numbers[0], x[i, 1] - numbers[1]) - numbers[2]
            if gap <= 0.0:
                steps[i] = s
                if s > 0:  # of the last step only the part outside the goal costs
                    for j in range(n):
                        half[j] = path[s - 1, i, j]
                    before = math.hypot(half[0] - numbers[0], half[1] - numbers[1]) - numbers[2]
                    part = before / (before - gap)
                    for j in range(n):
                        half[j] += 0.5 * part * (x[i, j] - half[j])
                    last = part * (stride / FINE if s <= FINE else stride)
                    last *= 2.0 * np.sqrt(state_cost(half, q))
                    path[s, i, n + m + 1] = path[s - 1, i, n + m + 1] + last
            elif reversals[i] < 2:
                active[remaining] = i
                remaining += 1
        left = remaining
        if left == 0 or s == most - 1:
            break
        now = np.empty((left, n))
        for a in range(left):
            now[a] = x[active[a]]
        inputs = np.empty((left, m))
        _control(functions, table, numbers, q, bare, obstacles, weights, sizes, now, inputs)
        for a in range(left):
            i = active[a]
            effort, along = 0.0, 0.0
            for j in range(m):
                effort += q[j] * inputs[a, j] ** 2
                along += q[j] * inputs[a, j] * path[s - 1, i, n + j] if s > 0 else 0.0
            reversals[i] = reversals[i] + 1 if along < 0.0 else 0
            h = length / max(np.sqrt(effort), 1e-12)
            dynamics(x[i], inputs[a], rate)
            for j in range(n):
                half[j] = x[i, j] + 0.5 * h * rate[j]
            dynamics(half, inputs[a], rate)
            spent[i] += 2.0 * np.sqrt(state_cost(half, q)) * length  # at the best speed
            for j in range(n):
                x[i, j] += h * rate[j]
            path[s, i, n : n + m] = inputs[a]
            path[s, i, n + m] = h
    return steps
