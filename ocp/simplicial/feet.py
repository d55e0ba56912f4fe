"""Where the motions that leave a vertex cross its link, compiled; what it means says `stencils`."""

import numpy as np
from numba import int64, types

from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled
from ocp.grids.hard_obstacles import SEGMENT

I1 = types.Array(int64, 1, "C")
I2 = types.Array(int64, 2, "C")
FLAGS = types.Array(types.uint8, 1, "C")
GOAL = -1  # stands for a vertex in the goal
ROOT_STEPS = 12
ROOT_TOLERANCE = 1e-7  # share of an edge
GAUSS = (0.21132486540518713, 0.7886751345948129)  # two-point rule on [0, 1]


@compiled(types.float64(KERNEL, VECTOR, VECTOR, MATRIX, VECTOR, VECTOR))
def _missed(dynamics, x, gap, columns, u, point):
    """What no input makes of a motion by `gap` `[3]` from x: its part along the normal of G.

    `columns` `[2, 3]`, `u` `[2]` and `point` `[3]` are overwritten.
    """
    for i in range(3):
        point[i] = x[i] + 0.5 * gap[i]
    for j in range(2):
        u[:] = 0.0
        u[j] = 1.0
        dynamics(point, u, columns[j])
    a, b = columns[0], columns[1]
    n0, n1, n2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return (n0 * gap[0] + n1 * gap[1] + n2 * gap[2]) / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)


@compiled(types.boolean(KERNEL, VECTOR, VECTOR, VECTOR, MATRIX, VECTOR, MATRIX))
def _input(dynamics, x, gap, u, columns, point, system):
    """Into `u` `[m]` the input that moves by `gap` from x, by least squares; whether there is one.

    `columns` `[m, n]`, `point` `[n]` and `system` `[m, m + 1]` are overwritten.
    """
    n, m = x.shape[0], u.shape[0]
    for i in range(n):
        point[i] = x[i] + 0.5 * gap[i]
    for j in range(m):
        u[:] = 0.0
        u[j] = 1.0
        dynamics(point, u, columns[j])
    for i in range(m):
        for j in range(m + 1):
            total = 0.0
            for k in range(n):
                total += columns[i, k] * (columns[j, k] if j < m else gap[k])
            system[i, j] = total
    for i in range(m):  # Gauss: the matrix is positive definite, or no input moves the robot so
        if not system[i, i] > 0.0:
            return False
        for j in range(i + 1, m):
            ratio = system[j, i] / system[i, i]
            for k in range(i, m + 1):
                system[j, k] -= ratio * system[i, k]
    for back in range(m):
        i = m - 1 - back
        total = system[i, m]
        for j in range(i + 1, m):
            total -= system[i, j] * u[j]
        u[i] = total / system[i, i]
    return True


@compiled(
    types.UniTuple(int64, 2)(
        KERNEL, SCALAR, SCALAR, SEGMENT, VECTOR, VECTOR, VECTOR, VECTOR, I1, VECTOR, MATRIX, VECTOR,
        I2, I1, I1, I1, I2, I2, VECTOR, MATRIX, VECTOR, VECTOR, FLAGS, I2,
    )
)  # fmt: skip
def find_feet(
    dynamics, state_cost, bare_cost, clear, q, bare, weights, goal, position, hard, vertices,
    period, cells, start, around, which, span, nodes, weight, effort, cost, alone, blocked, pieces,
):  # fmt: skip
    """Fill the arrays of `Stencils`; returns the numbers of feet and pieces."""
    n, m = vertices.shape[1], effort.shape[1]
    d = position.shape[0]
    obstructed = hard[2] > 0.0
    obstacles = bare.shape[0] < q.shape[0]
    columns, point, u = np.empty((m, n)), np.empty(n), np.empty(m)
    system = np.empty((m, m + 1))
    gaps, missed = np.empty((n, n)), np.empty(n)
    link, corner = np.empty(n, dtype=np.int64), np.empty(n + 3, dtype=np.int64)
    gap, end, other = np.empty(n), np.empty(n), np.empty(n)
    largest_star = 0
    for v in which:
        largest_star = max(largest_star, start[v + 1] - start[v])
    keys = np.empty((largest_star * n, 2), dtype=np.int64)
    # Of the vertices around the present one
    slot = np.full(vertices.shape[0], -1, dtype=np.int64)
    star_gaps, star_missed = np.empty((largest_star * n, n)), np.zeros(largest_star * n)
    foot, piece = 0, 0
    for v in which:
        x = vertices[v]
        first, first_piece = foot, piece
        span[v, 0], span[v, 1], span[v, 2], span[v, 3] = foot, foot, piece, piece
        away = 0.0
        for i in range(d):
            away += (x[position[i]] - goal[1 + i]) ** 2
        away -= goal[0] ** 2
        if away <= 0.0:
            continue
        known_vertices = 0
        own, own_alone = np.sqrt(state_cost(x, q)), np.sqrt(bare_cost(x, bare))
        for row in range(start[v], start[v + 1]):
            size = 0
            for i in range(n + 1):
                j = cells[around[row], i]
                if j == v:
                    continue
                link[size] = j
                if slot[j] < 0:
                    slot[j] = known_vertices
                    largest = 0.0
                    for k in range(n):
                        step = vertices[j, k] - x[k]
                        if period[k] > 0.0:
                            step -= period[k] * np.round(step / period[k])
                        star_gaps[slot[j], k] = step
                        largest = max(largest, abs(step))
                    if m < n:
                        off = _missed(dynamics, x, star_gaps[slot[j]], columns, u, point)
                        star_missed[slot[j]] = 0.0 if abs(off) < 1e-11 * largest else off
                    known_vertices += 1
                for k in range(n):
                    gaps[size, k] = star_gaps[slot[j], k]
                missed[size] = star_missed[slot[j]]
                size += 1

            found = 0
            for i in range(n):
                for j in range(i, n):
                    # With as many inputs as states, the feet are the link's vertices. Else they are
                    # where nothing is missed: at a vertex, or inside an edge.
                    if m == n:
                        if i != j:
                            continue
                    elif i == j:
                        if missed[i] != 0.0:
                            continue
                    elif not missed[i] * missed[j] < 0.0:
                        continue
                    one, two = min(link[i], link[j]), max(link[i], link[j])
                    known = -1
                    for f in range(first, foot):
                        if keys[f - first, 0] == one and keys[f - first, 1] == two:
                            known = f
                    if known >= 0:
                        corner[found] = known
                        found += 1
                        continue

                    share = 0.0
                    if i != j:
                        low, high, a, b = 0.0, 1.0, missed[i], missed[j]
                        for _ in range(ROOT_STEPS):  # regula falsi (Illinois)
                            share = low + (high - low) * a / (a - b)
                            for k in range(n):
                                gap[k] = (1.0 - share) * gaps[i, k] + share * gaps[j, k]
                            c = _missed(dynamics, x, gap, columns, u, point)
                            if abs(c) <= ROOT_TOLERANCE * abs(missed[i] - missed[j]):
                                break
                            if c * b < 0.0:
                                low, a = high, b
                            else:
                                a *= 0.5
                            high, b = share, c
                    for k in range(n):
                        gap[k] = (1.0 - share) * gaps[i, k] + share * gaps[j, k]
                        end[k] = x[k] + gap[k]
                    if not _input(dynamics, x, gap, u, columns, point, system):
                        continue

                    # First hit of the goal ball, on the chord
                    a, b, hit = 0.0, 0.0, 2.0
                    for k in range(d):
                        step = gap[position[k]]
                        a += step * step
                        b += step * (x[position[k]] - goal[1 + k])
                    if b < 0.0 and b * b >= a * away:
                        hit = (-b - np.sqrt(b * b - a * away)) / a
                    arrives = hit <= 1.0
                    if arrives:
                        for k in range(n):
                            end[k] = x[k] + hit * gap[k]
                    if obstructed:
                        shut = clear(x, end, hard) == 0.0
                        if not arrives:
                            for side in (i, j):
                                for k in range(n):
                                    other[k] = x[k] + gaps[side, k]
                                shut = shut or clear(end, other, hard) == 0.0
                        if shut:
                            blocked[v] = 1
                            continue

                    scale = hit if arrives else 1.0
                    length = 0.0
                    for k in range(m):
                        effort[foot, k] = scale * np.sqrt(weights[k]) * u[k]
                        length += effort[foot, k] ** 2
                    length = np.sqrt(length)
                    if arrives:
                        total, without = 0.0, 0.0
                        for g in range(2):  # Gauss: W has a square root's end at the goal
                            for k in range(n):
                                point[k] = x[k] + hit * GAUSS[g] * gap[k]
                            total += np.sqrt(state_cost(point, q))
                            without += np.sqrt(bare_cost(point, bare))
                        cost[foot], alone[foot] = total * length, without * length
                        nodes[foot, 0] = nodes[foot, 1] = GOAL
                        weight[foot] = 0.0
                    else:
                        for k in range(n):
                            point[k] = x[k] + 0.5 * gap[k]
                        total = own + 4.0 * np.sqrt(state_cost(point, q))
                        total += np.sqrt(state_cost(end, q))
                        cost[foot] = alone[foot] = total / 3.0 * length
                        if obstacles:
                            total = own_alone + 4.0 * np.sqrt(bare_cost(point, bare))
                            total += np.sqrt(bare_cost(end, bare))
                            alone[foot] = total / 3.0 * length
                        nodes[foot, 0], nodes[foot, 1] = one, two
                        weight[foot] = share if link[i] == one else 1.0 - share
                        if i == j:
                            weight[foot] = 0.0
                    keys[foot - first, 0], keys[foot - first, 1] = one, two
                    corner[found] = foot
                    found += 1
                    foot += 1
            if m == n and found == 3:
                pieces[piece, 0], pieces[piece, 1], pieces[piece, 2] = (
                    corner[0], corner[1], corner[2],
                )  # fmt: skip
                piece += 1
            for i in range(found):
                for j in range(i):
                    one, two = min(corner[i], corner[j]), max(corner[i], corner[j])
                    known = False
                    for p in range(first_piece, piece):
                        if pieces[p, 0] == one and pieces[p, 1] == two and pieces[p, 2] < 0:
                            known = True
                    if not known:
                        pieces[piece, 0], pieces[piece, 1], pieces[piece, 2] = one, two, -1
                        piece += 1
        for row in range(start[v], start[v + 1]):
            for i in range(n + 1):
                slot[cells[around[row], i]] = -1
        span[v, 1], span[v, 3] = foot, piece
    return foot, piece
