"""One step of the paper's law with any of its slips left in; symbols as in `paper_law`."""

import numpy as np
from numba import boolean, njit, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled


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


ASCENT, TERMINAL_EVERYWHERE, PLAIN_ACTOR, HALF_VECH, ESTIMATED_QUU = range(5)


@compiled(
    types.void(
        MATRIX,
        MATRIX,
        VECTOR,
        MATRIX,
        MATRIX,
        MATRIX,
        MATRIX,
        VECTOR,
        boolean[::1],
        VECTOR,
        MATRIX,
        MATRIX,
    )
)
def paper_step(
    past, stored, times, M, R, terminal, inverse, gains, slips, critic, actor, excitation
):
    """Euler step of (22) and (23).

    `past` is U at the samples of [t - Delta t, t]; `stored` the remembered states; `times` is nu at
    t, in e_c1's delayed term, in sigma's delayed term, and at T; `inverse` is Q_uu^-1; `gains` is
    the step, alpha_c and alpha_a; `slips` says which are left in.
    """
    n, m, count = M.shape[0], R.shape[0], critic.shape[0]
    step, critic_gain, actor_gain = gains[0], gains[1], gains[2]
    last = past.shape[0] - 1
    # The weights of a known Q_uu = R neither move nor depend on time.
    free = count if slips[ESTIMATED_QUU] else count - m * (m + 1) // 2
    doubled = 2.0 if slips[HALF_VECH] else 1.0
    first = n * (n + 1) // 2
    before, now = np.empty(count), np.empty(count)
    _products(past[0], n, before)
    _products(past[last], n, now)
    sigma = now - before
    error_1 = _dot(critic, sigma)
    for i in range(free):
        error_1 += critic[i] * ((times[0] - 1.0) * now[i] - (times[1] - 1.0) * before[i])
        sigma[i] = times[0] * now[i] - times[2] * before[i]
    for k in range(last):
        ends = _running_cost(past[k], M, R) + _running_cost(past[k + 1], M, R)
        error_1 += 0.5 * step * ends
    change = sigma * (error_1 / (1.0 + _dot(sigma, sigma)) ** 2)
    sign = 1.0 if slips[ASCENT] else -1.0
    U, at_end, wanted = np.empty(n + m), np.empty(count), np.empty(m)
    rows = 1 if slips[TERMINAL_EVERYWHERE] else stored.shape[0]
    for row in range(rows):
        if slips[TERMINAL_EVERYWHERE]:
            U[:] = past[last]
            nu = times[0]
        else:
            U[:n] = stored[row]
            nu = times[3]
            for k in range(m):
                weights = critic[first + k * n : first + (k + 1) * n]
                wanted[k] = doubled * nu * _dot(weights, U[:n])
            for k in range(m):
                U[n + k] = -_dot(inverse[k], wanted)
        _products(U, n, at_end)
        for i in range(free):
            at_end[i] *= nu
        error_2 = -_dot(critic, at_end)
        for i in range(n):
            for j in range(n):
                error_2 += 0.5 * U[i] * terminal[i, j] * U[j]
        scale = sign * error_2 / ((1.0 + _dot(at_end, at_end)) ** 2 * rows)
        for i in range(count):
            change[i] += at_end[i] * scale
    x = past[last, :n]
    mu_x = times[0] * x
    for k in range(m):
        weights = critic[first + k * n : first + (k + 1) * n]
        wanted[k] = doubled * times[0] * _dot(weights, x)
    scale = actor_gain * step
    if not slips[PLAIN_ACTOR]:
        scale /= 1.0 + _dot(mu_x, mu_x)
    for k in range(m):
        error_a = _dot(inverse[k], wanted)
        for i in range(n):
            error_a += actor[i, k] * mu_x[i]
        for i in range(n):
            actor[i, k] -= scale * (x[i] if slips[PLAIN_ACTOR] else mu_x[i]) * error_a
    for i in range(free):
        critic[i] -= step * critic_gain * change[i]
    _excite(excitation, sigma, step)
