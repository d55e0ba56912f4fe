"""Looking up `goal_table`: cubic (Catmull-Rom) in u and s, compiled.

`numbers` is [centre x, y, goal radius, turning length, first u, step in u, what is added to rho].
"""

import math

import numpy as np
from numba import int64, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64


@compiled(types.UniTuple(float64, 4)(float64))
def _weights(t):
    """Of the four values around a point at fraction `t` between the middle two."""
    return (
        0.5 * ((2.0 - t) * t - 1.0) * t,
        0.5 * (3.0 * t - 5.0) * t * t + 1.0,
        0.5 * ((4.0 - 3.0 * t) * t + 1.0) * t,
        0.5 * (t - 1.0) * t * t,
    )


@compiled(types.UniTuple(float64, 4)(float64))
def _slopes(t):
    """Derivatives of `_weights`."""
    return (
        0.5 * ((4.0 - 3.0 * t) * t - 1.0),
        0.5 * (9.0 * t - 10.0) * t,
        0.5 * ((8.0 - 9.0 * t) * t + 1.0),
        0.5 * (3.0 * t - 2.0) * t,
    )


@compiled(types.Tuple((int64, float64))(float64, int64))
def _cell(u, count):
    """The cell of a padded axis that holds `u`, and the fraction in it (beyond [0, 1] outside)."""
    i = min(max(int(u), 0), count - 4)
    return i, u - i


@compiled(types.UniTuple(float64, 3)(MATRIX, float64, float64, VECTOR))
def _lookup(table, distance, psi, numbers):
    """V, dV/dd and dV/dpsi at `distance` > 0 from the boundary, 0 <= psi <= pi / 2."""
    radius, unit, soft = numbers[2], numbers[3], numbers[6]
    rho = math.sqrt(distance / unit)
    touch = math.acos(radius / (radius + distance))
    width = psi + touch
    ends = 1.0 + 2.0 * touch / math.pi
    columns = table.shape[1] - 3
    i, t = _cell((math.log(rho + soft) - numbers[4]) / numbers[5], table.shape[0])
    j, w = _cell(ends * psi / width * columns, table.shape[1])
    down, down_slope, along, along_slope = _weights(t), _slopes(t), _weights(w), _slopes(w)
    G, G_d, G_s = 0.0, 0.0, 0.0
    for k in range(4):
        line, tilt = 0.0, 0.0
        for m in range(4):
            line += along[m] * table[i + k, j + m]
            tilt += along_slope[m] * table[i + k, j + m]
        G += down[k] * line
        G_d += down_slope[k] * line / numbers[5]
        G_s += down[k] * tilt * columns
    rho_d = 0.5 * rho / distance
    touch_d = radius / (radius + distance) / math.sqrt(distance * (2.0 * radius + distance))
    s_psi = ends * touch / width**2
    s_d = (2.0 / math.pi * psi / width - ends * psi / width**2) * touch_d
    bottom = math.sin(psi) + 0.5 * touch
    scale = rho**3 / bottom
    V = G * scale
    V_d = (G_d * rho_d / (rho + soft) + G_s * s_d) * scale
    V_d += V * (3.0 * rho_d / rho - 0.5 * touch_d / bottom)
    V_psi = G_s * s_psi * scale - V * math.cos(psi) / bottom
    return V, V_d, V_psi


@compiled(types.UniTuple(float64, 2)(float64))
def _fold(angle):
    """psi in [0, pi / 2] for a heading `angle` away from the ray, and d psi / d angle."""
    angle -= math.pi * math.floor(angle / math.pi + 0.5)
    return (0.5 * math.pi - angle, -1.0) if angle >= 0.0 else (0.5 * math.pi + angle, 1.0)


@compiled(types.void(MATRIX, MATRIX, VECTOR, VECTOR))
def look_up_values(table, states, numbers, out):
    for row in range(states.shape[0]):
        px, py = states[row, 0] - numbers[0], states[row, 1] - numbers[1]
        distance = math.hypot(px, py) - numbers[2]
        out[row] = 0.0
        if distance > 0.0:
            psi = _fold(states[row, 2] - math.atan2(py, px))[0]
            out[row] = _lookup(table, distance, psi, numbers)[0]


@compiled(types.void(MATRIX, MATRIX, VECTOR, MATRIX))
def look_up_gradients(table, states, numbers, out):
    for row in range(states.shape[0]):
        px, py = states[row, 0] - numbers[0], states[row, 1] - numbers[1]
        r = math.hypot(px, py)
        out[row] = 0.0
        if r > numbers[2]:
            psi, sign = _fold(states[row, 2] - math.atan2(py, px))
            _, V_d, V_psi = _lookup(table, r - numbers[2], psi, numbers)
            out[row, 0] = V_d * px / r + sign * V_psi * py / r**2
            out[row, 1] = V_d * py / r - sign * V_psi * px / r**2
            out[row, 2] = sign * V_psi


VALUE_AND_GRADIENT = types.FunctionType(types.void(MATRIX, VECTOR, VECTOR, VECTOR))


@compiled(types.void(MATRIX, VECTOR, VECTOR, VECTOR))
def value_and_gradient(table, numbers, state, out):
    """V, then grad V, `[4]`, at one state `[3]`, for other kernels: nothing is checked.

    `table` and `numbers` are those of a `GoalTable`; beyond its reach the value is extrapolated.
    """
    px, py = state[0] - numbers[0], state[1] - numbers[1]
    r = math.hypot(px, py)
    out[:] = 0.0
    if r > numbers[2]:
        psi, sign = _fold(state[2] - math.atan2(py, px))
        V, V_d, V_psi = _lookup(table, r - numbers[2], psi, numbers)
        out[0] = V
        out[1] = V_d * px / r + sign * V_psi * py / r**2
        out[2] = V_d * py / r - sign * V_psi * px / r**2
        out[3] = sign * V_psi


@compiled(types.void(MATRIX, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX))
def look_up_on_product(table, x, y, headings, numbers, out):
    columns = table.shape[1] - 3
    line = np.empty(table.shape[1])  # the table at one distance: interpolated once for all headings
    sine, cosine = np.sin(headings), np.cos(headings)
    for i in range(x.shape[0]):
        for j in range(y.shape[0]):
            px, py = x[i] - numbers[0], y[j] - numbers[1]
            r = math.hypot(px, py)
            row = out[i * y.shape[0] + j]
            if r <= numbers[2]:
                row[:] = 0.0
                continue
            rho = math.sqrt((r - numbers[2]) / numbers[3])
            touch = math.acos(numbers[2] / r)
            ray = math.atan2(py, px)
            u = math.log(rho + numbers[6])
            k, t = _cell((u - numbers[4]) / numbers[5], table.shape[0])
            down = _weights(t)
            for m in range(table.shape[1]):
                line[m] = (
                    down[0] * table[k, m]
                    + down[1] * table[k + 1, m]
                    + down[2] * table[k + 2, m]
                    + down[3] * table[k + 3, m]
                )
            ends = columns * (1.0 + 2.0 * touch / math.pi)
            cube = rho**3
            for h in range(headings.shape[0]):
                psi = _fold(headings[h] - ray)[0]
                m, w = _cell(ends * psi / (psi + touch), table.shape[1])
                along = _weights(w)
                G = (
                    along[0] * line[m]
                    + along[1] * line[m + 1]
                    + along[2] * line[m + 2]
                    + along[3] * line[m + 3]
                )
                sine_psi = abs(cosine[h] * px + sine[h] * py) / r
                row[h] = G * cube / (sine_psi + 0.5 * touch)
