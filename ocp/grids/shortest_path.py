"""Shortest paths on a grid whose moves are the same everywhere: Dijkstra and value iteration.

The three solvers reach the same fixed point, to the last bit: the length of a path is summed from
its end, and rounding keeps order.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled
from ocp.grids.hard_obstacles import SEGMENT, clear_segment

INTEGERS = int64[::1]
TABLE = int64[:, ::1]
FLAGS = types.boolean[::1]


@dataclass(frozen=True, eq=False)
class MoveGraph:
    """A grid of nodes and the moves between them.

    Attributes:
        shape, periodic: `[n]`.
        turns: `[n]`: 1 for the coordinates that the table of moves depends on, else 0.
        first: `[g + 1]`: moves first[i] to first[i + 1] leave from combination i of those.
        offsets: `[k, n]`, in cells.
        efforts: `[k]`; the length of a move is its effort plus the cost of the node it leaves.
        costs: `[nodes]`.
        blocked: `[nodes]`: nodes that no path may visit.
        positions: `[nodes, n]`, their states.
        spacing: `[n]`.
        hard: `hard_data` of the query: no move crosses a hard obstacle.
    """

    shape: NDArray[np.int64]
    periodic: NDArray[np.bool_]
    turns: NDArray[np.int64]
    first: NDArray[np.int64]
    offsets: NDArray[np.int64]
    efforts: NDArray[np.float64]
    costs: NDArray[np.float64]
    blocked: NDArray[np.bool_]
    positions: NDArray[np.float64] = field(repr=False)
    spacing: NDArray[np.float64]
    hard: NDArray[np.float64]

    def _arguments(self) -> tuple:
        return (
            self.shape,
            self.periodic,
            self.turns,
            self.first,
            self.offsets,
            self.efforts,
            self.costs,
            self.blocked,
            self.positions,
            self.spacing,
            self.hard,
            clear_segment,
        )

    def label_setting(self, goals: NDArray[np.bool_]) -> tuple[NDArray, NDArray[np.int64], int]:
        """Lengths `[nodes]` to the nearest goal, first moves `[nodes]` (-1 for none), sweeps."""
        values, best = self._begin(goals)
        arrivals = self._arrivals()
        _label_setting(*self._arguments(), *arrivals, values, best)
        return values, best, 1

    def value_iteration(
        self, goals: NDArray[np.bool_], in_place: bool
    ) -> tuple[NDArray, NDArray[np.int64], int]:
        """The same by value iteration: Gauss-Seidel in alternating orders, or Jacobi."""
        values, best = self._begin(goals)
        sweeps = _value_iteration(*self._arguments(), goals, in_place, values, best)
        return values, best, int(sweeps)

    def _begin(self, goals: NDArray[np.bool_]) -> tuple[NDArray, NDArray[np.int64]]:
        values = np.where(goals & ~self.blocked, 0.0, np.inf)
        return values, np.full(len(values), -1, dtype=np.int64)

    def _arrivals(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The moves sorted by the combination they arrive at: `[g + 1]` and `[k]`."""
        dependent = np.flatnonzero(self.turns)
        counts = self.shape[dependent]
        groups = len(self.first) - 1
        departure = np.repeat(np.arange(groups), np.diff(self.first))
        inside = np.ones(len(departure), dtype=bool)
        arrival = np.zeros(len(departure), dtype=np.int64)
        weight = groups
        for axis, count in zip(dependent, counts, strict=True):
            weight //= count
            there = departure // weight % count + self.offsets[:, axis]
            if not self.periodic[axis]:
                inside &= (there >= 0) & (there < count)
            arrival += weight * (there % count)
        moves = np.flatnonzero(inside)
        order = moves[np.argsort(arrival[moves], kind="stable")]
        return np.searchsorted(arrival[order], np.arange(groups + 1)), order


@compiled(int64(int64, INTEGERS, INTEGERS, INTEGERS))
def _unravel(node, shape, turns, index):
    """Fill `index` `[n]`; returns the combination of the coordinates that moves depend on."""
    for i in range(shape.shape[0] - 1, -1, -1):
        index[i] = node % shape[i]
        node //= shape[i]
    combination = 0
    for i in range(shape.shape[0]):
        if turns[i] > 0:
            combination = combination * shape[i] + index[i]
    return combination


@compiled(int64(INTEGERS, TABLE, int64, int64, INTEGERS, FLAGS))
def _neighbour(index, offsets, move, sign, shape, periodic):
    """The node `sign` times a move away; -1 outside the grid."""
    node = 0
    for i in range(shape.shape[0]):
        j = index[i] + sign * offsets[move, i]
        if periodic[i]:
            j %= shape[i]
        elif j < 0 or j >= shape[i]:
            return -1
        node = node * shape[i] + j
    return node


@compiled(types.boolean(SEGMENT, VECTOR, TABLE, int64, VECTOR, VECTOR, VECTOR))
def _clear(segment, start, offsets, move, spacing, hard, end):
    """Whether a move from the state `start` is clear of hard obstacles; `end` `[n]` is scratch."""
    for i in range(end.shape[0]):
        end[i] = start[i] + offsets[move, i] * spacing[i]
    return segment(start, end, hard) > 0.0


@compiled(
    types.void(
        INTEGERS, FLAGS, INTEGERS, INTEGERS, TABLE, VECTOR, VECTOR, FLAGS, MATRIX, VECTOR, VECTOR,
        SEGMENT, INTEGERS, INTEGERS, VECTOR, INTEGERS,
    )
)  # fmt: skip
def _label_setting(
    shape, periodic, turns, first, offsets, efforts, costs, blocked, positions, spacing, hard,  # noqa: ARG001
    segment, arrivals_first, arrivals, values, best,
):  # fmt: skip
    """Dijkstra's algorithm from the goals, with an indexed binary heap."""
    n, size = shape.shape[0], values.shape[0]
    index, end = np.empty(n, dtype=np.int64), np.empty(n)
    heap = np.empty(size, dtype=np.int64)
    place = np.full(size, -1, dtype=np.int64)  # in the heap; -2 once accepted
    count = 0
    for node in range(size):
        if values[node] == 0.0:
            heap[count] = node
            place[node] = count
            count += 1
    while count > 0:
        node = heap[0]
        place[node] = -2
        count -= 1
        if count > 0:
            moved = heap[count]
            hole = 0
            while 2 * hole + 1 < count:
                child = 2 * hole + 1
                if child + 1 < count and values[heap[child + 1]] < values[heap[child]]:
                    child += 1
                if values[heap[child]] >= values[moved]:
                    break
                heap[hole] = heap[child]
                place[heap[hole]] = hole
                hole = child
            heap[hole] = moved
            place[moved] = hole
        arrival = _unravel(node, shape, turns, index)
        for entry in range(arrivals_first[arrival], arrivals_first[arrival + 1]):
            move = arrivals[entry]
            before = _neighbour(index, offsets, move, -1, shape, periodic)
            if before < 0 or place[before] == -2 or blocked[before]:
                continue
            candidate = costs[before] + efforts[move] + values[node]
            if not candidate < values[before]:
                continue
            if hard[2] > 0.0 and not _clear(
                segment, positions[before], offsets, move, spacing, hard, end
            ):
                continue
            values[before] = candidate
            best[before] = move
            hole = place[before]
            if hole < 0:
                hole = count
                count += 1
            while hole > 0 and values[heap[(hole - 1) // 2]] > candidate:
                heap[hole] = heap[(hole - 1) // 2]
                place[heap[hole]] = hole
                hole = (hole - 1) // 2
            heap[hole] = before
            place[before] = hole


@compiled(
    int64(
        INTEGERS, FLAGS, INTEGERS, INTEGERS, TABLE, VECTOR, VECTOR, FLAGS, MATRIX, VECTOR, VECTOR,
        SEGMENT, FLAGS, types.boolean, VECTOR, INTEGERS,
    )
)  # fmt: skip
def _value_iteration(
    shape, periodic, turns, first, offsets, efforts, costs, blocked, positions, spacing, hard,
    segment, goals, in_place, values, best,
):  # fmt: skip
    """Sweeps until nothing changes; the number of sweeps."""
    n, size = shape.shape[0], values.shape[0]
    index, end = np.empty(n, dtype=np.int64), np.empty(n)
    sweeps = 0
    changed = True
    while changed:
        changed = False
        source = values if in_place else values.copy()
        for step in range(size):
            node = size - 1 - step if in_place and sweeps % 2 == 1 else step
            if goals[node] or blocked[node]:
                continue
            combination = _unravel(node, shape, turns, index)
            for move in range(first[combination], first[combination + 1]):
                after = _neighbour(index, offsets, move, 1, shape, periodic)
                if after < 0 or blocked[after]:
                    continue
                candidate = costs[node] + efforts[move] + source[after]
                if not candidate < values[node]:
                    continue
                if hard[2] > 0.0 and not _clear(
                    segment, positions[node], offsets, move, spacing, hard, end
                ):
                    continue
                values[node] = candidate
                best[node] = move
                changed = True
        sweeps += 1
    return sweeps
