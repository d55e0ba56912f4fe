"""The exact value without obstacles, from a table: for planar robots that drive as they head.

For a robot whose motion is the unicycle's up to scales, V(x) without obstacles depends on the
distance to the goal and the heading relative to it alone. `goal_fan` computes it to some 1e-5 for a
given goal radius; here it is interpolated over the radius, kept on disk, and looked up.

A table is built for radii within a factor of two of each other (10 Chebyshev radii), once for each
set of cost weights on a machine: some 1 to 2 s. From then on a new radius costs 0.1 ms, a new goal
centre nothing.
"""

import hashlib
import logging
import math
import zipfile
import zlib
from dataclasses import astuple, dataclass
from functools import cache, lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import cache_folder
from ocp.cost import RunningCost
from ocp.files import atomic_path
from ocp.grids import goal_fan
from ocp.grids.goal_fan import SOFT, U_FIRST, U_STEP, Drive, can_tabulate, row_count, tabulate
from ocp.grids.goal_look_up import look_up_gradients, look_up_on_product, look_up_values
from ocp.grids.stencil import coordinates_in
from ocp.query import Goal, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

RADII = 10
HEADINGS = (0.0, 0.4, 1.1, 1.9, 2.6, 3.3, 4.5, 5.7)  # where a robot's symmetry is tried


@dataclass(frozen=True, eq=False)
class GoalTable:
    """V without obstacles for one goal; a `Value`.

    Attributes:
        center: of the goal, `[2]`.
        radius: of the goal, metres.
        unit: turning length, metres.
        reach: the table's end, metres from the goal's boundary.
        table: G of `goal_fan` over (u, s), with one more row or column on each side.
    """

    center: Floats
    radius: float
    unit: float
    reach: float
    table: Floats

    def value(self, states: ArrayLike) -> Floats:
        """V `[...]` at states `[..., 3]`; 0 in the goal.

        Raises:
            ValueError: if a state is not finite, or further from the goal than `reach`.
        """
        rows, shape = self._rows(states)
        out = np.empty(len(rows))
        look_up_values(self.table, rows, self._numbers, out)
        return out.reshape(shape)

    def gradient(self, states: ArrayLike) -> Floats:
        """grad V `[..., 3]` at states `[..., 3]`; 0 in the goal.

        Where the heading is tangential V has a kink; there it is the gradient from one side.

        Raises:
            ValueError: if a state is not finite, or further from the goal than `reach`.
        """
        rows, shape = self._rows(states)
        out = np.empty_like(rows)
        look_up_gradients(self.table, rows, self._numbers, out)
        return out.reshape(*shape, 3)

    def on_product(self, x: Floats, y: Floats, headings: Floats) -> Floats:
        """V `[x, y, headings]` at all combinations of coordinates, without checks."""
        out = np.empty((len(x) * len(y), len(headings)))
        look_up_on_product(self.table, x, y, headings, self._numbers, out)
        return out.reshape(len(x), len(y), len(headings))

    @property
    def numbers(self) -> Floats:
        """What the look-up kernels are told beside the table."""
        return self._numbers

    @property
    def _numbers(self) -> Floats:
        # Constants of another module go in as numbers: numba's cache would not see them change.
        return np.array([*self.center, self.radius, self.unit, U_FIRST, U_STEP, SOFT])

    def _rows(self, states: ArrayLike) -> tuple[Floats, tuple[int, ...]]:
        states = np.asarray(states, dtype=float)
        if states.shape[-1:] != (3,):
            raise ValueError(f"states: expected [..., 3], got shape {states.shape}")
        rows = np.ascontiguousarray(states.reshape(-1, 3))
        far = np.hypot(*(rows[:, :2] - self.center).T) - self.radius
        if not (np.isfinite(rows).all() and (far <= self.reach).all()):
            raise ValueError(f"states: must be finite and within {self.reach:g} m of the goal")
        return rows, states.shape[:-1]


def drive_of(query: Query) -> Drive | None:
    """The numbers of the query's table, or `None` if no table can describe it without obstacles.

    A table needs a time-free query, a goal cost, and a robot with states (x, y, heading) that
    drives along its heading and turns on the spot, at speeds that depend on nothing. Obstacles and
    a quadratic cost are not looked at: the table is the value without them.
    """
    w = query.cost
    if not (query.is_time_free and w.goal > 0 and w.goal_steepness > 0):
        return None
    speeds = _speeds(query.system, tuple(map(float, query.input_weights)))
    return None if speeds is None else Drive(*speeds, w.goal, w.goal_steepness)


@cache
def _speeds(system: System, weights: tuple[float, ...]) -> tuple[float, float] | None:
    """Squares of speed and turn rate of unit effort, if G R^-1 G' is the unicycle's up to them."""
    if system.n != 3 or system.position != (0, 1) or not system.coordinates[2].periodic:
        return None
    whole_turn = abs(system.coordinates[2].extent - 2 * math.pi) < 1e-9
    if not whole_turn or coordinates_in(system.input_matrix, system.state)[:2].any():
        return None
    matrix = ca.Function("G", [system.state], [ca.densify(system.input_matrix)])
    metrics = []
    for heading in HEADINGS:
        G = np.array(matrix([0.0, 0.0, heading])) / np.sqrt(weights)
        c, s = math.cos(heading), math.sin(heading)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        metrics.append(turn @ G @ G.T @ turn.T)
    drive, turning = float(metrics[0][0, 0]), float(metrics[0][2, 2])
    expected = np.diag([drive, 0.0, turning])
    if min(drive, turning) <= 0 or not np.allclose(metrics, expected, rtol=1e-9, atol=1e-12):
        return None
    return drive, turning


def has_goal_table(query: Query, reach: float) -> bool:
    """Whether `goal_table` applies: see `drive_of`, and `goal_fan.can_tabulate` for its limits."""
    drive = drive_of(query)
    if drive is None:
        return False
    first = 2.0 ** _octave(query)
    return can_tabulate(drive, (first, 2.0 * first), _size(reach))


def _size(reach: float) -> float:
    """Metres up to which a table is made: few different ones, so that tables are shared."""
    return 2.0 ** max(4, math.ceil(math.log2(reach)))


def _octave(query: Query) -> int:
    return math.floor(math.log2(query.goal.radius))


def goal_table(query: Query, reach: float) -> GoalTable:
    """The table for a query's robot, goal and cost, valid up to `reach` metres from the goal.

    Raises:
        SolveError: NOT_APPLICABLE unless `has_goal_table`.
    """
    drive = drive_of(query)
    if drive is None or not has_goal_table(query, reach):
        raise SolveError(
            Status.NOT_APPLICABLE,
            f"no goal table for {query.system.name} with this cost, up to {reach:g} m",
        )
    weights = tuple(map(float, query.input_weights))
    size = _size(reach)
    stack = _stack(query.system, weights, drive, _octave(query), size)
    table = _at_radius(stack, query.goal.radius)
    return GoalTable(query.goal_position, query.goal.radius, drive.unit, size, table)


def _radii(octave: int) -> Floats:
    """Chebyshev points of the second kind on [2^octave, 2^(octave + 1)]."""
    return 2.0**octave * (1.5 - 0.5 * np.cos(np.pi * np.arange(RADII) / (RADII - 1)))


class _Stack:
    """Tables `[radii, u, s]`, and the ones interpolated between them."""

    def __init__(self, radii: Floats, tables: Floats) -> None:
        self.radii, self.tables = radii, tables


@lru_cache(maxsize=64)
def _at_radius(stack: _Stack, radius: float) -> Floats:
    """Barycentric interpolation over the radius, and the border that cubics need."""
    gap = radius - stack.radii
    weights = np.where(np.arange(RADII) % 2 == 0, 1.0, -1.0)
    weights[[0, -1]] /= 2
    share = (gap == 0) * 1.0 if (gap == 0).any() else weights / gap
    inner = np.tensordot(share / share.sum(), stack.tables, axes=1)
    table = np.empty((inner.shape[0] + 2, inner.shape[1] + 2))
    table[1:-1, 1:-1] = inner
    table[0, 1:-1] = 3 * inner[0] - 3 * inner[1] + inner[2]
    table[-1, 1:-1] = 3 * inner[-1] - 3 * inner[-2] + inner[-3]
    table[:, 0] = 3 * table[:, 1] - 3 * table[:, 2] + table[:, 3]
    table[:, -1] = 3 * table[:, -2] - 3 * table[:, -3] + table[:, -4]
    return table


@lru_cache(maxsize=8)
def _stack(
    system: System, weights: tuple[float, ...], drive: Drive, octave: int, reach: float
) -> _Stack:
    """From disk if it is there and sound, else computed and written."""
    radii = _radii(octave)
    shape = (RADII, row_count(drive.unit, reach), goal_fan.S_COUNT)
    path = cache_file(drive, octave, reach)
    if path.exists():
        tables = _read(path, shape)
        if tables is not None:
            return _Stack(radii, tables)
    log.info("computing a goal table (once on this machine): %s", drive)
    center = [(system.lower[i] + system.upper[i]) / 2 for i in system.position]
    cost = RunningCost(weights, drive.weight, drive.steepness)
    try:
        tables = np.stack(
            [
                tabulate(Query(system, Goal(tuple(map(float, center)), r), (), cost), drive, reach)
                for r in map(float, radii)
            ]
        )
    except ArithmeticError as error:
        raise SolveError(Status.NOT_CONVERGED, f"goal table: {error}") from error
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, tables=tables, digest=_digest(tables))
    return _Stack(radii, tables)


def cache_file(drive: Drive, octave: int, reach: float) -> Path:
    """Where a table is kept; its name changes with everything that it depends on."""
    code = Path(goal_fan.__file__).read_bytes()
    key = hashlib.sha256(code + repr((astuple(drive), octave, reach, RADII)).encode())
    return cache_folder() / "goal-tables" / f"goal-table-{key.hexdigest()[:24]}.npz"


def _digest(tables: Floats) -> NDArray[np.uint8]:
    return np.frombuffer(hashlib.sha256(tables.tobytes()).digest(), dtype=np.uint8)


def _read(path: Path, shape: tuple[int, ...]) -> Floats | None:
    """The tables in a file, or `None` if it is damaged; it is then written anew."""
    try:
        with np.load(path, allow_pickle=False) as file:
            tables, digest = file["tables"], file["digest"]
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        log.warning("goal table %s cannot be read (%s): computing it anew", path, error)
        return None
    if tables.shape != shape or not np.array_equal(digest, _digest(tables)):
        log.warning("goal table %s is damaged: computing it anew", path)
        return None
    return tables
