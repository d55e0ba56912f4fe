"""One step of the paper's law, literal and repaired; symbols as in `paper_q_law`."""

import numpy as np
from numba import njit, types

from ocp.jit import MATRIX, VECTOR, compiled


@njit(cache=True, error_model="numpy")
def _products(U, n, out):
    """z(U) in the order xx, xu, uu."""
    size, index = U.shape[0], 0
    for i in range(n):
        for j in range(i, n):
            out[index] = U[i] * U[j]
            index += 1
    for k in range(n, size):
        for i in range(n):
            out[index] = U[k] * U[i]
            index += 1
    for k in range(n, size):
        for j in range(k, size):
            out[index] = U[k] * U[j]
            index += 1


@njit(cache=True, error_model="numpy")
def _running_cost(U, M, R):
    """(x'Mx + u'Ru)/2."""
    n, total = M.shape[0], 0.0
    for i in range(n):
        for j in range(n):
            total += U[i] * M[i, j] * U[j]
    for i in range(R.shape[0]):
        for j in range(R.shape[0]):
            total += U[n + i] * R[i, j] * U[n + j]
    return 0.5 * total


@njit(cache=True, error_model="numpy")
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(cache=True, error_model="numpy")
def _excite(excitation, sigma, step):
    """Add Delta Delta' dt, Delta = sigma/(1 + sigma'sigma) (Lemma 4.2)."""
    scale = step / (1.0 + _dot(sigma, sigma)) ** 2
    for i in range(sigma.shape[0]):
        for j in range(sigma.shape[0]):
            excitation[i, j] += scale * sigma[i] * sigma[j]


@compiled(
    types.void(MATRIX, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX)
)
def literal_step(past, times, M, R, terminal, inverse, gains, critic, actor, excitation):
    """`past` is U(t - Delta t), U(t); `times` is nu(t), nu(t - T); `inverse` is Q_uu^-1."""
    n, m, count = M.shape[0], R.shape[0], critic.shape[0]
    step, critic_gain, actor_gain = gains[0], gains[1], gains[2]
    before, now = np.empty(count), np.empty(count)
    _products(past[0], n, before)
    _products(past[1], n, now)
    sigma = times[0] * (now - before)
    final = times[0] * now
    cost = 0.5 * step * (_running_cost(past[0], M, R) + _running_cost(past[1], M, R))
    error_1 = times[0] * _dot(critic, now) - times[1] * _dot(critic, before) + cost
    at_end = 0.0
    for i in range(n):
        for j in range(n):
            at_end += 0.5 * past[1, i] * terminal[i, j] * past[1, j]
    error_2 = at_end - _dot(critic, final)
    # e_a with the critic of this instant, before it moves.
    first = n * (n + 1) // 2
    wanted = np.zeros(m)
    for k in range(m):
        for i in range(n):
            wanted[k] += 2.0 * times[0] * critic[first + k * n + i] * past[1, i]
    error_a = np.zeros(m)
    for k in range(m):
        for i in range(n):
            error_a[k] += times[0] * actor[i, k] * past[1, i]
        for other in range(m):
            error_a[k] += inverse[k, other] * wanted[other]
    first_scale = error_1 / (1.0 + _dot(sigma, sigma)) ** 2
    second_scale = error_2 / (1.0 + _dot(final, final)) ** 2
    for i in range(count):
        critic[i] -= step * critic_gain * (sigma[i] * first_scale + final[i] * second_scale)
    for i in range(n):
        for k in range(m):
            actor[i, k] -= step * actor_gain * past[1, i] * error_a[k]
    _excite(excitation, sigma, step)


@compiled(
    types.void(
        MATRIX, MATRIX, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX
    )
)
def repaired_step(past, stored, times, M, R, terminal, inverse, gains, critic, actor, excitation):
    """`past` is U at the samples of [t - Delta t, t]; `times` is nu at t, t - Delta t and T."""
    n, m, count = M.shape[0], R.shape[0], critic.shape[0]
    step, critic_gain, actor_gain = gains[0], gains[1], gains[2]
    last = past.shape[0] - 1
    free = count - m * (m + 1) // 2
    before, now = np.empty(count), np.empty(count)
    _products(past[0], n, before)
    _products(past[last], n, now)
    sigma = np.empty(count)
    for i in range(count):
        # The weights of Q_uu = R are known and do not depend on time.
        sigma[i] = times[0] * now[i] - times[1] * before[i] if i < free else now[i] - before[i]
    cost = 0.0
    for k in range(last):
        cost += 0.5 * step * (_running_cost(past[k], M, R) + _running_cost(past[k + 1], M, R))
    error_1 = _dot(critic, sigma) + cost
    change = sigma * (error_1 / (1.0 + _dot(sigma, sigma)) ** 2)
    first = n * (n + 1) // 2
    U, at_end = np.empty(n + m), np.empty(count)
    wanted = np.empty(m)
    for row in range(stored.shape[0]):
        x = stored[row]
        for k in range(m):
            wanted[k] = times[2] * _dot(critic[first + k * n : first + (k + 1) * n], x)
        U[:n] = x
        for k in range(m):
            U[n + k] = -_dot(inverse[k], wanted)
        _products(U, n, at_end)
        for i in range(free):
            at_end[i] *= times[2]
        error_2 = -_dot(critic, at_end)
        for i in range(n):
            for j in range(n):
                error_2 += 0.5 * x[i] * terminal[i, j] * x[j]
        scale = error_2 / ((1.0 + _dot(at_end, at_end)) ** 2 * stored.shape[0])
        for i in range(count):
            change[i] -= at_end[i] * scale
    x = past[last, :n]
    mu_x = times[0] * x
    for k in range(m):
        wanted[k] = times[0] * _dot(critic[first + k * n : first + (k + 1) * n], x)
    scale = actor_gain * step / (1.0 + _dot(mu_x, mu_x))
    for k in range(m):
        error_a = _dot(inverse[k], wanted) + _dot(actor[:, k].copy(), mu_x)
        for i in range(n):
            actor[i, k] -= scale * mu_x[i] * error_a
    for i in range(free):
        critic[i] -= step * critic_gain * change[i]
    _excite(excitation, sigma, step)
