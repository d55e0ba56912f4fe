"""The fan of extremals that end on the goal's boundary, resampled on a regular table.

Without obstacles, the value of a planar robot that drives along its heading and turns on the spot
depends on two numbers: the distance d to the goal and the angle psi between the heading and the
tangent of the circle about the goal (0 <= psi <= pi/2 by symmetry under reflection and half turns).
Every optimal motion is an extremal that ends on the goal's boundary with costate 0 (facts of the
degenerate end: Q = 0 there), and these form a family of one parameter, the final heading. So the
family, integrated backward, sweeps the whole (d, psi) plane; its points carry V and grad V. Until
psi = 0, where an extremal meets its mirror image and stops to be optimal, no two of them cross: the
table's nodes are each covered once, which `tabulate` checks.

The table lives in coordinates in which V is smooth. V falls like d^1.5 for a robot that faces the
goal, but like d at psi = 0, with a layer of width sqrt(d) between. With the turning length l
(metres driven for the effort of turning by one radian), rho = sqrt(d / l), and the angle
psi_c = arccos(r_g / (r_g + d)) at which a straight line just touches the goal,

    u = log(rho + 0.1)
    s = psi / (psi + psi_c) (1 + 2 psi_c / pi)            in [0, 1]
    G = V (sin psi + psi_c / 2) / rho^3                   tabulated over (u, s).
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.jit import KERNEL, MATRIX, VECTOR, compiled, float64
from ocp.kernels import kernels, parameters
from ocp.query import Query

Floats = NDArray[np.float64]

SOFT = 0.1
RHO_FIRST = 0.02  # d = 0.4 mm for the unicycle; below, G is extrapolated (V < 2e-3)
U_FIRST = math.log(RHO_FIRST + SOFT)
U_STEP = 0.025
S_COUNT = 161
RAY_GAP = 0.12  # between neighbouring final headings, as a logarithm
TIME_STEP = 0.03  # of the shortest time scale; V is then good to some 1e-6
LONGEST_TURN = 8.0  # goal radii; see `can_tabulate`
LONGEST_TABLE = 60.0  # turning lengths
SHORTEST_TIME = 30.0  # times shorter than that for turning by one radian
PROBE = 1e-5
GROWTH = 0.02  # of steps, from one to the next
RAYS_AT_ONCE = 16
STARTING_STEPS = 16  # shorter, as d grows like the time squared
MARGIN = 0.5  # how far rays go on beyond psi = 0, in units of psi_c


@dataclass(frozen=True)
class Drive:
    """What the fan depends on, beside the goal's radius.

    The robot's Hamiltonian is W(x) - (drive (n . p)^2 + turn p_heading^2) / 4, n along the heading,
    and Q(x) = weight tanh(steepness (r^2 - r_g^2) / 2).

    Attributes:
        drive, turn: squares of the speed and turn rate of unit effort.
        weight, steepness: of the goal cost.
    """

    drive: float
    turn: float
    weight: float
    steepness: float

    @property
    def unit(self) -> float:
        """Turning length l, metres a radian."""
        return math.sqrt(self.drive / self.turn)

    @property
    def turning(self) -> float:
        """Seconds to turn by one radian, far from the goal."""
        return 1.0 / math.sqrt(self.weight * self.turn)

    def leaving(self, radius: float) -> float:
        """Seconds in which headings part at the goal's boundary, where Q has a slope."""
        slope = self.weight * self.steepness * radius
        return (4.0 / (self.drive * self.turn * slope**2)) ** 0.25

    def saturating(self, radius: float) -> float:
        """Seconds to drive straight from the boundary to where Q levels off."""
        return 2.0 / (self.steepness * radius * math.sqrt(self.weight * self.drive))


def can_tabulate(drive: Drive, radii: tuple[float, float], reach: float) -> bool:
    """Whether `tabulate` works, to 1e-3 or better, for goal radii in a range.

    The longer the turning length is beside the goal's radius, the sharper is V where the heading
    just misses the goal. Far from the goal, rays part like exp(d / l). Where Q is very steep, steps
    in time would have to be very short.
    """
    return (
        drive.unit <= LONGEST_TURN * radii[0]
        and reach <= LONGEST_TABLE * drive.unit
        and drive.turning <= SHORTEST_TIME * drive.saturating(radii[1])
    )


def row_count(unit: float, reach: float) -> int:
    """Of the table, up to `reach` metres from the goal's boundary."""
    last = math.log(math.sqrt(reach / unit) + SOFT)
    return max(4, math.ceil((last - U_FIRST) / U_STEP) + 1)


def tabulate(query: Query, drive: Drive, reach: float) -> Floats:
    """G `[u, s]` for an obstacle-free query, exact to some 1e-6 at its nodes.

    Args:
        query: no obstacles, no quadratic cost; its system has states (x, y, heading).
        drive: its numbers.
        reach: metres from the goal's boundary.

    Raises:
        ArithmeticError: if the rays cross or do not cover the table, so that it would not be V.
    """
    u = U_FIRST + U_STEP * np.arange(row_count(drive.unit, reach), dtype=float)
    far = drive.unit * (math.exp(u[-1]) - SOFT) ** 2
    radius = query.goal.radius
    steps = _steps(drive, radius, far)
    facing = np.exp(np.arange(-far / drive.unit - 8.0, math.log(math.pi / 4), RAY_GAP))

    def trace(headings: Floats) -> tuple[Floats, NDArray[np.int64]]:
        points = np.empty((len(headings), len(steps), 5))
        lengths = np.zeros(len(headings), dtype=np.int64)
        _trace(
            kernels(query).flow, parameters(query), query.goal_position, radius,
            drive.unit, steps, far, headings, points, lengths,
        )  # fmt: skip
        _smooth(points, lengths, radius, drive.unit)
        return points, lengths

    # Near the goal everything scales: a ray that leaves at psi meets its image at rho = c psi.
    probe, lengths = trace(np.array([math.pi / 2 - PROBE]))
    met = (math.exp(probe[0, lengths[0] - 1, 0]) - SOFT) / PROBE
    grazing = np.exp(np.arange(math.log(math.pi / 4), math.log(RHO_FIRST / met / 10), -RAY_GAP))
    headings = np.concatenate([[0.0], facing, math.pi / 2 - grazing])
    table = np.full((len(u), S_COUNT), np.inf)
    crossings = 0
    for first in range(0, len(headings) - 1, RAYS_AT_ONCE):
        points, lengths = trace(headings[first : first + RAYS_AT_ONCE + 1])
        crossings += _rasterise(points, lengths, table)
        if first == 0:
            table[:, -1] = _aligned(points[0, 1 : lengths[0]], u)
    missing = int((~np.isfinite(table)).sum())
    if crossings or missing:
        raise ArithmeticError(f"rays cross at {crossings} nodes and miss {missing}")
    return table


def _steps(drive: Drive, radius: float, far: float) -> Floats:
    """Steps in time of all rays: short while any is near the boundary, then longer."""
    last = TIME_STEP * drive.turning
    first = min(last, TIME_STEP * drive.leaving(radius), TIME_STEP * drive.saturating(radius))
    near = 6.0 * drive.leaving(radius) + 4.0 * drive.saturating(radius)
    start = first * np.arange(1, STARTING_STEPS) / STARTING_STEPS
    growing = first * np.exp(np.arange(0.0, math.log(last / first), GROWTH))
    rest = far / math.sqrt(drive.weight * drive.drive) + 10.0 * drive.turning
    return np.concatenate(
        [
            start,
            np.full(math.ceil(near / first), first),
            growing,
            np.full(math.ceil(rest / last), last),
        ]
    )


def _aligned(ray: Floats, u: Floats) -> Floats:
    """G along the ray that faces the goal, by cubic Hermite interpolation."""
    i = np.searchsorted(ray[:, 0], u) - 1
    start, end = ray[i], ray[i + 1]
    h = end[:, 0] - start[:, 0]
    t = (u - start[:, 0]) / h
    slope, next_slope = h * start[:, 3], h * end[:, 3]
    rise = end[:, 2] - start[:, 2]
    bend = (1 - t) * (slope - rise) + t * (rise - next_slope)
    return start[:, 2] + t * (rise + (1 - t) * bend)


@compiled(types.void(float64[:, :, ::1], int64[::1], float64, float64))
def _smooth(points, lengths, radius, unit):
    """(d, psi, V, dV/dd, dV/dpsi) to (u, s, G, dG/du, dG/ds), in place."""
    for ray in range(points.shape[0]):
        for k in range(lengths[ray]):
            point = points[ray, k]
            d, psi, V, V_psi = max(point[0], 1e-20 * unit), point[1], point[2], point[4]
            rho = math.sqrt(d / unit)
            touch = math.acos(radius / (radius + d))
            touch_rho = 2.0 * unit * rho * radius / (radius + d) / math.sqrt(d * (2 * radius + d))
            ends, width = 1.0 + 2.0 * touch / math.pi, psi + touch
            s_psi = ends * touch / width**2
            s_rho = (2.0 / math.pi * psi / width - ends * psi / width**2) * touch_rho
            psi_rho = -s_rho / s_psi  # at constant s
            factor = (math.sin(psi) + 0.5 * touch) / rho**3
            factor_psi = math.cos(psi) / rho**3
            factor_rho = 0.5 * touch_rho / rho**3 - 3.0 * factor / rho + factor_psi * psi_rho
            G_rho = (2.0 * unit * rho * point[3] + V_psi * psi_rho) * factor + V * factor_rho
            point[0] = math.log(rho + SOFT)
            point[1] = ends * psi / width
            point[2] = V * factor
            point[3] = G_rho * (rho + SOFT)
            point[4] = (V_psi * factor + V * factor_psi) / s_psi


@compiled(
    types.void(
        KERNEL, VECTOR, VECTOR, float64, float64, VECTOR, float64, VECTOR,
        float64[:, :, ::1], int64[::1],
    )
)  # fmt: skip
def _trace(flow, q, center, radius, unit, steps, far, headings, points, lengths):
    """Classical Runge-Kutta backward from the boundary, at the same times on every ray.

    Equal times keep neighbouring rays' points side by side. V grows by -p . x' (backward), which is
    W + u' R u as H = 0.
    """
    z, y, total = np.empty(6), np.empty(6), np.empty(6)
    rate = np.empty(6)
    share = (0.5, 0.5, 1.0, 0.0)
    weight = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
    for ray in range(headings.shape[0]):
        z[:] = 0.0
        z[0] = center[0] + radius * (1.0 + 1e-12)  # where Q has its slope
        z[1] = center[1]
        z[2] = headings[ray]
        cost = 0.0
        for k in range(points.shape[1]):
            px, py = z[0] - center[0], z[1] - center[1]
            r = math.hypot(px, py)
            d = r - radius
            psi = 0.5 * math.pi - (z[2] - math.atan2(py, px))
            points[ray, k, 0] = d
            points[ray, k, 1] = psi
            points[ray, k, 2] = cost
            points[ray, k, 3] = (z[3] * px + z[4] * py) / r
            points[ray, k, 4] = -z[5]
            lengths[ray] = k + 1
            # Beyond psi = 0 only as far as neighbouring rays need, not back (headings swing).
            beyond = psi < -MARGIN * math.acos(min(1.0, radius / r))
            back = psi < 0.0 and psi > points[ray, k - 1, 1]
            if beyond or back or d > far * 1.02 + 0.1 * unit or psi > math.pi:
                break
            h = steps[k]
            y[:] = z
            total[:] = 0.0
            for stage in range(4):
                flow(y, q, rate)
                for i in range(3):
                    cost -= h * weight[stage] * y[3 + i] * rate[i]
                for i in range(6):
                    total[i] -= h * weight[stage] * rate[i]
                    y[i] = z[i] - h * share[stage] * rate[i]
            for i in range(6):
                z[i] += total[i]


@compiled(int64(float64[:, :, ::1], int64[::1], MATRIX))
def _rasterise(points, lengths, table):
    """Fill `table` from the triangles between neighbouring rays; count nodes where they disagree.

    On a triangle G is the cubic with the values and gradients of its corners, its middle Bezier
    point chosen to reproduce quadratics (so the error is of third order in the triangle's size).
    """
    crossings = 0
    ray_of, time_of = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
    x, y, f, edge = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    rows, columns = table.shape
    height = 1.0 / (columns - 1)
    for ray in range(points.shape[0] - 1):
        for k in range(1, min(lengths[ray], lengths[ray + 1]) - 1):
            for half in range(2):  # the quadrilateral's corners 0, 1, 2 and 1, 2, 3
                for c in range(3):
                    point = points[ray + ray_of[c + half], k + time_of[c + half]]
                    x[c], y[c], f[c] = point[0], point[1], point[2]
                first = max(0, math.ceil((min(x) - U_FIRST) / U_STEP - 1e-9))
                last = min(rows - 1, math.floor((max(x) - U_FIRST) / U_STEP + 1e-9))
                low = max(0, math.ceil(min(y) / height - 1e-9))
                high = min(columns - 2, math.floor(max(y) / height + 1e-9))
                area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
                if first > last or low > high or area == 0.0:
                    continue
                middle = -(f[0] + f[1] + f[2]) / 6.0
                for c in range(3):
                    point = points[ray + ray_of[c + half], k + time_of[c + half]]
                    for e in range(3):
                        rise = (x[e] - x[c]) * point[3] + (y[e] - y[c]) * point[4]
                        edge[c, e] = f[c] + rise / 3.0
                        if e != c:
                            middle += 0.25 * edge[c, e]
                for a in range(first, last + 1):
                    dx = U_FIRST + a * U_STEP - x[0]
                    for b in range(low, high + 1):
                        dy = b * height - y[0]
                        v = (dx * (y[2] - y[0]) - (x[2] - x[0]) * dy) / area
                        w = ((x[1] - x[0]) * dy - dx * (y[1] - y[0])) / area
                        u = 1.0 - v - w
                        if min(u, v, w) < -1e-9:
                            continue
                        value = (
                            f[0] * u**3 + f[1] * v**3 + f[2] * w**3
                            + 3.0 * u * v * (edge[0, 1] * u + edge[1, 0] * v)
                            + 3.0 * v * w * (edge[1, 2] * v + edge[2, 1] * w)
                            + 3.0 * w * u * (edge[2, 0] * w + edge[0, 2] * u)
                            + 6.0 * middle * u * v * w
                        )  # fmt: skip
                        old = table[a, b]
                        if old < np.inf and abs(value - old) > 1e-3 * old:
                            crossings += 1
                        table[a, b] = min(old, value)
    return crossings
